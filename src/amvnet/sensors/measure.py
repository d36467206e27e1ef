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
from amvnet.sensors.frame import QUICK_STEP, STEADY_TILT, Frame, find_frame, median_frame
from amvnet.sensors.ground import MIN_DISTANCE
from amvnet.sensors.intensity import are_of_one_range, quantiles_of
from amvnet.sensors.lasers import SensorGeometry, laser_density, measure_lasers, order_rings
from amvnet.sensors.lidars import Sensor

MEASURED_SCANS = 5  # number of measured scans in a recording; later scans get their median
STEADY_HEIGHT = 0.4  # limit of the differences of height in a recording with one frame, metres
OUTSIDE = 2.0  # smallest excess of points over a field of view that contradicts it, degrees
UNSEEN = 10.0  # smallest part below all points, where there is ground, that contradicts it, degrees
WIDER = 2.5  # smallest ratio of a field of view to that of all points that contradicts it


@dataclass(frozen=True)
class Estimate:
    """What was measured about the sensor of a scan, or the median over several scans.

    Attributes:
        quantiles: the quantiles of the intensities in the files at `PROBABILITIES`, or None if the
            files have no intensities.
        density: how close together the lasers are (`laser_density`); None if it is unknown.
        is_steady: whether the scans were recorded in one frame, at one height.
    """

    frame: Frame
    lasers: SensorGeometry
    quantiles: np.ndarray | None
    density: np.ndarray | None = None
    is_steady: bool = True

    def is_like(self, other: Estimate) -> bool:
        """Return whether two estimates may belong to one sensor.

        The lasers and the ranges of the intensities must be alike.
        """
        is_of_one_range = are_of_one_range(self.quantiles, other.quantiles)
        return is_of_one_range and self.lasers.is_like(other.lasers)

    def is_near(self, other: Estimate) -> bool:
        """Return whether two estimates show one sensor in one frame, about equally high."""
        return self.is_like(other) and _are_steady([self.frame, other.frame])

    def contradiction(self, sensor: Sensor) -> str:
        """Return in words what is stated about a sensor and contradicts this estimate, or ""."""
        texts = []
        height = None if self.frame.is_on_ground(sensor) else self.frame.height
        known = height if sensor.height is None else sensor.height
        if height is not None and known is not None and abs(height - known) > STEADY_HEIGHT:
            texts.append(f"a height of {known:.2f} m, measured is {height:.2f}")

        beams = self.lasers.beams
        if not SensorGeometry(beams).is_like(SensorGeometry(sensor.beams)):
            texts.append(f"{sensor.beams} lasers, the rings are {beams}")
        if self.frame.pitch or self.frame.roll:  # elevations of a levelled scan
            return "; ".join(texts)
        # The highest lasers may see only the sky, but nothing lies outside the field of view, whose
        # ends a tilted sensor raises at one side and lowers at the other.
        largest = OUTSIDE + self.frame.tilt
        for end, seen, sign in (
            (sensor.fov_up, self.lasers.fov_up, 1),
            (sensor.fov_down, self.lasers.fov_down, -1),
        ):
            if end is not None and seen is not None and sign * (seen - end) > largest:
                texts.append(
                    f"an end of the lasers at {end:+.1f} degrees, points lie at {seen:+.1f}"
                )
        if self._is_too_wide(sensor, known):
            texts.append(
                f"lasers from {sensor.fov_up:+.1f} to {sensor.fov_down:+.1f} degrees, points lie "
                f"from {self.lasers.fov_up:+.1f} to {self.lasers.fov_down:+.1f}"
            )
        return "; ".join(texts)

    def _is_too_wide(self, sensor: Sensor, height: float | None) -> bool:
        """Return whether the stated field of view is much wider than that of the points.

        Lasers that see the sky have no points, but a laser that points down sees the ground, unless
        this is nearer than `MIN_DISTANCE`.
        """
        seen = self.lasers.field_of_view
        stated = SensorGeometry().override(sensor).field_of_view
        if seen is None or stated is None:
            return False
        if np.ptp(stated) > WIDER * np.ptp(seen):
            return True
        sees_ground = height is not None and height > MIN_DISTANCE * np.tan(np.radians(-stated[1]))
        return seen[1] - stated[1] > UNSEEN and sees_ground


