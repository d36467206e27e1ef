"""Measure the sensor of a recording: its frame, height, lasers and intensities."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass

import numpy as np

from amvnet.data.formats.cloud import Cloud
from amvnet.errors import InputError, errors_of
from amvnet.scan import Scan
from amvnet.sensors.frame import STEADY_TILT, Frame, find_frame, median_frame
from amvnet.sensors.intensity import are_of_one_range, quantiles_of
from amvnet.sensors.lasers import SensorGeometry, measure_lasers
from amvnet.sensors.lidars import Sensor

MEASURED = 5  # number of scans that are measured in a recording; later scans get their median
STEADY = 0.4  # metres; if heights in a recording differ by more, each scan gets its own height
QUICK_STEP = 7  # every 7th point suffices for most sensors; 7 divides no usual number of lasers


@dataclass(frozen=True)
class Estimate:
    """What was measured about the sensor of a scan, or the median over several scans.

    Attributes:
        frame: the frame of the coordinates in the files.
        lasers: the sensor's geometry, without its height.
        quantiles: the quantiles of the intensities in the files; None if there are none.
        is_steady: whether the scans were recorded in one frame, at one height.
    """

    frame: Frame
    lasers: SensorGeometry
    quantiles: np.ndarray | None
    is_steady: bool = True

    def is_like(self, other: Estimate) -> bool:
        """Return whether two estimates can be of one sensor.

        The lasers and the ranges of the intensities must be alike.
        """
        is_of_one_range = are_of_one_range(self.quantiles, other.quantiles)
        return is_of_one_range and self.lasers.is_like(other.lasers)


class Recording:
    """What is assumed about the scans of one recording.

    The first `MEASURED` scans are measured, and each scan gets the median of their estimates. If
    the first scans are of several sensors, each scan gets its own estimate. A later scan of another
    sensor also gets its own.

    Args:
        sensor: what is known about the sensor; the rest is measured.
        usual_height: the argument of `Frame.rises`.

    Attributes:
        usual: the median; None before anything is measured, or if there are several sensors.
    """

    def __init__(self, sensor: Sensor, usual_height: float | None) -> None:
        self.usual: Estimate | None = None
        self._sensor = sensor
        self._usual_height = usual_height
        self._first: list[Estimate] = []
        self._is_learnt = False

    @property
    def is_mixed(self) -> bool:
        """Whether the first scans are of several sensors."""
        return self._is_learnt and self.usual is None

    def recall(self, usual: Estimate | None) -> None:
        """Take `usual` from another process. If it is None, each scan gets its own estimate."""
        self.usual = usual
        self._is_learnt = True

    def learn(self, first: Sequence[Callable[[], Cloud]]) -> None:
        """Measure the first scans, which these functions read. Later scans are not measured."""
        for read in first:
            if not self._is_learnt:
                with suppress(InputError):
                    self._add(self._measure(read()))

        self._is_learnt = bool(self._first)

    def estimate(self, cloud: Cloud) -> tuple[Estimate, bool]:
        """Return what to assume about a scan, and whether its sensor is as expected."""
        if self._is_learnt and self.usual is not None and self.usual.is_steady:
            if self._recognises(cloud, self.usual):
                return self.usual, True
            return self._measure(cloud), False

        measured = self._measure(cloud)
        if not self._is_learnt:
            self._add(measured)

        if self.usual is None:
            return measured, True
        if not measured.is_like(self.usual):
            return measured, False
        if self.usual.is_steady:
            return self.usual, True
        return dataclasses.replace(measured, quantiles=self.usual.quantiles), True

    def _measure(self, cloud: Cloud) -> Estimate:
        """Measure the sensor of one scan."""
        with errors_of(cloud.name):
            frame = find_frame(cloud.xyz[cloud.is_placed], self._sensor)
        return self._measure_in(frame, cloud)

    def _measure_in(self, frame: Frame, cloud: Cloud) -> Estimate:
        """Measure the lasers and the intensities of a scan whose frame is known."""
        # Points without an intensity also show the lasers.
        scan = level_scan(cloud, frame.complete(self._sensor))
        to_sensor, _ = frame.rises(self._sensor, self._usual_height)
        seen = raise_points(scan, to_sensor)
        valid = scan.valid
        lasers = measure_lasers(seen.points[valid], None if scan.ring is None else scan.ring[valid])
        return Estimate(frame, lasers, quantiles_of(cloud.measured_intensity()))

    def _recognises(self, cloud: Cloud, usual: Estimate) -> bool:
        """Return whether a scan, assumed to be in the usual frame, is of the usual sensor.

        For most scans, every 7th point is enough to tell.
        """
        for step in (QUICK_STEP, 1):
            part = dataclasses.replace(
                cloud,
                xyz=cloud.xyz[::step],
                intensity=None if cloud.intensity is None else cloud.intensity[::step],
                ring=None if cloud.ring is None else cloud.ring[::step],
            )
            with suppress(InputError):
                if self._measure_in(usual.frame, part).is_like(usual):
                    return True
        return False

    def _add(self, estimate: Estimate) -> None:
        """Add the estimate of one of the first scans."""
        self._first.append(estimate)
        is_of_one_sensor = all(map(estimate.is_like, self._first))
        self.usual = median_of(self._first) if is_of_one_sensor else None
        self._is_learnt = len(self._first) == MEASURED


def median_of(estimates: Sequence[Estimate]) -> Estimate:
    """Return the median of the known values of some estimates."""
    frames = [estimate.frame for estimate in estimates]
    quantiles = [each.quantiles for each in estimates if each.quantiles is not None]

    return Estimate(
        median_frame(frames),
        SensorGeometry.median([estimate.lasers for estimate in estimates]),
        quantiles=np.median(quantiles, axis=0) if quantiles else None,
        is_steady=_are_steady(frames),
    )


def _are_steady(frames: Sequence[Frame]) -> bool:
    """Return whether the scans of a recording were recorded in one frame, at one height."""
    if len({(frame.unit, frame.axes) for frame in frames}) > 1:
        return False
    heights = [frame.height for frame in frames if frame.height is not None]
    if heights and max(heights) - min(heights) >= STEADY:
        return False
    turns = np.array([(frame.pitch, frame.roll) for frame in frames])
    return bool((np.ptp(turns, axis=0) < STEADY_TILT).all())


def level_scan(cloud: Cloud, sensor: Sensor, intensity: np.ndarray | None = None) -> Scan:
    """Return a scan in the package's axes, with intensities (N,) in [0, 1]; by default zeros."""
    xyz = sensor.to_level(cloud.xyz)
    return dataclasses.replace(cloud, xyz=xyz, intensity=intensity).to_scan(1.0)


def raise_points(scan: Scan, rise: float) -> Scan:
    """Return the scan moved up by `rise` metres."""
    if not rise:
        return scan

    offset = np.array([0, 0, rise, 0], np.float32)
    with np.errstate(invalid="ignore"):  # invalid points may be signalling NaN
        return dataclasses.replace(scan, points=scan.points + offset)
