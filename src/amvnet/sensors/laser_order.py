"""Find the laser of each point from its ring, or from the order of the points in a file."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from amvnet.data.formats.cloud import MAX_RINGS
from amvnet.scan import Scan
from amvnet.sensors.ground import MIN_DISTANCE
from amvnet.sensors.lasers import elevations

# The largest mean deviation of the slopes z / hypot(x, y) of one laser; about 2 degrees.
SLOPE_SPREAD = 0.035
MIN_POINTS = 64  # the least mean number of points of a laser; fewer do not show an order

# In real scans, the elevations within a ring have at most 0.06 of the variance of all elevations;
# within the classes of labels, they have at least 0.34 of it.
MAX_RING_SPREAD = 0.2
MIN_RING_POINTS = 10  # the least number of points of a ring whose elevation counts
SAME_ELEVATION = 0.1  # rings that descend by less than this are in order, degrees


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
    if len(slope) < MIN_POINTS * lasers:
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
        return replace(scan, ring=None), "rings that do not follow the elevations (not used)"

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
    return replace(scan, ring=lasers[ring]), fault


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
