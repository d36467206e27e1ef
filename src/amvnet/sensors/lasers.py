"""Measure the lasers of a sensor in its scans, and find the laser of each point.

Measured are the number of lasers, their field of view and the height of the sensor. The laser of a
point is known from its ring, or from the order of the points in a file.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from amvnet.data.formats.cloud import MAX_RINGS
from amvnet.scan import Scan
from amvnet.sensors.ground import MIN_DISTANCE, find_ground
from amvnet.sensors.lidars import Sensor

MIN_POINTS = 100  # smallest number of points from which a sensor is measured
FOV_PERCENTILES = (0.5, 99.5)  # percentiles of the elevations at the ends of the field of view

SAME_ANGLE = 6.0  # largest difference of an end of the field of view of like sensors, degrees
SAME_BEAMS = 1.4  # limit of the ratio between the numbers of lasers of like sensors

# Edges of the bins of elevation in which lasers are counted, degrees.
ELEVATION_EDGES = np.linspace(-90, 90, 361)
SECTORS = 180  # number of sectors of azimuth in which the points of a bin are counted
SMOOTHED_BINS = 7  # number of neighbouring bins of elevation that are counted together; odd

# Bins that tell whether points lie on lasers: narrower than the spaces between these, but wider
# than the noise; the sectors are so narrow that a slight tilt changes little within them.
SHARP_SECTORS = 60  # number of sectors of azimuth
SHARP_BINS = 3600  # number of bins of elevation
BINS_TOGETHER = 20  # number of neighbouring bins in which points may lie anywhere

# The largest mean deviation of the slopes z / hypot(x, y) of one laser; about 2 degrees.
SLOPE_SPREAD = 0.035
MIN_LASER_POINTS = 64  # the least mean number of points of a laser; fewer do not show an order

# In real scans, the elevations within a ring have at most 0.06 of the variance of all elevations;
# within the classes of labels, they have at least 0.34 of it.
MAX_RING_SPREAD = 0.2
MIN_RING_POINTS = 10  # the least number of points of a ring whose elevation counts
SAME_ELEVATION = 0.1  # rings that descend by less than this are in order, degrees

MEASURES = ("beams", "fov_up", "fov_down", "height")  # the attributes of a SensorGeometry


@dataclass(frozen=True)
class SensorGeometry:
    """The geometry of a sensor. Unknown values are None.

    Attributes:
        beams: number of lasers; measured if the points have rings.
        fov_up, fov_down: ends of the field of view, degrees above the horizon.
        height: height of the sensor over the ground, metres.
    """

    beams: int | None = None
    fov_up: float | None = None
    fov_down: float | None = None
    height: float | None = None

    @property
    def field_of_view(self) -> tuple[float, float] | None:
        """The upper and the lower end, degrees; None if an end is unknown or they are swapped."""
        if self.fov_up is None or self.fov_down is None or self.fov_up <= self.fov_down:
            return None
        return self.fov_up, self.fov_down

    @classmethod
    def median(cls, geometries: Sequence[SensorGeometry]) -> SensorGeometry:
        """Return the median of the known values of each attribute."""
        medians: dict[str, Any] = {}
        for key in MEASURES:
            values = [getattr(geometry, key) for geometry in geometries]
            known = [value for value in values if value is not None]
            if known:
                medians[key] = float(np.median(known))
        if "beams" in medians:
            medians["beams"] = round(medians["beams"])

        return cls(**medians)

    def has_ends_of(self, other: SensorGeometry, angle: float = SAME_ANGLE) -> bool:
        """Return whether the fields of view are alike. An unknown end is like any other.

        Args:
            angle: the largest difference of an end, degrees.
        """
        ends = ((self.fov_up, other.fov_up), (self.fov_down, other.fov_down))
        return all(one is None or two is None or abs(one - two) <= angle for one, two in ends)

    def is_like(self, other: SensorGeometry, angle: float = SAME_ANGLE) -> bool:
        """Return whether the lasers are alike, with the ends as for `has_ends_of`."""
        if self.beams and other.beams:
            ratio = self.beams / other.beams
            if not 1 / SAME_BEAMS < ratio < SAME_BEAMS:
                return False
        return self.has_ends_of(other, angle)

    def known(self) -> dict[str, Any]:
        """Return the known values by name."""
        return {key: value for key, value in vars(self).items() if value is not None}

    def override(self, sensor: Sensor) -> SensorGeometry:
        """Return the geometry with its values replaced by the known values of a sensor."""
        stated = SensorGeometry(**{key: getattr(sensor, key) for key in MEASURES})
        return dataclasses.replace(self, **stated.known())


def describe_lasers(lasers: SensorGeometry) -> str:
    """Return the number of lasers and the field of view in words."""
    count = "lasers" if lasers.beams is None else f"{lasers.beams} lasers"
    if lasers.fov_up is None or lasers.fov_down is None:
        return count if lasers.beams else "field of view not found"
    return f"{count} from {lasers.fov_up:+.0f} to {lasers.fov_down:+.0f} degrees"


def measure(points: np.ndarray, ring: np.ndarray | None = None) -> SensorGeometry:
    """Measure the sensor of a scan; values that the points do not show are None.

    The points (N, 3 or more) are finite, in the sensor's frame and in the order of the file.
    """
    lasers = measure_lasers(points, ring)
    if lasers.fov_up is None:
        return lasers
    ground = find_ground(points[:, :3].astype(np.float64))
    return lasers if ground is None else dataclasses.replace(lasers, height=ground.height)


def measure_lasers(points: np.ndarray, ring: np.ndarray | None = None) -> SensorGeometry:
    """Measure the lasers of a sensor like `measure`, but not the height of the sensor."""
    xyz = points[:, :3].astype(np.float64)
    is_distant = np.hypot(xyz[:, 0], xyz[:, 1]) > MIN_DISTANCE
    if is_distant.sum() < MIN_POINTS:
        return SensorGeometry()

    down, up = np.percentile(elevations(xyz[is_distant]), FOV_PERCENTILES)
    beams = None if ring is None else len(np.unique(ring))
    return SensorGeometry(beams, float(up), float(down))


def laser_density(points: np.ndarray) -> NDArray[np.float64]:
    """Return how close together the lasers of a scan are, in bins between `ELEVATION_EDGES`.

    This is the mean number of points around a bin in the sectors that have any there: (360,). Where
    lasers see the sky, sectors are empty and do not count, so that lost returns change little. The
    unit is unknown, and the density is 0 outside the field of view. No rings are needed.

    Args:
        points: (N, 3 or more) points as `measure` takes them.
    """
    xyz = points[:, :3].astype(np.float64)
    xyz = xyz[np.hypot(xyz[:, 0], xyz[:, 1]) > MIN_DISTANCE]
    bins = len(ELEVATION_EDGES) - 1
    if len(xyz) < MIN_POINTS:
        return np.zeros(bins)

    elevation = elevations(xyz)
    sector = (np.arctan2(xyz[:, 1], xyz[:, 0]) / (2 * np.pi) + 0.5) * SECTORS
    cell = np.digitize(elevation, ELEVATION_EDGES[1:-1]) * SECTORS
    cell += np.minimum(sector.astype(np.int64), SECTORS - 1)
    counts = np.bincount(cell, minlength=bins * SECTORS).reshape(bins, SECTORS)
    padded = np.pad(counts, ((SMOOTHED_BINS // 2,) * 2, (0, 0)))
    around = np.lib.stride_tricks.sliding_window_view(padded, SMOOTHED_BINS, axis=0).sum(axis=-1)
    density = around.sum(axis=1) / np.maximum(np.count_nonzero(around, axis=1), 1)

    down, up = np.percentile(elevation, FOV_PERCENTILES)
    inside = (ELEVATION_EDGES[1:] > down) & (ELEVATION_EDGES[:-1] < up)
    within: NDArray[np.float64] = np.where(inside, density, 0.0)
    return within


def laser_sharpness(xyz: NDArray[np.float64]) -> float:
    """Return how much the points (N, 3) gather at the same elevations, as those of a laser do.

    This is the share of pairs of points in one bin among the pairs in neighbouring bins. It is
    largest from where the sensor was: seen from elsewhere, the points of a laser spread.
    """
    xyz = xyz[np.hypot(xyz[:, 0], xyz[:, 1]) > MIN_DISTANCE]
    sector = ((np.arctan2(xyz[:, 1], xyz[:, 0]) / (2 * np.pi) + 0.5) * SHARP_SECTORS).astype(int)
    elevation = ((elevations(xyz) / 180 + 0.5) * SHARP_BINS).astype(int)
    cell = sector % SHARP_SECTORS * SHARP_BINS + np.minimum(elevation, SHARP_BINS - 1)
    counts = np.bincount(cell, minlength=SHARP_SECTORS * SHARP_BINS).reshape(-1, BINS_TOGETHER)
    together = counts.sum(axis=1)
    pairs = (together * (together - 1)).sum()
    return float((counts * (counts - 1)).sum() / max(pairs, 1))


def rows_by_density(
    points: np.ndarray, density: NDArray[np.float64], rows: int
) -> NDArray[np.int64]:
    """Return the row of each point (N,), so that each row has about equally many lasers.

    Rows are counted from the top. Points outside the field of view get the first or the last row.
    """
    below = np.concatenate([[0.0], np.cumsum(density)])
    share = np.interp(elevations(points[:, :3].astype(np.float64)), ELEVATION_EDGES, below)
    row: NDArray[np.int64] = ((1 - share / below[-1]) * rows).astype(np.int64)
    return np.clip(row, 0, rows - 1)


def measure_sensor(scans: Iterable[Scan]) -> SensorGeometry:
    """Return the medians of the measures of a sensor in some scans, with three digits.

    If the scans have rings, the field of view ends at the highest and at the lowest laser.
    """
    measured = []
    for scan in scans:
        points = scan.points[scan.valid, :3].astype(np.float64)
        ring = None if scan.ring is None else scan.ring[scan.valid]
        if len(points):
            measured.append(_with_laser_ends(measure(points, ring), points, ring))

    known = SensorGeometry.median(measured).known()
    return SensorGeometry(**{key: round(value, 3) for key, value in known.items()})


def _with_laser_ends(
    geometry: SensorGeometry, points: np.ndarray, ring: np.ndarray | None
) -> SensorGeometry:
    """Return the geometry whose field of view ends at the highest and the lowest laser.

    A laser's elevation is the median over its points.
    """
    if ring is None or geometry.fov_up is None:
        return geometry
    # Sensors report lost returns as points near the origin, at any elevation.
    is_distant = np.hypot(points[:, 0], points[:, 1]) > MIN_DISTANCE
    elevation = elevations(points[is_distant])
    ring = ring[is_distant]

    ends = [float(np.median(elevation[ring == laser])) for laser in (ring.min(), ring.max())]
    if min(ends) == max(ends):
        return geometry
    return dataclasses.replace(geometry, fov_up=max(ends), fov_down=min(ends))


def elevations(xyz: NDArray[np.floating]) -> NDArray[np.floating]:
    """Return the (N,) elevations of (N, 3) points, degrees above the horizon."""
    degrees: NDArray[np.floating] = np.degrees(
        np.arctan2(xyz[:, 2], np.hypot(xyz[:, 0], xyz[:, 1]))
    )
    return degrees


@np.errstate(invalid="ignore", over="ignore", divide="ignore")
def lasers_by_order(points: np.ndarray, lasers: int) -> np.ndarray | None:
    """Return the laser of each point, (N,), 0 the lowest; None if the order does not show it.

    KITTI's files hold one laser after the other, from the highest to the lowest. Each laser begins
    at the front (+x) and turns to the left. So the next laser begins where the azimuth passes the
    front from right to left. The order counts only if it gives exactly as many lasers as the sensor
    has, and each laser keeps to one elevation, below the laser before it.
    """
    x, y, z = np.ascontiguousarray(points[:, :3].T)
    slope = z / np.hypot(x, y)
    is_known = np.isfinite(slope)  # false for a lost return at the origin
    if not is_known.all():
        x, y, slope = x[is_known], y[is_known], slope[is_known]
    if len(slope) < MIN_LASER_POINTS * lasers:
        return None

    is_front = x > 0
    is_right = is_front & (y < 0)
    is_left = is_front & (y >= 0)
    begins = is_right[:-1] & is_left[1:]
    if np.count_nonzero(begins) != lasers - 1:
        return None

    starts = np.concatenate([[0], np.flatnonzero(begins) + 1])
    sizes = np.diff(starts, append=len(slope))
    means = np.add.reduceat(slope, starts) / sizes
    deviations = np.add.reduceat(np.abs(slope - np.repeat(means, sizes)), starts) / sizes
    if (np.diff(means) >= 0).any() or deviations.max() > SLOPE_SPREAD:
        return None

    ring = np.repeat(np.arange(lasers - 1, -1, -1), sizes)
    # A lost return has the laser of the point before it; before the first point, it has any laser.
    return ring if is_known.all() else ring[np.cumsum(is_known) - 1]


def order_rings(scan: Scan) -> tuple[Scan, str]:
    """Return a scan whose rings ascend with the elevations, and what was wrong with its rings.

    A ring column is a claim that the elevations must confirm: a laser has one elevation, and the
    lasers ascend. Some drivers count from the highest laser, or in the order in which the lasers
    fire. Rings that hold other numbers are left out.

    Returns:
        The scan, and in words what was wrong and done; empty if the rings are in order.
    """
    ring = scan.ring
    if ring is None or ring.max(initial=-1) >= MAX_RINGS:
        return scan, ""
    is_known = scan.valid & (ring >= 0)
    xyz = scan.points[is_known, :3].astype(np.float64)
    index = ring[is_known]
    radius = np.hypot(xyz[:, 0], xyz[:, 1])
    is_distant = radius > MIN_DISTANCE
    count = np.bincount(index[is_distant], minlength=ring.max(initial=-1) + 1)
    # The place of a laser that sees only the car is that of these points.
    is_used = is_distant | (count[index] == 0) & (radius > 0)
    used = index[is_used]
    occurring = np.unique(used)
    if len(occurring) < 2 or len(used) < MIN_RING_POINTS * len(occurring):
        return scan, ""  # too few to contradict the rings

    means, is_steady = _elevations_of_rings(xyz[is_used], used)
    if not is_steady:
        return dataclasses.replace(
            scan, ring=None
        ), "rings that do not follow the elevations (not used)"

    ascending = means[occurring[count[occurring] >= MIN_RING_POINTS]]
    if not _falls(ascending):
        return scan, ""
    lasers = np.arange(ring.max() + 2)
    if _falls(-ascending):
        lasers[occurring[np.argsort(means[occurring])]] = occurring
        fault = "rings in another order than the elevations (put in order)"
    else:
        lasers = np.maximum(index.max() - lasers, -1)
        fault = "rings that count from the highest laser (put in order)"
    lasers[-1] = -1  # for -1
    return dataclasses.replace(scan, ring=lasers[ring]), fault


def _elevations_of_rings(xyz: np.ndarray, ring: np.ndarray) -> tuple[np.ndarray, bool]:
    """Return the mean elevation of each ring, degrees, and whether each ring has one elevation.

    The points are (P, 3) float64, none on the z axis; the means of rings below 0 are 0.
    """

    def means_of(values: np.ndarray) -> np.ndarray:
        means: np.ndarray = np.bincount(ring, values) / np.maximum(np.bincount(ring), 1)
        return means

    elevation = elevations(xyz)

    # A tilt of the sensor adds one wave around the sensor to the elevations of all lasers.
    waves = xyz[:, :2].T / np.hypot(xyz[:, 0], xyz[:, 1])
    within = np.stack([values - means_of(values)[ring] for values in (*waves, elevation)])
    products = within @ within.T
    elevation -= np.linalg.lstsq(products[:2, :2], products[:2, 2])[0] @ waves

    means = means_of(elevation)
    spread = np.square(elevation - means[ring]).sum()
    whole = np.square(elevation - elevation.mean()).sum()
    return means, bool(spread <= MAX_RING_SPREAD * whole)


def _falls(means: np.ndarray) -> bool:
    """Return whether an elevation of (L,) lies clearly below an earlier one."""
    return bool((np.maximum.accumulate(means) - means > SAME_ELEVATION).any())
