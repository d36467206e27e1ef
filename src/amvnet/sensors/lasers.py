"""Measure the lasers of a sensor in one of its scans: their number and field of view."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.ndimage import maximum_filter1d

from amvnet.sensors.ground import MIN_DISTANCE, find_ground
from amvnet.sensors.lidars import Sensor

MIN_POINTS = 100  # fewer say nothing about the sensor
FOV_PERCENTILES = (0.5, 99.5)  # of the elevations: the ends of the field of view
MIN_BEAMS = 4
MAX_BEAMS = 256

# Lasers counted in a file that stores one laser after the other
FULL_TURN = 350.0  # degrees: a narrower scan is only part of a turn
JUMP = 0.7  # of the width of a part of a turn: if the azimuth jumps by more, a new laser begins
STEP = 0.05  # of the width: in an ordered file, most steps of the azimuth are smaller
ORDERED_SHARE = 0.9  # of the steps that must be that small

# Lasers counted as peaks in the histogram of the elevations
BIN = 0.02  # degrees
PEAK_WINDOW = 1.5  # degrees on each side, in which a bin is compared with the highest one
PEAK_HEIGHT = 0.15  # of that highest bin: fuller bins belong to peaks
MIN_PEAK_POINTS = 0.9  # share of the points that lie in peaks
MAX_PEAK_WIDTH = 0.1  # share of the field of view that peaks cover; if it is more, they are blurred
SECTORS = 12  # of the turn
MIN_SECTOR_PEAKS = 0.75  # share of all peaks that a good sector must have

# Whether two sensors are of one kind
SAME_ANGLE = 6.0  # degrees: fields of view are alike if both ends differ by less
SAME_BEAMS = 1.4  # factor: numbers of lasers are alike if they differ by less

MEASURES = ("beams", "fov_up", "fov_down", "height")  # attributes of a SensorGeometry


@dataclass(frozen=True)
class SensorGeometry:
    """The geometry of a sensor as far as it is known; None stands for an unknown value.

    Attributes:
        beams: number of lasers.
        fov_up, fov_down: ends of the field of view, degrees above the horizon.
        height: metres of the sensor over the ground.
    """

    beams: int | None = None
    fov_up: float | None = None
    fov_down: float | None = None
    height: float | None = None

    @property
    def field_of_view(self) -> tuple[float, float] | None:
        """Upper and lower end, degrees; None if one is unknown or they are swapped."""
        if self.fov_up is None or self.fov_down is None or self.fov_up <= self.fov_down:
            return None
        return self.fov_up, self.fov_down

    @classmethod
    def median(cls, geometries: Sequence[SensorGeometry]) -> SensorGeometry:
        """Return the median of each value that is known."""
        medians: dict[str, Any] = {}
        for key in MEASURES:
            values = [getattr(geometry, key) for geometry in geometries]
            known = [value for value in values if value is not None]
            if known:
                medians[key] = float(np.median(known))
        if "beams" in medians:
            medians["beams"] = round(medians["beams"])
        return cls(**medians)

    def has_ends_of(self, other: SensorGeometry) -> bool:
        """Return whether the field of view is that of another sensor, as far as both are known."""
        return _is_near(self.fov_up, other.fov_up) and _is_near(self.fov_down, other.fov_down)

    def is_like(self, other: SensorGeometry) -> bool:
        """Return whether the lasers are those of another sensor, as far as both are known."""
        if self.beams and other.beams:
            ratio = self.beams / other.beams
            if not 1 / SAME_BEAMS < ratio < SAME_BEAMS:
                return False
        return self.has_ends_of(other)

    def known(self) -> dict[str, Any]:
        """Return the values that are known, by name."""
        return {key: value for key, value in vars(self).items() if value is not None}

    def override(self, sensor: Sensor) -> SensorGeometry:
        """Return the geometry with what is known of the sensor in place of what was measured."""
        stated = SensorGeometry(sensor.beams, sensor.fov_up, sensor.fov_down, sensor.height)
        return dataclasses.replace(self, **stated.known())


def _is_near(angle: float | None, other: float | None) -> bool:
    """Return whether two angles in degrees are alike, or one of them is unknown."""
    return angle is None or other is None or abs(angle - other) <= SAME_ANGLE


def measure(points: np.ndarray, ring: np.ndarray | None = None) -> SensorGeometry:
    """Measure the sensor of a scan.

    Args:
        points: (N, 3 or more) finite x, y, z in the sensor's frame, in the order of the file.
        ring: (N,) indices of the lasers, or None if the file has none.
    """
    lasers = measure_lasers(points, ring)
    if lasers.fov_up is None:
        return lasers
    ground = find_ground(points[:, :3].astype(np.float64))
    return lasers if ground is None else dataclasses.replace(lasers, height=ground.height)


def measure_lasers(points: np.ndarray, ring: np.ndarray | None = None) -> SensorGeometry:
    """Measure the lasers of a sensor as `measure` does, but not its height."""
    xyz = points[:, :3].astype(np.float64)
    ends = field_of_view(points)
    if ends is None:
        return SensorGeometry()

    if ring is not None:
        beams: int | None = len(np.unique(ring))
    else:
        beams = beams_by_order(xyz) or beams_by_peaks(_distant(xyz))
    return SensorGeometry(beams, *ends)


def field_of_view(points: np.ndarray) -> tuple[float, float] | None:
    """Measure only the upper and the lower end, degrees; None if there are few points."""
    distant = _distant(points[:, :3].astype(np.float64))
    if len(distant) < MIN_POINTS:
        return None
    down, up = np.percentile(elevations(distant), FOV_PERCENTILES)
    return float(up), float(down)


def _distant(xyz: np.ndarray) -> np.ndarray:
    """Return the (M, 3) points that are not so near as the vehicle itself."""
    is_distant = np.hypot(xyz[:, 0], xyz[:, 1]) > MIN_DISTANCE
    return xyz[is_distant]


def elevations(xyz: np.ndarray) -> np.ndarray:
    """Return the (N,) elevations of (N, 3) points, degrees above the horizon."""
    return np.degrees(np.arctan2(xyz[:, 2], np.hypot(xyz[:, 0], xyz[:, 1])))


def beams_by_order(xyz: np.ndarray) -> int | None:
    """Return the number of lasers of (N, 3) points that are stored laser by laser.

    None if the points are in another order.
    """
    azimuth = np.degrees(np.arctan2(xyz[:, 1], xyz[:, 0]))
    low, high = np.percentile(azimuth, (0.1, 99.9))
    width = high - low
    steps = np.diff(azimuth)

    if width > FULL_TURN:
        # Each laser adds a full turn to the sum of the steps.
        steps = (steps + 180) % 360 - 180
        beams = round(abs(float(steps.sum())) / 360)
    else:
        # Each new laser jumps back to where the scan begins. Points near the two ends may also be
        # swapped, but such jumps go forth as often as back.
        forth = int((steps > JUMP * width).sum())
        back = int((steps < -JUMP * width).sum())
        beams = 1 + abs(forth - back)

    is_ordered = np.mean(np.abs(steps) < STEP * width) > ORDERED_SHARE
    return beams if is_ordered and MIN_BEAMS <= beams <= MAX_BEAMS else None


def beams_by_peaks(xyz: np.ndarray) -> int | None:
    """Return the number of peaks in the histogram of the elevations of (N, 3) points.

    None if the peaks are blurred. If the scan was corrected for the motion of the vehicle, the
    peak of one laser may be split into several: most sectors then have fewer peaks than the scan.
    """
    elevation = elevations(xyz)
    beams, width = _count_peaks(elevation)

    turns = np.arctan2(xyz[:, 1], xyz[:, 0]) / (2 * np.pi) + 0.5
    sector = (turns * SECTORS).astype(int)
    sector_beams = []
    for index in range(SECTORS):
        is_inside = sector == index
        if is_inside.sum() >= MIN_POINTS:
            sector_beams.append(_count_peaks(elevation[is_inside])[0])

    good_sector = np.percentile(sector_beams or [0], 75)
    is_sharp = width < MAX_PEAK_WIDTH and good_sector >= MIN_SECTOR_PEAKS * beams
    return beams if is_sharp and MIN_BEAMS <= beams <= MAX_BEAMS else None


def _count_peaks(elevation: np.ndarray) -> tuple[int, float]:
    """Count the peaks in the histogram of (N,) elevations.

    Returns:
        The number of peaks, and the share of the field of view that they cover; 0 and 1.0 if too
        many points lie outside the peaks.
    """
    low, high = np.percentile(elevation, (0.05, 99.95))
    edges = np.arange(low - PEAK_WINDOW, high + PEAK_WINDOW, BIN)
    counts, _ = np.histogram(elevation, edges)

    highest = maximum_filter1d(counts, int(2 * PEAK_WINDOW / BIN))
    is_peak = counts > np.maximum(PEAK_HEIGHT * highest, 1)
    if counts[is_peak].sum() < MIN_PEAK_POINTS * len(elevation):
        return 0, 1.0

    begins = np.diff(is_peak.astype(int), prepend=0) == 1
    width = is_peak.sum() * BIN / max(high - low, BIN)
    return int(begins.sum()), width