class Measured:
    """What is assumed about the scans of one recording.

    The first `MEASURED_SCANS` scans are measured, and each scan gets the median of their estimates.
    If the first scans are from several sensors, each scan gets its own estimate. So does a later
    scan from another sensor.

    Attributes:
        usual: the median of the estimates. It is None before a scan is measured, and if there are
            several sensors.
    """

    def __init__(self, sensor: Sensor, usual_height: float | None) -> None:
        self.usual: Estimate | None = None
        self._sensor = sensor
        self._usual_height = usual_height  # as `Frame.rises` takes it
        self._first: list[Estimate] = []
        self._is_learnt = False

    @property
    def is_mixed(self) -> bool:
        """Whether the first scans are from several sensors."""
        return self._is_learnt and self.usual is None

    def recall(self, usual: Estimate | None) -> None:
        """Take `usual` from another process. If it is None, each scan gets its own estimate."""
        self.usual = usual
        self._is_learnt = True

    def learn(self, first: Sequence[Callable[[], Cloud]]) -> None:
        """Read and measure the first scans by these functions; later scans are not measured."""
        for read in first:
            if not self._is_learnt:
                with suppress(InputError):
                    self._add(self._measure(read()))

        self._is_learnt = bool(self._first)

    def estimate(self, cloud: Cloud) -> tuple[Estimate, bool]:
        """Return what to assume about a scan, and whether its sensor is the usual sensor."""
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
        with errors_of(cloud.name):
            frame = find_frame(cloud.xyz[cloud.is_placed], self._sensor)
        return self._measure_in(frame, cloud, density=True)

    def _measure_in(self, frame: Frame, cloud: Cloud, density: bool = False) -> Estimate:
        """Measure the lasers, if asked their density, and the intensities in a known frame."""
        seen, _ = seen_scan(cloud, frame, self._sensor, self._usual_height)
        valid = seen.valid
        points = seen.points[valid]
        lasers = measure_lasers(points, None if seen.ring is None else seen.ring[valid])
        quantiles = quantiles_of(cloud.measured_intensity())
        return Estimate(frame, lasers, quantiles, laser_density(points) if density else None)

    def _recognises(self, cloud: Cloud, usual: Estimate) -> bool:
        """Return whether a scan in the usual frame is from the usual sensor.

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
        self._first.append(estimate)
        is_of_one_sensor = all(map(estimate.is_like, self._first))
        self.usual = median_of(self._first) if is_of_one_sensor else None
        self._is_learnt = len(self._first) == MEASURED_SCANS


def median_of(estimates: Sequence[Estimate]) -> Estimate:
    """Return the estimate whose values are the medians of the known values of some estimates."""
    frames = [estimate.frame for estimate in estimates]
    quantiles = [each.quantiles for each in estimates if each.quantiles is not None]
    densities = [each.density for each in estimates if each.density is not None]

    return Estimate(
        median_frame(frames),
        SensorGeometry.median([estimate.lasers for estimate in estimates]),
        quantiles=np.median(quantiles, axis=0) if quantiles else None,
        density=np.mean(densities, axis=0) if densities else None,
        is_steady=_are_steady(frames),
    )


def _are_steady(frames: Sequence[Frame]) -> bool:
    if len({(frame.unit, frame.axes) for frame in frames}) > 1:
        return False
    heights = [frame.height for frame in frames if frame.height is not None]
    if heights and max(heights) - min(heights) >= STEADY_HEIGHT:
        return False
    turns = np.array([(frame.pitch, frame.roll) for frame in frames])
    return bool((np.ptp(turns, axis=0) < STEADY_TILT).all())


def seen_scan(
    cloud: Cloud,
    frame: Frame,
    sensor: Sensor,
    usual_height: float | None,
    intensity: np.ndarray | None = None,
) -> tuple[Scan, str]:
    """Return a level scan with the sensor at the origin, and what was wrong with its rings.

    Args:
        usual_height: as `Frame.rises` takes it.
        intensity: (N,) intensities in [0, 1]; by default zeros.
    """
    xyz = frame.complete(sensor).to_level(cloud.xyz)
    scan = dataclasses.replace(cloud, xyz=xyz, intensity=intensity).to_scan(1.0)
    to_sensor, _ = frame.rises(sensor, usual_height)
    return order_rings(raise_points(scan, to_sensor))


def raise_points(scan: Scan, rise: float) -> Scan:
    """Return the scan moved up by `rise` metres."""
    if not rise:
        return scan

    offset = np.array([0, 0, rise, 0], np.float32)
    with np.errstate(invalid="ignore"):  # invalid points may be signalling NaN
        return dataclasses.replace(scan, points=scan.points + offset)
