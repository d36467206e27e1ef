"""The paint on a road: lines along lanes and edges, stop lines, arrows and zebra crossings."""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from lidarstreets.streets.places import Places
from lidarstreets.streets.plans import Plan


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

    # None of these are in a junction; stop lines are in front of it.
    painted &= places.crossing > 1
    painted |= (np.abs(places.crossing - 4.5) < 0.2) & (t < 0) & is_road
    is_stripe = (t % 1.0 < 0.5) & is_road
    for start, stop in plan.crosswalks:
        painted |= is_stripe & (places.x > start) & (places.x < stop)
    return painted
