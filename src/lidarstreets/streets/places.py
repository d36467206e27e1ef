"""Compute where places lie in a street: their distances from its roads, kerbs and islands."""

from dataclasses import dataclass

import numpy as np

from lidarstreets.streets.middle_line import MiddleLine
from lidarstreets.streets.plans import Plan, rounded_union

PARKING_END = 5.0  # distance from a side road at which the parking lane ends, metres
PARKING_TAPER = 1.5  # length over which the parking lane widens from its end, metres
BAY_GAP = 2.0  # length of an island between two parking bays, metres
ROUNDABOUT_CORNER = 6.0  # radius of the kerb between a street and its roundabout, metres


@dataclass(frozen=True)
class Places:
    """Where places lie in a street. All arrays have one shape; distances are in metres.

    Attributes:
        x, t: street coordinates.
        road: distance from the edge of the nearest carriageway; negative on the carriageway.
        crossing: distance from the edge of the nearest side road or roundabout; negative on it.
        branch: index of the nearest side road; -1 if the street itself is nearer.
        kerb: distance from the kerb; negative on the road.
        island: distance from the edge of the nearest island; negative on the island.
    """

    x: np.ndarray
    t: np.ndarray
    road: np.ndarray
    crossing: np.ndarray
    branch: np.ndarray
    kerb: np.ndarray
    island: np.ndarray


def locate(line: MiddleLine, plan: Plan, x: np.ndarray, y: np.ndarray) -> Places:
    """Return where the places x, y in metres, arrays of one shape, lie in a street."""
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

    # The parking lane ends before a side road, and where an island interrupts it.
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
    """Return where no island interrupts the parking lanes, in the shape of `along`.

    Args:
        along: x along the street, metres.
        period: distance from island to island, metres; infinite if there are none.
    """
    if not np.isfinite(period):
        return np.ones(np.shape(along), dtype=bool)

    return along % period > BAY_GAP
