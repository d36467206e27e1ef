"""How the ground of one street looks: the paint on its road, and how bright it is."""

from itertools import pairwise

import numpy as np

from lidarstreets.materials import GROUND_SURFACES, Label
from lidarstreets.streets.places import Places
from lidarstreets.streets.plans import Plan

# Median reflectivities of asphalt and of other pavements, measured on KITTI's scans.
ASPHALT = 0.275
PAVEMENT = 0.315
# Metres along and across the street: cells within which the surface has been repaired or not.
CELL = (7.0, 1.6)
CELLS = 64  # cells in each direction before they repeat
MANHOLE = 0.33  # metres: radius of a manhole, which lies in the middle of its cell


class GroundBrightness:
    """The tints of the ground of one street, as in `Mesh`."""

    def __init__(self, rng: np.random.Generator) -> None:
        self._tints = 0.9 * rng.standard_normal(256)  # by class id
        wanted = {Label.ROAD: rng.lognormal(np.log(ASPHALT), 0.07)}
        if rng.random() < 0.08:
            wanted[Label.ROAD] = rng.uniform(0.33, 0.44)  # concrete or cobbles

        # A third of the sidewalks, lots and paved verges are asphalt or as bright as it.
        for label in (Label.SIDEWALK, Label.PARKING, Label.OTHER_GROUND):
            if rng.random() < 1 / 3:
                wanted[label] = wanted[Label.ROAD] * rng.lognormal(0, 0.06)
            else:
                wanted[label] = rng.lognormal(np.log(PAVEMENT), 0.06)

        for label, reflectivity in wanted.items():
            reflection = GROUND_SURFACES[label].reflection
            ratio = np.log(reflectivity / reflection.reflectivity)
            self._tints[label] = ratio / reflection.shade

        # Random numbers for the repairs of the road and its manholes.
        self._cells = rng.random((CELLS, CELLS))

    def terrain_tint(self, x: np.ndarray, y: np.ndarray, label: np.ndarray) -> np.ndarray:
        """Return the tint at positions x, y of classes `label`, without repairs: all (N,)."""
        pattern = np.sin(0.21 * x + 1.3 * np.sin(0.13 * y))
        return self._tints[label] + 0.8 * pattern * np.sin(0.33 * y + 0.05 * x)

    def repairs(self, along: np.ndarray, t: np.ndarray) -> np.ndarray:
        """Return what repairs and manholes add to the tint at street coordinates: all (N,)."""
        length, width = CELL
        rows = (along // length).astype(int) % CELLS
        columns = (t // width).astype(int) % CELLS
        chance = self._cells[rows, columns]

        change = np.where(chance < 0.06, -2.5, 0.0) + np.where(chance > 0.96, 2.0, 0.0)
        from_middle = np.hypot(along % length - length / 2, t % width - width / 2)
        is_manhole = (from_middle < MANHOLE) & (chance % 0.1 < 0.02)
        return change - np.where(is_manhole, 4.0, 0.0)


def is_painted(plan: Plan, places: Places) -> np.ndarray:
    """Return True for places under paint, if they are on the road; as the arrays of `places`."""
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

    # None of this paint is in a junction; stop lines are in front of it.
    painted &= places.crossing > 1
    painted |= (np.abs(places.crossing - 4.5) < 0.2) & (t < 0) & is_road
    is_stripe = (t % 1.0 < 0.5) & is_road
    for start, stop in plan.crosswalks:
        painted |= is_stripe & (places.x > start) & (places.x < stop)
    return painted
