"""What has been put into a street so far, and what moves along it."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from amvnet.simulation.materials import MOVING
from amvnet.simulation.mesh import Mesh, named, place, relabelled, tinted
from amvnet.simulation.streets import Ground


@dataclass(frozen=True)
class Mover:
    """Something that follows the street at a steady speed; it enters again at the start after the end.

    Attributes:
        mesh: the body, with its moving class and its instance.
        x: place along the street at time 0.
        t: signed distance from the middle line.
        speed: metres per second along +x; negative comes towards the sensor.
    """

    mesh: Mesh
    x: float
    t: float
    speed: float

    def at(self, ground: Ground, time: float) -> Mesh:
        """The body where it is at a time."""
        x, y, yaw = ground.at((self.x + self.speed * time) % ground.length, self.t)
        return place(
            self.mesh, x, y, float(ground.height(x, y)), yaw + (np.pi if self.speed < 0 else 0)
        )


@dataclass
class Site:
    """What has been put into a street so far."""

    ground: Ground
    rng: np.random.Generator
    fixed: list[Mesh] = field(default_factory=list)
    movers: list[Mover] = field(default_factory=list)
    instances: int = 0

    def free(self, x: float, t: float, margin: float) -> bool:
        """True where no side road is within the margin."""
        px, py, _ = self.ground.at(x, t)
        return bool(
            self.ground.beside_crossing(np.array([px]), np.array([py]), np.array([t]))[0] > margin
        )

    def put(
        self,
        mesh: Mesh,
        x: float,
        t: float,
        yaw: float = 0.0,
        thing: bool = False,
        margin: float = 0.8,
    ) -> None:
        """Stands a body on the ground, turned relative to the street; left out where a side road runs."""
        if not self.free(x, t, margin):
            return
        px, py, heading = self.ground.at(x, t)
        body = place(
            tinted(mesh, self.rng), px, py, float(self.ground.height(px, py)), heading + yaw
        )
        self.fixed.append(named(body, self.next_instance()) if thing else body)

    def next_instance(self) -> int:
        """A new instance id, from 1."""
        self.instances += 1
        return self.instances

    def moving(self, mesh: Mesh, x: float, t: float, speed: float) -> None:
        """Adds something that drives or walks."""
        body = named(relabelled(tinted(mesh, self.rng), dict(MOVING)), self.next_instance())
        self.movers.append(Mover(body, x, t, speed))
