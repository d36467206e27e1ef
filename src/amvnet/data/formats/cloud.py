"""The points of a scan file, before anything is assumed about the sensor."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from amvnet.errors import InputError, one_line_errors
from amvnet.scan import FARTHEST, Scan, at_origin

# Largest number of points of a scan: 40 times as many as the largest sensors record.
MAX_POINTS = 10_000_000
MAX_BYTES = 32 * MAX_POINTS  # largest size of the unpacked points of a packed file
MAX_RINGS = 256  # largest number of lasers; a column with larger values does not hold ring indices

# The largest intensity that a sensor can write: as a fraction, in 8 bits or in 16 bits.
FLOAT_RANGES = (1.0, 255.0, 65535.0)
INTEGER_RANGES = (255.0, 65535.0)  # integers are not fractions
MAX_MISSING_SHARE = 0.5  # a scan in which more intensities are missing counts as one without
WILD_SHARE = 0.001  # the largest share of outliers, intensities above the range of all others

Arrays = dict[str, np.ndarray]  # columns (N,) by key
# The possible names of each column, by its key. If a file has several, the first in order is read.
Names = Mapping[str, Sequence[str]]
COLUMN_NAMES: Names = {
    "x": ("x",),
    "y": ("y",),
    "z": ("z",),
    "intensity": (
        "intensity",
        "intensities",
        "i",
        "reflectivity",
        "reflectance",
        "remission",
        "scalar_intensity",
    ),
    "ring": ("ring", "rings", "channel", "laser_id", "laser", "scalar_ring"),
}
OPTIONAL = ("intensity", "ring")  # the keys of columns that a file may lack


@dataclass(frozen=True)
class Cloud:
    """The points of one scan file, in the file's own units and frame.

    Attributes:
        xyz: (N, 3) float32 or float64 coordinates, metres.
        intensity: (N,) intensities in the file's own range; None if the file has no intensities.
        ring: (N,) int64 index of the laser; None if the file has no rings.
        note: what the reader had to assume about the file; empty if it assumed nothing.
    """

    xyz: np.ndarray
    intensity: np.ndarray | None = None
    ring: np.ndarray | None = None
    name: str = ""
    note: str = ""

    @classmethod
    def of(cls, scan: Scan) -> Cloud:
        """Return the points of a scan that was read."""
        return cls(scan.points[:, :3], scan.points[:, 3], scan.ring, name=scan.name)

    @property
    def is_placed(self) -> np.ndarray:
        """(N,) bool: whether a point has finite coordinates that are not 0, 0, 0."""
        # Contiguous columns: a reduction over rows of three takes ten times as long.
        placed: np.ndarray = np.isfinite(self.xyz.T, order="C").all(axis=0)
        placed[at_origin(self.xyz)] = False
        return placed

    def measured_intensity(self) -> np.ndarray | None:
        """Return the finite intensities (M,) of points that are placed; None if most are missing.

        The intensity of a lost return says nothing about the other intensities.
        """
        if self.intensity is None:
            return None

        placed = self.intensity[self.is_placed]
        measured: np.ndarray = placed[np.isfinite(placed)]
        if not len(measured) or len(placed) - len(measured) > MAX_MISSING_SHARE * len(placed):
            return None
        return measured

    def intensity_scale(self) -> float | None:
        """Return the divisor that brings the intensities to [0, 1]; None if there are none.

        The divisor is the end of the usual range that holds the largest intensity: 1 (only for
        floats), 255 or 65535. If the largest intensity is above all ranges, it is itself the
        divisor. Outliers (`WILD_SHARE`) are left out.
        """
        measured = self.measured_intensity()
        if self.intensity is None or measured is None:
            return None

        largest = float(np.quantile(measured, 1 - WILD_SHARE, method="higher"))
        return usual_scale(largest, is_integer=self.intensity.dtype.kind in "iu")

    def to_scan(self, scale: float | None = None) -> Scan:
        """Return the scan, with float32 coordinates and intensities clipped to [0, 1].

        Sensors write 0, 0, 0 for a lost return. Such points become NaN, so that they stay lost
        wherever the scan is moved.

        Args:
            scale: the divisor of the intensities; by default `intensity_scale()`.

        Raises:
            InputError: if no point is usable.
        """
        scale = scale or self.intensity_scale()
        points = np.zeros((len(self.xyz), 4), dtype=np.float32)

        # Numbers that are too large for float32 become infinite; then their points are invalid.
        with np.errstate(over="ignore", invalid="ignore"):
            points[:, :3] = self.xyz
            if self.intensity is not None and scale is not None:
                points[:, 3] = as_fractions(self.intensity, scale)
        points[at_origin(self.xyz), :3] = np.nan

        return Scan(check_usable(points, self.name), ring=self.ring, name=self.name)


@np.errstate(over="ignore", invalid="ignore")
def as_fractions(intensity: np.ndarray, scale: float) -> np.ndarray:
    """Divide intensities (N,) by a scale and clip them to [0, 1]; others than finite become NaN."""
    fractions: np.ndarray = np.clip(intensity / scale, 0, 1)
    is_finite = np.isfinite(intensity)
    return fractions if is_finite.all() else np.where(is_finite, fractions, np.nan)


def usual_scale(largest: float, is_integer: bool) -> float:
    """Return the end of the narrowest usual range of intensities that holds `largest`."""
    ranges = INTEGER_RANGES if is_integer else FLOAT_RANGES
    for limit in ranges:
        if largest <= limit:
            return limit
    return largest


def check_usable(points: np.ndarray, source: Path | str) -> np.ndarray:
    """Return the (N, 4) points of a scan; raise InputError if no point is valid."""
    if not Scan(points).valid.any():
        raise InputError(f"{source}: {_why_unusable(points[:, :3])}")
    return points


def _why_unusable(xyz: np.ndarray) -> str:
    """Return the message for a scan without a valid point, given its (N, 3) coordinates."""
    if not len(xyz):
        return "expected a scan with points, found 0 points; leave the file out"

    distant = np.isfinite(xyz).all(axis=1) & (np.abs(xyz) >= FARTHEST).any(axis=1)
    if distant.any():
        if (np.abs(xyz[distant, 1:]) < FARTHEST).all():
            return (
                f"expected metres from the sensor, found x from {xyz[distant, 0].min():.10g}, as "
                "in a column of times before x; name the columns, for example --columns "
                "_,x,y,z,intensity"
            )
        return (
            f"expected metres from the sensor, found points farther than {FARTHEST / 1000:g} km, "
            "as in map coordinates; subtract the sensor's position x,y,z with --offset -x,-y,-z"
        )
    return (
        "expected finite coordinates, found NaN, infinity or 0, 0, 0 in every point; "
        "leave the file out"
    )


def check_point_count(count: int, path: Path | str, least: int = 0) -> int:
    """Return the number of points that a header claims, if it is plausible.

    Args:
        least: the smallest size of a file with so many points, bytes; 0 if it is not known.

    Raises:
        InputError: if no scan has that many points, or the file is too short for them.
    """
    if not 0 <= count <= MAX_POINTS:
        raise InputError(
            f"{path}: expected a scan of at most {MAX_POINTS:,} points, found {count}; "
            "split it into scans"
        )

    if least:
        size = Path(path).stat().st_size
        if least > size:
            raise InputError(
                f"{path}: expected at least {least} bytes for {count} points, found {size}; "
                "the file is truncated, copy it again"
            )
    return count


@contextmanager
def reading(path: Path | str, expected: str, advice: str) -> Iterator[None]:
    """Turn every error that this block raises into an InputError of one line.

    Readers raise all kinds of exceptions on broken bytes. An InputError passes unchanged.

    Args:
        expected: what was expected in the file, such as "a PCD file".

    Raises:
        InputError: if the block raises anything but an interrupt or an exit.
    """

    def message(error: BaseException) -> str:
        reason = " ".join(str(error).split())[:160] or type(error).__name__
        return f"{path}: expected {expected}, found a broken file ({reason}); {advice}"

    with one_line_errors(message):
        yield


def find_columns(names: Sequence[str], wanted: Names = COLUMN_NAMES) -> dict[str, int]:
    """Return the indices of the wanted columns that a file has, by key, in any case of letters."""
    lower_names = list(map(str.lower, names))

    columns = {}
    for key, aliases in wanted.items():
        for alias in map(str.lower, aliases):
            if alias in lower_names:
                columns[key] = lower_names.index(alias)
                break
    return columns


def require_columns(
    names: Sequence[str], path: Path | str, wanted: Names = COLUMN_NAMES
) -> dict[str, int]:
    """Find columns as `find_columns` does; raise InputError if a needed column is missing."""
    columns = find_columns(names, wanted)
    if not set(wanted) <= {*columns, *OPTIONAL}:
        needed = [aliases for key, aliases in wanted.items() if key not in OPTIONAL]
        expected = map(" or ".join, needed)
        listing = ", ".join(names[:20]) or "none"
        raise InputError(
            f"{path}: expected columns {', '.join(expected)}, found {listing[:200]!a}; "
            "rename the columns"
        )

    return columns


def record_dtype(columns: Mapping[str, tuple[str, int]], size: int) -> np.dtype:
    """Return the NumPy type of a record; bytes that belong to no column are skipped.

    Columns have a type and an offset in a record; the offset and the size are in bytes.
    """
    formats, offsets = zip(*columns.values(), strict=True)
    return np.dtype(
        {"names": list(columns), "formats": formats, "offsets": offsets, "itemsize": size}
    )


def make_cloud(columns: Mapping[str, np.ndarray], name: str) -> Cloud:
    """Return a cloud with the columns (N,) x, y, z and, if present, intensity and ring.

    Coordinates are float32 if all three columns are floats of at most 32 bits, else float64.
    """
    axes = (columns["x"], columns["y"], columns["z"])
    is_float32 = all(axis.dtype.kind not in "iu" and axis.dtype.itemsize <= 4 for axis in axes)
    xyz = np.empty((len(axes[0]), 3), np.float32 if is_float32 else np.float64)
    with np.errstate(invalid="ignore", over="ignore"):  # signalling NaN would cause warnings
        for column, axis in enumerate(axes):
            xyz[:, column] = axis

    return Cloud(xyz, columns.get("intensity"), ring_indices(columns.get("ring")), name)


@np.errstate(invalid="ignore")
def ring_indices(values: np.ndarray | None) -> np.ndarray | None:
    """Return values (N,) as int64 ring indices, with 0 in place of NaN and infinity.

    Return None if there are no values, if all are equal, or if one is negative, not whole or at
    least `MAX_RINGS`.
    """
    if values is None or not len(values):
        return None

    finite = np.where(np.isfinite(values), values, 0)
    is_whole = np.array_equal(finite, np.round(finite))
    if not is_whole or not 0 <= finite.min() < finite.max() < MAX_RINGS:
        return None
    return finite.astype(np.int64)
