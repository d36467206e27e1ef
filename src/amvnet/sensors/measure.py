"""Measure the sensor of a recording: its frame, lasers, field of view, height and intensities."""

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
from amvnet.sensors.lasers import SensorGeometry, field_of_view, measure_lasers
from amvnet.sensors.lidars import Sensor

MEASURED = 5  # scans of a recording that are measured; later ones get the median of these
STEADY = 0.4  # metres: if heights in a recording differ by more, each scan gets its own height
SAME_HEIGHT = 0.15  # metres: training moves the sensor up and down by as much
LOWEST = 0.3  # metres: if the origin is lower, it lies on the ground and not at the sensor

# A scan is from a known sensor if some of its points differ by less. If not, all points decide.
QUICK_STEP = 7  # only one of so many points; no multiple of it is a number of lasers
QUICK_ANGLE = 3.0  # degrees
QUICK_COUNT = 1.5  # factor between the numbers of points


@dataclass(frozen=True)
class Estimate:
    """What was measured of the sensor of a scan, or of several scans as their median.

    Attributes:
        frame: of the coordinates in the files.
        lasers: of the sensor, without its height.
        quantiles: of the intensities as they are in the files; None if there are none.
        count: of the points.
        is_steady: whether the scans were recorded in one frame, at one height.
    """

    frame: Frame
    lasers: SensorGeometry
    quantiles: np.ndarray | None
    count: int
    is_steady: bool = True


@dataclass(frozen=True)
class Gauge:
    """Measures scans by what is known of their sensor.

    Attributes:
        sensor: what is known; the rest is measured.
        usual_height: metres over the ground of a sensor that is not at the origin, if nothing says
            how high it is; None if that is unknown, too.
    """

    sensor: Sensor
    usual_height: float | None = None

    def __call__(self, cloud: Cloud) -> Estimate:
        """Measure the sensor of one scan.

        Raises:
            InputError: if the unit of the coordinates is in doubt, or no point is usable.
        """
        usable = np.isfinite(cloud.xyz).all(axis=1) & (cloud.xyz != 0).any(axis=1)
        with errors_of(cloud.name):
            frame = find_frame(cloud.xyz[usable], self.sensor)
        lasers = self.lasers(cloud, frame)
        return Estimate(frame, lasers, quantiles_of(cloud.intensity), len(cloud.xyz))

    def lasers(self, cloud: Cloud, frame: Frame) -> SensorGeometry:
        """Measure the lasers of a scan whose frame is known."""
        seen = self._seen(cloud, frame)
        return measure_lasers(seen.points, seen.ring)

    def _seen(self, cloud: Cloud, frame: Frame) -> Scan:
        """Return the valid points of a scan as its sensor saw them.

        All lasers are needed, in the order of the file, so that intensities do not count.
        """
        to_sensor, _ = self.rises(frame)
        scan = level_scan(cloud, frame.complete(self.sensor))
        seen = raise_points(scan, to_sensor)
        valid = scan.valid
        ring = None if scan.ring is None else scan.ring[valid]
        return dataclasses.replace(seen, points=seen.points[valid], ring=ring)

    def is_on_ground(self, frame: Frame) -> bool:
        """Return whether the origin of the coordinates lies on the ground, or below."""
        height = self.sensor.height
        may_be_higher = height is None or height >= LOWEST
        return frame.height is not None and frame.height < LOWEST and may_be_higher

    def rises(self, frame: Frame) -> tuple[float, float]:
        """Return how far to move a scan up, metres.

        Returns:
            The rise after which the sensor is at the origin, and the one after which it is
            `usual_height` over the ground.
        """
        known = self.sensor.height
        usual = self.usual_height

        if self.is_on_ground(frame):
            assert frame.height is not None
            above = known if known is not None else usual
            if above is None:
                return 0.0, 0.0
            target = above if usual is None else usual
            return frame.height - above, frame.height - target

        height = known if known is not None else frame.height
        if height is None or usual is None or abs(height - usual) < SAME_HEIGHT:
            return 0.0, 0.0
        return 0.0, height - usual

    def may_have_recorded(self, cloud: Cloud, estimate: Estimate) -> bool:
        """Return whether a scan may be from the sensor of an estimate, by its lasers.

        Some of the points are enough for most scans. Their lasers are counted only if the field of
        view or the number of points differs.
        """
        some = dataclasses.replace(cloud, xyz=cloud.xyz[::QUICK_STEP], intensity=None, ring=None)
        ratio = len(cloud.xyz) / max(estimate.count, 1)
        known = estimate.lasers.field_of_view
        if known is None:
            return True

        if 1 / QUICK_COUNT < ratio < QUICK_COUNT:
            ends = field_of_view(self._seen(some, estimate.frame).points)
            if ends is not None and np.abs(np.subtract(ends, known)).max() < QUICK_ANGLE:
                return True
        return self.lasers(cloud, estimate.frame).is_like(estimate.lasers)


