"""Find the ground in a scan: the plane that most of the lowest points around the sensor lie in."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

MIN_DISTANCE = 1.0  # metres: nearer returns are from the vehicle itself
CELL = 1.0  # metres: side of the cells whose lowest points are used
RADIUS = 20.0  # metres: farther points are not used
HALF_WEIGHT = 8.0  # metres: a cell at this distance counts half as much as one at the sensor
TRIES = 400  # planes through three low points each
MIN_AREA = 1.0  # square metres: twice the area of the triangle between the three points
TOLERANCE = 0.1  # metres between the plane and the points of the ground
MAX_SLOPE = 25.0  # degrees: steeper planes are walls and embankments
MIN_CELLS = 30
MIN_AGREEMENT = 0.25  # weighted share of the cells that must lie in the plane

# Which side of the plane is up: the ground has things on it, and little below it
OFF_PLANE = 0.3  # metres from the plane within which points belong to it, at the sensor
CURVED = 0.02  # metres more for each metre of distance from the sensor
MAX_BELOW = 0.1  # share of the points that may be below the plane, unless more are above it
MIN_HEIGHT = -0.5  # metres of the origin over the plane; if it is lower, the plane must be sure
MAX_HEIGHT = 10.0  # metres of the origin over the plane; if it is higher, the plane is a wall

# When a plane is sure enough to turn a scan by it. In real scans in all orientations, the ground
# has 0.3 to 0.7 of the points within `TOLERANCE` and 0.4 to 0.8 of the cells, a wall at most 0.15.
SURE_AGREEMENT = 0.3  # weighted share of the cells
SURE_CELLS = 40  # square metres, weighted by their distance
SURE_SHARE = 0.2  # of the points within `RADIUS` that must lie in the plane


@dataclass(frozen=True)
class Ground:
    """The ground plane of a scan.

    Attributes:
        up: (3,) its normal, of length 1.
        height: metres of the origin over it, along z.
        is_sure: whether it is certain enough to turn the scan by it.
    """

    up: np.ndarray
    height: float
    is_sure: bool

    @property
    def tilt(self) -> float:
        """Degrees between the normal and the z axis."""
        return float(np.degrees(np.arccos(np.clip(self.up[2], -1, 1))))


def find_ground(xyz: np.ndarray) -> Ground | None:
    """Find the ground of a scan whose z axis points more or less up; None if there is none.

    The ground is the plane through three low points that has many low points in it and few below
    it, refined by least squares. Near points count more.

    Args:
        xyz: (N, 3) finite points, metres.
    """
    distance = np.hypot(xyz[:, 0], xyz[:, 1])
    around = xyz[(distance > MIN_DISTANCE) & (distance < RADIUS)]
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
    return Ground(normal / np.linalg.norm(normal), height, is_sure)


def _sides(xyz: np.ndarray, plane: np.ndarray) -> tuple[float, float]:
    """Return the shares of the (N, 3) points that are clearly above and below a plane.

    Far points count, too: next to a raised road, more near points may be below it than above.
    """
    off_plane = xyz[:, 2] - _with_ones(xyz) @ plane
    least = OFF_PLANE + CURVED * np.hypot(xyz[:, 0], xyz[:, 1])
    return float(np.mean(off_plane > least)), float(np.mean(off_plane < -least))


def _lowest_points(xyz: np.ndarray) -> np.ndarray:
    """Return the (M, 3) lowest points of the cells around the sensor."""
    column, row = np.floor((xyz[:, :2] + RADIUS) / CELL).astype(np.int64).T
    cell = column * int(2 * RADIUS / CELL + 1) + row

    order = np.lexsort((xyz[:, 2], cell))
    is_first = np.diff(cell[order], prepend=-1) > 0
    return xyz[order][is_first]


def _best_plane(low: np.ndarray, weight: np.ndarray) -> np.ndarray | None:
    """Return (a, b, c) of the plane z = a x + b y + c that most (M, 3) low points agree with.

    Return None if every plane is too steep. The draws are seeded: the same points give the same
    plane.
    """
    rng = np.random.default_rng(0)
    triples = low[rng.choice(len(low), (TRIES, 3), p=weight / weight.sum())]  # (tries, 3, 3)
    corners = np.concatenate([triples[:, :, :2], np.ones((TRIES, 3, 1))], axis=2)
    is_large = np.abs(np.linalg.det(corners)) > MIN_AREA
    planes = np.linalg.solve(corners[is_large], triples[is_large][:, :, 2:])[:, :, 0]

    slopes = np.hypot(planes[:, 0], planes[:, 1])
    planes = planes[slopes < np.tan(np.radians(MAX_SLOPE))]
    if not len(planes):
        return None

    above = low[:, 2] - planes @ _with_ones(low).T  # (planes, M) metres
    agreeing = (np.abs(above) < TOLERANCE) @ weight
    below = (above < -3 * TOLERANCE) @ weight
    return planes[(agreeing - below).argmax()]


def _with_ones(xyz: np.ndarray) -> np.ndarray:
    """Return (M, 3) rows x, y, 1: times (a, b, c), they are the heights of a plane."""
    return np.column_stack([xyz[:, :2], np.ones(len(xyz))])
