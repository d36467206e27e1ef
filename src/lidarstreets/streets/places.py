"""Where positions lie in a street: their distances from its roads, kerbs and islands."""

from dataclasses import dataclass

import numpy as np

from lidarstreets.streets.middle_line import MiddleLine
from lidarstreets.streets.plans import Plan, rounded_union

# Metres: the parking lane ends this far from a side road, over the second distance.
PARKING_END = 5.0
PARKING_TAPER = 1.5
BAY_GAP = 2.0  # metres: length of an island between two parking bays
ROUNDABOUT_CORNER = 6.0  # metres: radius of the kerb between a street and its roundabout


@dataclass(frozen=True)
class Places:
    """Where positions lie in a street; all arrays have one shape, distances are in metres.

    Attributes:
        x, t: street coordinates.
        road: distance from the edge of the nearest carriageway; negative on it.
        crossing: distance from the edge of the nearest side road; negative on it.
        branch: index of that side road; -1 if the street itself is nearer.
        kerb: distance from the kerb; negative on the side of the road.
        island: distance from the edge of the nearest island; negative on it.
    """

    x: np.ndarray
    t: np.ndarray
    road: np.ndarray
    crossing: np.ndarray
    branch: np.ndarray
    kerb: np.ndarray
    island: np.ndarray


def locate(line: MiddleLine, plan: Plan, x: np.ndarray, y: np.ndarray) -> Places:
    """Return where positions x, y, arrays of one shape, lie in a street."""
    style = plan.style
    along, t = line.street_coordinates(x, y)
    ends = np.maximum(plan.start - along, along - plan.end)
    road = np.maximum(np.abs(t) - style.road / 2, ends)

    crossing = np.full(np.shape(x), np.inf)
    branch = np.full(np.shape(x), -1)

    distances = []
    for index, side_road in enumerate(plan.crossings):
        distance = side_road.distance(x, y)
        distances.append(distance)
        branch = np.where(distance < crossing, index, branch)
        crossing = np.minimum(crossing, distance)

    # The parking lane ends short of a side road, and where islands interrupt it.
    parking = np.where(t < 0, style.parking[0], style.parking[1])
    kerb = road
    if parking.any():
        parking = parking * np.clip((crossing - PARKING_END) / PARKING_TAPER, 0, 1)
        kerb = road - np.where(is_bay(along, style.parking_period), parking, 0)

    branch[np.minimum(road, kerb) < crossing] = -1
    for side_road, distance in zip(plan.crossings, distances, strict=True):
        kerb = rounded_union(kerb, distance, side_road.corner)
        road = rounded_union(road, distance, side_road.corner)

    island = np.full(np.shape(x), np.inf)
    for item in plan.islands:
        island = np.minimum(island, item.distance(along, t))
    if plan.roundabout:
        ring = plan.roundabout.distance(x, y)
        crossing = np.minimum(crossing, ring)
        kerb = rounded_union(kerb, ring, ROUNDABOUT_CORNER)
        road = rounded_union(road, ring, ROUNDABOUT_CORNER)
        island = np.minimum(island, plan.roundabout.island_distance(x, y))
    return Places(
        x=along, t=t, road=road, crossing=crossing, branch=branch, kerb=kerb, island=island
    )


def is_bay(along: np.ndarray, period: float) -> np.ndarray:
    """Return whether no island interrupts the parking lanes at x; there is one each `period`."""
    if not np.isfinite(period):
        return np.ones(np.shape(along), dtype=bool)

    return along % period > BAY_GAP