class Recording:
    """The scans of one source, and what was measured of the first ones.

    A source usually has one sensor. Its scans get the median of the first `MEASURED` estimates;
    scans of other sensors, told by their lasers and the range of their intensities, get their own.

    Args:
        gauge: measures the scans.
    """

    def __init__(self, gauge: Gauge) -> None:
        self.medians: list[Estimate] = []  # one for each sensor of the first scans
        self._gauge = gauge
        self._estimates: list[list[Estimate]] = []  # those of each median
        self._is_learnt = False

    @classmethod
    def of(cls, gauge: Gauge, medians: Sequence[Estimate]) -> Recording:
        """Return a recording that was measured before; without medians, each scan gets its own."""
        recording = cls(gauge)
        recording.medians = list(medians)
        recording._is_learnt = True
        return recording

    def learn(self, first: Sequence[Callable[[], Cloud]]) -> None:
        """Measure the first scans; later ones add nothing.

        Args:
            first: functions that read these scans; broken scans are left out.
        """
        for read in first:
            if not self._is_learnt:
                with suppress(InputError):
                    self._add(self._gauge(read()))

        self._is_learnt = bool(self.medians)

    def estimate(self, cloud: Cloud) -> tuple[int | None, Estimate]:
        """Return the estimate for a scan.

        Returns:
            Which of the sensors of the first scans it is from, None if from none of them; and what
            to assume of the sensor.

        Raises:
            InputError: as `Gauge`.
        """
        if self._is_learnt:
            return self._recall(cloud)

        measured = self._gauge(cloud)
        index = self._add(measured)
        median = self.medians[index]
        if median.is_steady:
            return index, median
        return index, dataclasses.replace(measured, quantiles=median.quantiles)

    def _recall(self, cloud: Cloud) -> tuple[int | None, Estimate]:
        """Return the same as `estimate` for a scan that adds nothing to the medians."""
        quantiles = quantiles_of(cloud.intensity)
        measured: Estimate | None = None

        for index, median in enumerate(self.medians):
            if not are_of_one_range(quantiles, median.quantiles):
                continue
            if median.is_steady:
                if self._gauge.may_have_recorded(cloud, median):
                    return index, median
                continue

            # The frame of each scan is its own, so that its lasers are known only in that.
            measured = measured or self._gauge(cloud)
            if measured.lasers.is_like(median.lasers):
                return index, dataclasses.replace(measured, quantiles=median.quantiles)
        return None, measured or self._gauge(cloud)

    def _add(self, estimate: Estimate) -> int:
        """Add the estimate of one of the first scans; return the index of its sensor."""
        index = self._sensor_of(estimate)
        if index == len(self.medians):
            self._estimates.append([])
            self.medians.append(estimate)

        self._estimates[index].append(estimate)
        self.medians[index] = median_of(self._estimates[index])
        self._is_learnt = sum(map(len, self._estimates)) == MEASURED
        return index

    def _sensor_of(self, estimate: Estimate) -> int:
        """Return the index of the first sensor that is like that of an estimate."""
        for index, median in enumerate(self.medians):
            is_of_one_range = are_of_one_range(estimate.quantiles, median.quantiles)
            if is_of_one_range and estimate.lasers.is_like(median.lasers):
                return index
        return len(self.medians)


def median_of(estimates: Sequence[Estimate]) -> Estimate:
    """Return the median of each value that is known."""
    frames = [estimate.frame for estimate in estimates]
    quantiles = [each.quantiles for each in estimates if each.quantiles is not None]
    return Estimate(
        median_frame(frames),
        SensorGeometry.median([estimate.lasers for estimate in estimates]),
        quantiles=np.median(quantiles, axis=0) if quantiles else None,
        count=int(np.median([estimate.count for estimate in estimates])),
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
    """Return a scan in the package's axes.

    Args:
        sensor: with everything about its frame known.
        intensity: (N,) in [0, 1]; None means zeros.

    Raises:
        InputError: if no point is usable.
    """
    xyz = sensor.to_level(cloud.xyz)
    return dataclasses.replace(cloud, xyz=xyz, intensity=intensity).to_scan(1.0)


def raise_points(scan: Scan, rise: float) -> Scan:
    """Return the scan moved up by some metres."""
    if not rise:
        return scan

    offset = np.array([0, 0, rise, 0], np.float32)
    with np.errstate(invalid="ignore"):  # points that are not valid may be any NaN
        return dataclasses.replace(scan, points=scan.points + offset)
