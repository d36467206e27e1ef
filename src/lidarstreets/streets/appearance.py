"""Draw how the ground of one street looks: the paint on its road, and how bright it is."""

from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from lidarstreets.materials import GROUND_SURFACES, Label
from lidarstreets.streets.places import Places
from lidarstreets.streets.plans import Plan

# Median reflectivities of asphalt and of other pavements, measured on KITTI's scans.
ASPHALT_REFLECTIVITY = 0.275
PAVEMENT_REFLECTIVITY = 0.315
# Size of a cell of the surface, which is repaired as a whole: metres along and across the street.
CELL_SIZE = (7.0, 1.6)
CELL_PERIOD = 64  # number of cells in each direction after which the pattern repeats
MANHOLE_RADIUS = 0.33  # radius of a manhole, which lies in the middle of its cell, metres


class GroundBrightness:
    """The tints of the ground of one street, as in `Mesh`."""

    def __init__(self, rng: np.random.Generator) -> None:
        self._tints = 0.9 * rng.standard_normal(256)  # one for each class id
        wanted = {Label.ROAD: rng.lognormal(np.log(ASPHALT_REFLECTIVITY), 0.07)}
        if rng.random() < 0.08:
            wanted[Label.ROAD] = rng.uniform(0.33, 0.44)  # concrete or cobbles

        # A third of the sidewalks, car parks and paved verges are about as bright as the road.
        for label in (Label.SIDEWALK, Label.PARKING, Label.OTHER_GROUND):
            if rng.random() < 1 / 3:
                wanted[label] = wanted[Label.ROAD] * rng.lognormal(0, 0.06)
            else:
                wanted[label] = rng.lognormal(np.log(PAVEMENT_REFLECTIVITY), 0.06)

        for label, reflectivity in wanted.items():
            reflection = GROUND_SURFACES[label].reflection
            ratio = np.log(reflectivity / reflection.reflectivity)
            self._tints[label] = ratio / reflection.shade

        # Random numbers for the repairs of the road and its manholes.
        self._cells = rng.random((CELL_PERIOD, CELL_PERIOD))

    def terrain_tint(
        self, x: NDArray[np.float64], y: NDArray[np.float64], label: np.ndarray
    ) -> NDArray[np.float64]:
        """Return the tints, without repairs, at the places x, y with the class ids `label`.

        All arrays are (N,); x and y are in metres.
        """
        pattern = np.sin(0.21 * x + 1.3 * np.sin(0.13 * y))
        tint: NDArray[np.float64] = self._tints[label] + 0.8 * pattern * np.sin(0.33 * y + 0.05 * x)
        return tint

    def repairs(self, along: np.ndarray, t: np.ndarray) -> np.ndarray:
        """Return what repairs and manholes add to the tints at street coordinates `along` and t.

        All arrays are (N,); the coordinates are in metres.
        """
        length, width = CELL_SIZE
        rows = (along // length).astype(int) % CELL_PERIOD
        columns = (t // width).astype(int) % CELL_PERIOD
        chance = self._cells[rows, columns]

        change = np.where(chance < 0.06, -2.5, 0.0) + np.where(chance > 0.96, 2.0, 0.0)
        from_middle = np.hypot(along % length - length / 2, t % width - width / 2)
        is_manhole = (from_middle < MANHOLE_RADIUS) & (chance % 0.1 < 0.02)
        return change - np.where(is_manhole, 4.0, 0.0)


def is_painted(plan: Plan, places: Places) -> np.ndarray:
    """Return which places have paint on them, if they are on the road.

    The bool array has the shape of the arrays of `places`.
    """
    style = plan.style
    t = places.t
    is_road = np.abs(t) < style.road / 2

    # Lines along the edges, in the middle and between lanes, and arrows in the lanes.
    painted = np.abs(places.road + 0.3) < 0.07
    if not style.median:
        painted |= (np.abs(t) < 0.07) & (places.x % 9 < 4)
    centres = sorted(abs(lane) for lane, _ in style.lanes)

    for inner, outer in pairwise(centres):
        if outer - inner > 1:
            line = (inner + outer) / 2
            painted |= (np.abs(np.abs(t) - line) < 0.08) & (places.x % 18 < 6)
    for lane, _ in style.lanes:
        painted |= (np.abs(t - lane) < 0.09) & (places.x % 60 < 3.5)

    # Junctions have none of this paint, but stop lines in front of them.
    painted &= places.crossing > 1
    painted |= (np.abs(places.crossing - 4.5) < 0.2) & (t < 0) & is_road
    is_stripe = (t % 1.0 < 0.5) & is_road
    for start, stop in plan.crosswalks:
        painted |= is_stripe & (places.x > start) & (places.x < stop)
    return painted
