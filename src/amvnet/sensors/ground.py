"""Find the ground in a scan: the plane that holds most of the lowest points around the sensor."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

MIN_DISTANCE = 1.0  # smallest distance of points that are used, metres; the vehicle is nearer
CELL_SIDE = 1.0  # side of the cells whose lowest points are used, metres
MAX_DISTANCE = 20.0  # largest distance of points that are used, metres
HALF_WEIGHT = 8.0  # distance at which a cell counts half as much as at the sensor, metres
TRIED_PLANES = 400  # number of planes that are tried, each through three low points
MIN_AREA = 1.0  # smallest double area of the triangle between the three points, square metres
TOLERANCE = 0.1  # largest distance of the ground's points from the plane, metres
MAX_SLOPE = 25.0  # largest slope of the ground, degrees: steeper planes are walls and embankments
MIN_CELLS = 30  # smallest number of cells with points
MIN_AGREEMENT = 0.25  # smallest weighted share of the cells that lie in the plane

# The ground under the sensor may lie off the plane, where a road is curved.
NEAR_CELLS = 60  # number of cells that show the ground under the sensor
MAX_NEAR_OFF = 0.5  # largest distance of their lowest points from the plane, metres

# Which side of the plane is up? The ground has things above it, and little below it.
MAX_OFF_PLANE = 0.3  # largest distance from the plane of points that belong to it, metres
OFF_PLANE_PER_METRE = 0.02  # increase of this distance for each metre from the sensor, metres
MAX_BELOW = 0.1  # largest share of the points below the plane, unless more points are above it
MIN_HEIGHT = -0.5  # smallest height of the origin over a plane that need not be sure, metres
MAX_HEIGHT = 10.0  # largest height of the origin over the plane, metres: lower planes are no ground

# When is a plane sure enough to turn a scan by it? In real scans in all orientations, the ground
# has 0.3 to 0.7 of the points within `TOLERANCE` and 0.4 to 0.8 of the cells. A wall has at most
# 0.15 of the points.
SURE_AGREEMENT = 0.3  # smallest weighted share of the cells
SURE_CELLS = 40  # smallest area of the cells, weighted by their distance, square metres
SURE_SHARE = 0.2  # smallest share of the points within `MAX_DISTANCE` that lie in the plane


@dataclass(frozen=True)
class Ground:
    """The ground plane of a scan.

    Attributes:
        up: (3,) the normal of the plane, of length 1.
        height: height of the origin over the ground along z, metres.
        is_sure: whether the plane is sure enough to turn the scan by it.
    """

    up: NDArray[np.floating]
    height: float
    is_sure: bool

    @property
    def tilt(self) -> float:
        """Angle between the normal and the z axis, degrees."""
        return float(np.degrees(np.arccos(np.clip(self.up[2], -1, 1))))


def find_ground(xyz: NDArray[np.floating]) -> Ground | None:
    """Find the ground of a scan, (N, 3) finite points in metres, whose z axis points about up.

    Many planes through three low points are tried. The ground is the plane with many low points in
    it and few below it. Least squares refine it. Near points count more.

    None says that no plane is good enough.
    """
    distance = np.hypot(xyz[:, 0], xyz[:, 1])
    around = xyz[(distance > MIN_DISTANCE) & (distance < MAX_DISTANCE)]
    low = _lowest_points(around)
    if len(low) < MIN_CELLS:
        return None

    weight = 1 / (1 + np.hypot(low[:, 0], low[:, 1]) / HALF_WEIGHT)
    plane = _best_plane(low, weight)
    if plane is None:
        return None

    xy1 = _with_ones(low)
    for _ in range(3):
        is_ground = np.abs(low[:, 2] - xy1 @ plane) < TOLERANCE
        if is_ground.sum() < MIN_CELLS / 2:
            return None
        plane = np.linalg.lstsq(xy1[is_ground], low[is_ground, 2], rcond=None)[0]

    agreement = weight[is_ground].sum() / weight.sum()
    off_plane = around[:, 2] - _with_ones(around) @ plane
    above, below = _sides(xyz[distance > MIN_DISTANCE], plane)
    is_sure = bool(
        agreement > SURE_AGREEMENT
        and weight[is_ground].sum() > SURE_CELLS
        and np.mean(np.abs(off_plane) < TOLERANCE) > SURE_SHARE
        and above >= below
    )

    # A plane above the origin may be a ceiling, or the lower ends of far walls.
    height = float(-plane[2])
    if height > MIN_HEIGHT:
        is_below = height < MAX_HEIGHT and below <= max(above, MAX_BELOW)
    else:
        is_below = is_sure and below < above / 2
    if agreement <= MIN_AGREEMENT or not is_below:
        return None

    normal = np.array([-plane[0], -plane[1], 1])
    off = _off_plane_at_sensor(low, plane)
    if abs(off) > TOLERANCE:
        height -= off
    return Ground(normal / np.linalg.norm(normal), height, is_sure)


def _off_plane_at_sensor(low: NDArray[np.floating], plane: NDArray[np.floating]) -> float:
    """Return how far above a plane the low points (M, 3) nearest to the sensor lie, metres."""
    off_plane = low[:, 2] - _with_ones(low) @ plane
    may_be_ground = np.abs(off_plane) < MAX_NEAR_OFF
    order = np.argsort(np.hypot(low[:, 0], low[:, 1])[may_be_ground], kind="stable")
    return float(np.median(off_plane[may_be_ground][order[:NEAR_CELLS]]))


def _sides(xyz: NDArray[np.floating], plane: NDArray[np.floating]) -> tuple[float, float]:
    """Return two shares of the points (N, 3): clearly above a plane, and clearly below it.

    Far points count as well: next to a raised road, more near points may be below the plane than
    above it.
    """
    off_plane = xyz[:, 2] - _with_ones(xyz) @ plane
    least = MAX_OFF_PLANE + OFF_PLANE_PER_METRE * np.hypot(xyz[:, 0], xyz[:, 1])
    return float(np.mean(off_plane > least)), float(np.mean(off_plane < -least))


def _lowest_points(xyz: NDArray[np.floating]) -> NDArray[np.floating]:
    """Return the lowest point of each of the M cells that have points: (M, 3)."""
    column, row = np.floor((xyz[:, :2] + MAX_DISTANCE) / CELL_SIDE).astype(np.int64).T
    side = int(2 * MAX_DISTANCE / CELL_SIDE + 1)
    cell = column * side + row

    heights = np.full(side * side, np.inf)
    np.minimum.at(heights, cell, xyz[:, 2])
    lowest = xyz[:, 2] == heights[cell]  # several points of a cell may be equally low
    _, first = np.unique(cell[lowest], return_index=True)
    found: NDArray[np.floating] = xyz[lowest][first]
    return found


def _best_plane(
    low: NDArray[np.floating], weight: NDArray[np.floating]
) -> NDArray[np.floating] | None:
    """Return (a, b, c) of the plane z = a x + b y + c through most of the low points (M, 3).

    Return None if every plane is too steep. The random draws are seeded, so that the same points
    give the same plane.
    """
    rng = np.random.default_rng(0)
    triples = low[rng.choice(len(low), (TRIED_PLANES, 3), p=weight / weight.sum())]  # (tries, 3, 3)
    corners = np.concatenate([triples[:, :, :2], np.ones((TRIED_PLANES, 3, 1))], axis=2)
    is_large = np.abs(np.linalg.det(corners)) > MIN_AREA
    planes = np.linalg.solve(corners[is_large], triples[is_large][:, :, 2:])[:, :, 0]

    slopes = np.hypot(planes[:, 0], planes[:, 1])
    planes = planes[slopes < np.tan(np.radians(MAX_SLOPE))]
    if not len(planes):
        return None

    above = low[:, 2] - planes @ _with_ones(low).T  # (planes, M) metres
    agreeing = (np.abs(above) < TOLERANCE) @ weight
    below = (above < -3 * TOLERANCE) @ weight
    best: NDArray[np.floating] = planes[(agreeing - below).argmax()]
    return best


def _with_ones(xyz: NDArray[np.floating]) -> NDArray[np.floating]:
    """Return the rows (x, y, 1): (M, 3). Their product with (a, b, c) is the plane's height."""
    return np.column_stack([xyz[:, :2], np.ones(len(xyz))])
