"""A street and the bodies that have been put into it."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from lidarstreets.materials import MOVING, Label
from lidarstreets.mesh import Mesh, place, with_instance, with_labels, with_random_tint
from lidarstreets.streets.ground import Ground

# Metres: half the length of the longest body that may cover the sensor, the height up to which
# bodies are in its way, and how near to it bodies that stand and bodies that move may be.
LONGEST_BODY = 30.0
OBSTACLE_HEIGHT = 2.2
CLEARANCE = 2.1
MOVING_CLEARANCE = 1.4


@dataclass(frozen=True)
class Mover:
    """A body that follows the street at a constant speed and re-enters at the start after the end.

    Attributes:
        mesh: the body, with its moving class and its instance.
        x: street coordinate along the street at time 0.
        t: street coordinate across it.
        speed: metres per second along +x; negative if it comes towards the sensor.
    """

    mesh: Mesh
    x: float
    t: float
    speed: float

    def place(self, ground: Ground, time: float) -> float:
        """Return its x along the street at a time."""
        return (self.x + self.speed * time) % ground.length

    def at(self, ground: Ground, time: float) -> Mesh:
        """Return the body at its place at a time."""
        x, y, yaw = self.pose_at(ground, time)
        return place(self.mesh, x, y, float(ground.height(x, y)), yaw)

    def pose_at(self, ground: Ground, time: float) -> tuple[float, float, float]:
        """Return its (x, y, yaw) at a time."""
        x, y, yaw = ground.lane_pose(self.place(ground, time), self.t)
        if self.speed < 0:
            yaw += np.pi
        return x, y, yaw


@dataclass
class Site:
    """A street and the bodies that have been put into it so far.

    Attributes:
        ground: the street.
        rng: draws everything.
        course: (P, 2) x and y of the sensor at each scan: no body covers them.
        fixed: bodies that stand still.
        movers: bodies that move.
        instances: number of instance ids in use.
    """

    ground: Ground
    rng: np.random.Generator
    course: np.ndarray = field(default_factory=lambda: np.zeros((0, 2)))
    fixed: list[Mesh] = field(default_factory=list)
    movers: list[Mover] = field(default_factory=list)
    instances: int = 0

    def is_free(self, x: float, t: float, margin: float) -> bool:
        """Return whether no side road and no reserved stretch is within the margin of a place."""
        if margin == -np.inf:
            return True
        for side, start, stop in self.ground.reserved:
            if t * side > 0 and start - margin < x < stop + margin:
                return False

        px, py, _ = self.ground.pose_at(x, t)
        distance = self.ground.distance_from_crossings(np.array([px]), np.array([py]))
        return bool(distance[0] > margin)

    def put(
        self,
        mesh: Mesh,
        x: float,
        t: float,
        yaw: float = 0.0,
        *,
        thing: bool = False,
        margin: float = 0.8,
    ) -> None:
        """Put a body on the ground, unless a side road is within the margin.

        Args:
            mesh: the body.
            x, t: street coordinates.
            yaw: radians, relative to the street.
            thing: give it an instance id.
            margin: metres.
        """
        if not self.is_free(x, t, margin):
            return

        px, py, heading = self.ground.pose_at(x, t)
        self.put_at(mesh, px, py, heading + yaw, thing=thing)

    def put_at(self, mesh: Mesh, x: float, y: float, yaw: float, *, thing: bool = False) -> None:
        """Put a body on the ground at x, y, unless it would cover the course of the sensor."""
        if self.covers_course(mesh, x, y, yaw):
            return

        z = float(self.ground.height(x, y))
        body = place(with_random_tint(mesh, self.rng), x, y, z, yaw)
        if thing:
            body = _as_thing(body, self.next_instance())
        self.fixed.append(body)

    def covers_course(self, mesh: Mesh, x: float, y: float, yaw: float) -> bool:
        """Return whether a body that is put at x, y would cover the course of the sensor."""
        return covers(mesh, (x, y, yaw), self.course, CLEARANCE)

    def put_moving(self, mesh: Mesh, x: float, t: float, speed: float) -> None:
        """Add a body that drives or walks; see `Mover`."""
        body = with_labels(with_random_tint(mesh, self.rng), dict(MOVING))
        body = _as_thing(body, self.next_instance())
        self.movers.append(Mover(body, x, t, speed))

    def next_instance(self) -> int:
        """Return a new instance id, from 1."""
        self.instances += 1
        return self.instances


def _as_thing(mesh: Mesh, instance: int) -> Mesh:
    """Return the mesh as one instance, without its parts that have no class, such as dogs."""
    thing = with_instance(mesh, instance)
    is_thing = mesh.label != Label.OTHER_OBJECT
    return replace(thing, instance=np.where(is_thing, thing.instance, 0).astype(np.uint16))


def covers(
    mesh: Mesh, pose: tuple[float, float, float], places: np.ndarray, clearance: float
) -> bool:
    """Return whether a body at (x, y, yaw) is within the clearance of one of (P, 2) places."""
    x, y, yaw = pose
    offset = places - np.array([x, y])
    if not len(offset) or np.abs(offset).sum(axis=1).min() > LONGEST_BODY:
        return False

    # Crowns and arms over the road are no obstacle.
    corners = mesh.triangles.reshape(-1, 3)
    corners = corners[corners[:, 2] < OBSTACLE_HEIGHT, :2]
    if not len(corners):
        return False

    cos = np.cos(yaw)
    sin = np.sin(yaw)
    inside = offset @ np.array([[cos, -sin], [sin, cos]])
    low = corners.min(axis=0) - clearance
    high = corners.max(axis=0) + clearance
    return bool(((inside > low) & (inside < high)).all(axis=1).any())
