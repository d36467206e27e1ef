"""How scans are read from files and arrays."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from amvnet.data.formats.cloud import Cloud, require_columns
from amvnet.data.formats.rows import UNKNOWN, RowLayout, name_columns, named_cloud, parse_layout
from amvnet.errors import InputError, errors_of
from amvnet.scan import AnyArray, Scan, as_array, check_scan
from amvnet.sensors.frame import check_metres
from amvnet.sensors.intensity import TrainedIntensity, describe_filler
from amvnet.sensors.lidars import UNKNOWN_SENSOR, Sensor

# Largest number of columns of an array of points; an array with more columns is taken for a
# transposed one.
MAX_COLUMNS = 64
EXPECTED = "points of shape (N, 3 or more) with columns x, y, z, intensity"


@dataclass(frozen=True)
class Reading:
    """How files and arrays of points are read.

    Attributes:
        sensor: what is known about the sensor; the rest is measured.
        layout: the names of the columns in files that do not name them.
        topic: the topic to read in bags; by default the only one with scans.
    """

    sensor: Sensor = UNKNOWN_SENSOR
    layout: RowLayout = UNKNOWN
    topic: str | None = None

    def by(self, columns: str | Sequence[str] | None) -> Reading:
        """Return how they are read if someone names the columns; None changes nothing."""
        return replace(self, layout=parse_layout(columns)) if columns else self


AS_FOUND = Reading()


def checked_scan(points: AnyArray | Scan, trained: TrainedIntensity | None = None) -> Scan:
    """Return a scan, or the scan that `array_scan` makes of an array.

    Raises:
        InputError: if the array cannot be read, or no point is valid.
    """
    if isinstance(points, Scan):
        return check_scan(points)
    return array_scan(array_cloud(points), trained)


def array_cloud(points: AnyArray, layout: RowLayout = UNKNOWN) -> Cloud:
    """Return the points of an array as those of a scan file.

    Args:
        points: (N, 3 or more) x, y, z in metres, intensity in [0, 1], ring; or an array of any
            shape with fields of these names, in any order, such as `read_points` of ROS returns.
            Anything that `as_array` takes may stand for an array.
        layout: the names of the columns in order. Only x, y, z, intensity and ring are used. By
            default, named fields keep their names; other columns are x, y, z and intensity,
            followed by the ring if the values suggest it.

    Raises:
        InputError: if the shape is another one, or names of columns are missing.
    """
    names = layout.columns
    with errors_of("scan"):
        _check_no_path(points)
        array = as_array(points, EXPECTED)
    if array.dtype.names is None:
        _check_shape(array)
        values = list(array.T)
        names = names or name_columns(array)
    else:
        fields = array.ravel()
        values = [fields[name] for name in array.dtype.names]
        names = names or array.dtype.names
        require_columns(names, "scan")
    return named_cloud(values, names, "scan")


def array_scan(cloud: Cloud, trained: TrainedIntensity | None = None) -> Scan:
    """Return the scan of an array, given its `array_cloud`; nothing is measured.

    Args:
        trained: fills in intensities with a warning if there are none; without it, they are 0.

    Raises:
        InputError: if the coordinates are clearly not metres, or no point is valid.
    """
    with errors_of("scan"):
        check_metres(cloud)
    count = len(cloud.xyz)
    intensity = cloud.intensity
    # If no intensity is a number, there are none, as in files.
    if cloud.measured_intensity() is None and (intensity is None or cloud.is_placed.any()):
        intensity = np.zeros(count) if trained is None else trained.filler(count)
        warnings.warn(
            f"the scan has no intensity: {describe_filler(trained)}; give a fourth column",
            stacklevel=4,
        )

    table = np.empty((count, 4), np.float32)
    # A value that is too large for float32 becomes infinite: the point is not valid.
    with np.errstate(over="ignore", invalid="ignore"):
        table[:, :3] = cloud.xyz
        table[:, 3] = intensity
    return check_scan(Scan(table, ring=cloud.ring))


def _check_no_path(points: AnyArray) -> None:
    """Raise InputError if someone gives a path, or a list of paths, as points."""
    first = points[0] if isinstance(points, list | tuple) and points else points
    if isinstance(first, Path | str):
        raise InputError(
            f"expected {EXPECTED}, found the path {str(first)!r}; segment files with "
            "Segmenter.each, or read them with amvnet.read"
        )


def _check_shape(array: np.ndarray) -> None:
    """Raise InputError unless an array without named fields has a row for each point."""
    is_transposed = array.ndim == 2 and len(array) < MAX_COLUMNS < array.shape[1]
    if array.ndim == 2 and array.shape[1] >= 3 and not is_transposed:
        return

    advice = "transpose it" if is_transposed else "reshape it"
    if array.ndim == 3:
        advice += ", or give several scans to Segmenter.many"
    raise InputError(f"scan: expected {EXPECTED}, found {array.shape}; {advice}")
