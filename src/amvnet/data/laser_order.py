"""Find the laser of each point from the order of the points in a file."""

from __future__ import annotations

import numpy as np

# The largest mean deviation of the slopes z / hypot(x, y) of one laser; about 2 degrees.
SLOPE_SPREAD = 0.035
MIN_POINTS = 64  # the least mean number of points of a laser; fewer do not show an order


@np.errstate(invalid="ignore", over="ignore", divide="ignore")
def lasers_by_order(points: np.ndarray, lasers: int) -> np.ndarray | None:
    """Return the laser of each point, (N,), 0 the lowest; None if the order does not show it.

    KITTI's files hold one laser after the other, from the highest to the lowest. Each laser begins
    at the front (+x) and turns to the left. So the next laser begins where the azimuth passes the
    front from right to left. The order counts only if it gives exactly as many lasers as the sensor
    has, and each laser keeps to one elevation, below the laser before it.

    Args:
        points: (N, 3 or more) x, y, z in metres, in the order of the file.
        lasers: the number of lasers of the sensor.
    """
    if len(points) < MIN_POINTS * lasers:
        return None

    x, y, z = np.ascontiguousarray(points[:, :3].T)
    slope = z / np.hypot(x, y)
    is_known = np.isfinite(slope)  # false for a lost return at the origin
    if not is_known.all():
        x, y, slope = x[is_known], y[is_known], slope[is_known]

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
    # A lost return has the laser of the point before it.
    return ring if is_known.all() else ring[np.maximum(np.cumsum(is_known) - 1, 0)]
