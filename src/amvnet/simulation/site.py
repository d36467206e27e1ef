"""A street and the bodies that have been put into it."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from amvnet.simulation.materials import MOVING
from amvnet.simulation.mesh import Mesh, place, with_instance, with_labels, with_random_tint
from amvnet.simulation.streets import Ground


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

    def at(self, ground: Ground, time: float) -> Mesh:
        """Return the body at its place at a time."""
        x, y, yaw = ground.pose_at((self.x + self.speed * time) % ground.length, self.t)
        if self.speed < 0:
            yaw += np.pi
        return place(self.mesh, x, y, float(ground.height(x, y)), yaw)


@dataclass
class Site:
    """A street and the bodies that have been put into it so far."""

    ground: Ground
    rng: np.random.Generator
    fixed: list[Mesh] = field(default_factory=list)
    movers: list[Mover] = field(default_factory=list)
    instances: int = 0

    def is_free(self, x: float, t: float, margin: float) -> bool:
        """Return whether no side road is within the margin of a place."""
        px, py, _ = self.ground.pose_at(x, t)
        distance = self.ground.distance_from_crossings(
            np.array([px]), np.array([py]), np.array([t])
        )
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
        z = float(self.ground.height(px, py))
        body = place(with_random_tint(mesh, self.rng), px, py, z, heading + yaw)
        if thing:
            body = with_instance(body, self.next_instance())
        self.fixed.append(body)

    def put_moving(self, mesh: Mesh, x: float, t: float, speed: float) -> None:
        """Add a body that drives or walks; see `Mover`."""
        body = with_labels(with_random_tint(mesh, self.rng), dict(MOVING))
        body = with_instance(body, self.next_instance())
        self.movers.append(Mover(body, x, t, speed))

    def next_instance(self) -> int:
        """Return a new instance id, from 1."""
        self.instances += 1
        return self.instances
