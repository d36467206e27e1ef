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
from amvnet.sensors.lasers import SensorGeometry, measure_lasers
from amvnet.sensors.lidars import Sensor

MEASURED = 5  # scans of a recording that are measured; later ones get the median of these
STEADY = 0.4  # metres: if heights in a recording differ by more, each scan gets its own height
SAME_HEIGHT = 0.15  # metres: training moves the sensor up and down by as much
LOWEST = 0.3  # metres: if the origin is lower, it lies on the ground and not at the sensor
QUICK_STEP = 7  # every 7th point suffices for most sensors; 7 divides no usual number of lasers


@dataclass(frozen=True)
class Estimate:
    """What was measured of the sensor of a scan, or of several scans as their median.

    Attributes:
        frame: of the coordinates in the files.
        lasers: of the sensor, without its height.
        quantiles: of the intensities as they are in the files; None if there are none.
        is_steady: whether the scans were recorded in one frame, at one height.
    """

    frame: Frame
    lasers: SensorGeometry
    quantiles: np.ndarray | None
    is_steady: bool = True

    def is_like(self, other: Estimate) -> bool:
        """Return whether scans are of one sensor: by their lasers and ranges of intensity."""
        is_of_one_range = are_of_one_range(self.quantiles, other.quantiles)
        return is_of_one_range and self.lasers.is_like(other.lasers)


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

        return self._measure(cloud, frame)

    def _measure(self, cloud: Cloud, frame: Frame) -> Estimate:
        """Measure lasers and intensities of a scan whose frame is known."""
        # The points as the sensor saw them; a point without an intensity was seen, too.
        scan = level_scan(cloud, frame.complete(self.sensor))
        to_sensor, _ = self.rises(frame)
        seen = raise_points(scan, to_sensor)
        valid = scan.valid
        lasers = measure_lasers(seen.points[valid], None if scan.ring is None else scan.ring[valid])
        return Estimate(frame, lasers, quantiles_of(cloud.intensity))

    def recognises(self, cloud: Cloud, usual: Estimate) -> bool:
        """Return whether a scan is of an estimate's sensor, in the estimate's frame.

        For most scans, some of the points are enough.
        """
        for step in (QUICK_STEP, 1):
            part = dataclasses.replace(
                cloud,
                xyz=cloud.xyz[::step],
                intensity=None if cloud.intensity is None else cloud.intensity[::step],
                ring=None if cloud.ring is None else cloud.ring[::step],
            )
            with suppress(InputError):
                if self._measure(part, usual.frame).is_like(usual):
                    return True
        return False

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


class Recording:
    """What is assumed of the scans of one source, by what is measured of the first ones.

    Its scans get the median of the first `MEASURED` estimates. If these are of several sensors,
    each scan gets its own estimate, and so does a later scan of another sensor.

    Attributes:
        usual: the median; None as long as nothing is measured, and for several sensors.
    """

    def __init__(self, gauge: Gauge) -> None:
        self.usual: Estimate | None = None
        self._gauge = gauge
        self._first: list[Estimate] = []
        self._is_learnt = False

    @property
    def is_mixed(self) -> bool:
        """Whether the first scans are of several sensors."""
        return self._is_learnt and self.usual is None

    def recall(self, usual: Estimate | None) -> None:
        """Take what was measured before; with None, each scan gets its own estimate."""
        self.usual = usual
        self._is_learnt = True

    def learn(self, first: Sequence[Callable[[], Cloud]]) -> None:
        """Measure the first scans; later ones add nothing.

        Args:
            first: functions that read these scans; broken scans are left out.
        """
        for read in first:
            if not self._is_learnt:
                with suppress(InputError):
                    self._add(self._gauge(read()))

        self._is_learnt = bool(self._first)

    def estimate(self, cloud: Cloud) -> tuple[Estimate, bool]:
        """Return what to assume of the sensor of a scan, and whether it is that of the first scans.

        Raises:
            InputError: as `Gauge`.
        """
        if self._is_learnt and self.usual is not None and self.usual.is_steady:
            if self._gauge.recognises(cloud, self.usual):
                return self.usual, True
            return self._gauge(cloud), False

        measured = self._gauge(cloud)
        if not self._is_learnt:
            self._add(measured)
        if self.usual is None:
            return measured, True
        if not measured.is_like(self.usual):
            return measured, False
        if self.usual.is_steady:
            return self.usual, True
        return dataclasses.replace(measured, quantiles=self.usual.quantiles), True

    def _add(self, estimate: Estimate) -> None:
        """Add the estimate of one of the first scans."""
        self._first.append(estimate)
        is_of_one_sensor = all(map(estimate.is_like, self._first))
        self.usual = median_of(self._first) if is_of_one_sensor else None
        self._is_learnt = len(self._first) == MEASURED


def median_of(estimates: Sequence[Estimate]) -> Estimate:
    """Return the median of each value that is known."""
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
