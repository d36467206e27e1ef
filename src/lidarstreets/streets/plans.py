"""Define the plan of a street: side roads, roundabouts and islands as distances from an edge."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lidarstreets.materials import Label
from lidarstreets.streets.styles import Strip, Style, width_of

# Tangent of the change of direction after which a bent side road continues straight.
LARGEST_TURN = 0.9


@dataclass(frozen=True)
class SideRoad:
    """A road that leaves the street on one side.

    Attributes:
        x, y: where its middle line meets the middle line of the street, metres.
        street_x: x of this place along the street, metres.
        yaw: its direction there, away from the street, radians.
        side: the side on which it leaves the street: -1 is right, 1 is left.
        width: width of the carriageway, metres.
        bend: curvature in 1 / metres, positive to the left.
        length: distance of its end from the middle line of the street, metres; may be infinite.
        turning: radius of the turning circle at its end, metres; 0 if there is none.
        corner: radius of the kerb at the junction, metres.
        strips: what lies along each of its kerbs, from the kerb outwards.
    """

    x: float
    y: float
    street_x: float
    yaw: float
    side: int
    width: float
    bend: float = 0.0
    length: float = np.inf
    turning: float = 0.0
    corner: float = 4.0
    strips: tuple[Strip, ...] = ()

    def coordinates(
        self, x: NDArray[np.float64], y: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return the coordinates of places x, y on the road; all arrays have one shape.

        Returns:
            Distances along the middle line of the road, and to the left of it, metres.
        """
        cos = np.cos(self.yaw)
        sin = np.sin(self.yaw)
        along = (x - self.x) * cos + (y - self.y) * sin
        across = (y - self.y) * cos - (x - self.x) * sin

        if self.bend:
            bent = np.clip(along, 0, LARGEST_TURN / abs(self.bend))
            tangent = self.bend * bent
            middle = 0.5 * tangent * bent + tangent * (along - bent)
            across = (across - middle) / np.sqrt(1 + tangent**2)
        return along, across

    def distance(self, x: NDArray[np.float64], y: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the distance of places x, y from the edge of the road; negative on the road."""
        along, across = self.coordinates(x, y)
        distance = np.maximum(np.abs(across) - self.width / 2, -along)
        if np.isfinite(self.length):
            distance = np.maximum(distance, along - self.length)
        if self.turning:
            circle = np.hypot(along - self.length, across) - self.turning
            distance = np.minimum(distance, circle)
        return distance

    def pose_at(self, along: float, across: float) -> tuple[float, float, float]:
        """Return (x, y, yaw) at coordinates of the road, in metres and radians.

        The yaw is the direction of the road away from the street.
        """
        bent = min(along, LARGEST_TURN / abs(self.bend)) if self.bend else along
        tangent = self.bend * bent
        middle = 0.5 * tangent * bent + tangent * (along - bent)
        turn = float(np.arctan(tangent))

        forward = along - across * np.sin(turn)
        left = middle + across * np.cos(turn)
        x = self.x + forward * np.cos(self.yaw) - left * np.sin(self.yaw)
        y = self.y + forward * np.sin(self.yaw) + left * np.cos(self.yaw)
        return float(x), float(y), self.yaw + turn


@dataclass(frozen=True)
class Roundabout:
    """A roundabout on the middle line of the street.

    Attributes:
        x, y: its centre, metres.
        street_x: x of its centre along the street, metres.
        radius: outer radius of the ring, metres.
        island: radius of the island in its middle, metres.
        label: class of the island.
    """

    x: float
    y: float
    street_x: float
    radius: float
    island: float
    label: Label

    @property
    def ring(self) -> float:
        """Radius of the circle on which vehicles drive, metres."""
        return (self.radius + self.island) / 2

    def distance(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """Return the distance of places x, y from the outer edge of the ring; negative inside."""
        return np.hypot(x - self.x, y - self.y) - self.radius

    def island_distance(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """Return the distance of places x, y from the edge of the island; negative on it."""
        return np.hypot(x - self.x, y - self.y) - self.island


@dataclass(frozen=True)
class Patch:
    """A rectangle of other ground, in street coordinates.

    Attributes:
        x: from and to, along the street, metres.
        t: from and to, across the street, metres.
        label: class of the ground.
    """

    x: tuple[float, float]
    t: tuple[float, float]
    label: Label


class Island(Patch):
    """A patch on the road that is raised and has round ends."""

    def distance(self, along: np.ndarray, t: np.ndarray) -> np.ndarray:
        """Return the distance of street coordinates from its edge, metres; negative on it."""
        radius = min(self.x[1] - self.x[0], self.t[1] - self.t[0]) / 2
        half_x = (self.x[1] - self.x[0]) / 2 - radius
        half_t = (self.t[1] - self.t[0]) / 2 - radius

        outside_x = np.maximum(np.abs(along - sum(self.x) / 2) - half_x, 0)
        outside_t = np.maximum(np.abs(t - sum(self.t) / 2) - half_t, 0)
        return np.hypot(outside_x, outside_t) - radius


@dataclass(frozen=True)
class Plan:
    """The plan of one street; lengths are in metres.

    Attributes:
        style: the numbers of the street.
        start, end: x where the street begins and ends; infinite if that is out of sight.
        roundabout: the roundabout, or None if there is none.
        crossings: the side roads.
        islands: the islands in the middle of the road.
        humps: (H, 2) x along the street and height of the humps of the road.
        crosswalks: x from and to of each zebra crossing.
    """

    style: Style
    start: float
    end: float
    roundabout: Roundabout | None
    crossings: tuple[SideRoad, ...]
    islands: tuple[Island, ...]
    humps: np.ndarray
    crosswalks: tuple[tuple[float, float], ...]


def rounded_union(a: np.ndarray, b: np.ndarray, radius: float) -> np.ndarray:
    """Return the distance from the union of two areas, whose inner corners are rounded.

    Args:
        a, b: distances from the edges of the two areas, negative inside; arrays of one shape.
        radius: radius of the corners, in the unit of the distances.
    """
    inside_a = np.maximum(radius - a, 0)
    inside_b = np.maximum(radius - b, 0)
    corner = radius - np.hypot(inside_a, inside_b)
    nearest = np.minimum(a, b)
    is_corner = (a > 0) & (b > 0) & (nearest < radius)
    return np.where(is_corner, corner, nearest)


def strip_at(
    strips: Sequence[Strip], kerb: np.ndarray, beyond: Label
) -> tuple[np.ndarray, np.ndarray]:
    """Return the class of the ground at N distances from a kerb.

    Args:
        strips: the strips along the kerb, from the kerb outwards.
        kerb: (N,) distances from the kerb, metres.
        beyond: class of the ground behind the last strip.

    Returns:
        (N,) uint16 class ids; and (N,) distances from the outer edge of the last strip in metres,
        which are negative on the strips.
    """
    label = np.full(np.shape(kerb), beyond, dtype=np.uint16)
    outer = width_of(strips)
    edge = outer
    for strip in reversed(strips):
        label[kerb < edge] = strip.label
        edge -= strip.width
    return label, kerb - outer
