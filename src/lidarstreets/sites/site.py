"""Put bodies into a street and onto the land along it."""

from dataclasses import dataclass, field, replace

import numpy as np

from lidarstreets.materials import MOVING, Label
from lidarstreets.mesh import Mesh, place, with_labels, with_random_tint
from lidarstreets.streets.ground import Ground
from lidarstreets.streets.plans import Patch
from lidarstreets.streets.styles import Style

HALF_LONGEST_BODY = 30.0  # half the length of the longest body that may cover the sensor, metres
OBSTACLE_HEIGHT = 2.2  # height up to which bodies are in the way of the sensor, metres
CLEARANCE = 2.1  # smallest distance of the sensor from bodies that stand, metres
MOVING_CLEARANCE = 1.4  # smallest distance of the sensor from bodies that move, metres


@dataclass(frozen=True)
class Mover:
    """A body that follows the street at a constant speed.

    At the end of the street, it re-enters at the start.

    Attributes:
        mesh: the body, with its moving class and its instance.
        x: its street coordinate along the street at time 0, metres.
        t: its street coordinate across the street, metres.
        speed: metres per second along +x; negative if it comes towards the sensor.
    """

    mesh: Mesh
    x: float
    t: float
    speed: float

    def street_x(self, ground: Ground, time: float) -> float:
        """Return its x along the street at a time in seconds."""
        return (self.x + self.speed * time) % ground.length

    def mesh_at(self, ground: Ground, time: float) -> Mesh:
        """Return the body where it is at a time in seconds."""
        x, y, yaw = self.pose_at(ground, time)
        return place(self.mesh, x, y, float(ground.height(x, y)), yaw)

    def pose_at(self, ground: Ground, time: float) -> tuple[float, float, float]:
        """Return its (x, y, yaw) at a time in seconds, in metres and radians."""
        x, y, yaw = ground.lane_pose(self.street_x(ground, time), self.t)
        if self.speed < 0:
            yaw += np.pi
        return x, y, yaw


@dataclass
class Site:
    """A street and the bodies that have been put into it so far.

    Attributes:
        ground: the street.
        rng: draws everything in the street.
        course: (P, 2) x and y of the sensor at each of P scans, metres; no body covers them. It is
            None until it is drawn, and then no body can be put.
        fixed: bodies that stand still.
        movers: bodies that move.
        instances: number of instance ids in use.
    """

    ground: Ground
    rng: np.random.Generator
    course: np.ndarray | None = None
    fixed: list[Mesh] = field(default_factory=list)
    movers: list[Mover] = field(default_factory=list)
    instances: int = 0

    def is_free(self, x: float, t: float, margin: float | None) -> bool:
        """Return whether a place x, t is farther than `margin` metres from what must stay free.

        Side roads and reserved stretches of the street must stay free, unless `margin` is None.
        """
        if margin is None:
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
        margin: float | None = 0.8,
    ) -> None:
        """Put a body at street coordinates, unless the place is not free.

        Args:
            x: street coordinate along the street, metres.
            t: street coordinate across the street, metres.
            yaw: its direction relative to the street, radians.
            thing: whether it gets an instance id.
            margin: smallest distance from side roads and reserved stretches, metres; see `is_free`.
        """
        if not self.is_free(x, t, margin):
            return

        px, py, heading = self.ground.pose_at(x, t)
        self.put_at(mesh, px, py, heading + yaw, thing=thing)

    def put_at(self, mesh: Mesh, x: float, y: float, yaw: float, *, thing: bool = False) -> None:
        """Put a body on the ground at x, y, unless it would cover the course of the sensor.

        The yaw is in the frame of the street's mesh, in radians. A `thing` gets an instance id.

        Raises:
            ValueError: if the course is not drawn yet.
        """
        if self.course is None:
            raise ValueError("expected the course of the sensor before any body, found none")
        if covers(mesh, (x, y, yaw), self.course, CLEARANCE):
            return

        z = float(self.ground.height(x, y))
        body = place(with_random_tint(mesh, self.rng), x, y, z, yaw)
        if thing:
            body = self._as_thing(body)
        self.fixed.append(body)

    def put_moving(self, mesh: Mesh, x: float, t: float, speed: float) -> None:
        """Add a body that drives or walks; see `Mover`."""
        body = with_labels(with_random_tint(mesh, self.rng), dict(MOVING))
        self.movers.append(Mover(self._as_thing(body), x, t, speed))

    def _as_thing(self, mesh: Mesh) -> Mesh:
        """Return the mesh as a new instance, without parts that have no class, such as dogs."""
        self.instances += 1
        instance = np.where(mesh.label == Label.OTHER_OBJECT, 0, self.instances)
        return replace(mesh, instance=instance.astype(np.uint16))


@dataclass(frozen=True)
class Plot:
    """A stretch of land along one side of a street.

    Attributes:
        site: the street.
        side: side of the street: -1 is right, 1 is left.
        x: where the plot begins along the street, metres.
        width: its width along the street, metres.
    """

    site: Site
    side: int
    x: float
    width: float

    @property
    def rng(self) -> np.random.Generator:
        """The generator of the site, which draws everything."""
        return self.site.rng

    @property
    def style(self) -> Style:
        """The numbers of the street."""
        return self.site.ground.style

    @property
    def front(self) -> float:
        """Distance from the middle line of the street at which the plot begins, metres."""
        return self.site.ground.front(self.side)

    @property
    def middle(self) -> float:
        """Middle of the plot along the street, metres."""
        return self.x + self.width / 2

    @property
    def end(self) -> float:
        """Where the plot ends along the street, metres."""
        return self.x + self.width

    @property
    def facing(self) -> float:
        """Yaw of a body whose front, -y, faces the street, radians relative to the street."""
        return 0.0 if self.side > 0 else np.pi

    def random_x(self) -> float:
        """Draw a place along the street within the plot."""
        return self.x + self.rng.uniform(0, self.width)

    def put(
        self,
        mesh: Mesh,
        x: float,
        distance: float,
        yaw: float = 0.0,
        *,
        thing: bool = False,
        margin: float | None = 0.8,
    ) -> None:
        """Put a body `distance` metres from the middle line of the street; see `Site.put`."""
        self.site.put(mesh, x, self.side * distance, yaw, thing=thing, margin=margin)

    def put_piece(
        self, mesh: Mesh, x: float, distance: float, yaw: float = 0.0, margin: float | None = 0.8
    ) -> None:
        """Put a piece of a larger body; see `put`. Its tint stays like the tint of other pieces."""
        t = self.side * distance
        if self.site.is_free(x, t, margin):
            px, py, heading = self.site.ground.pose_at(x, t)
            z = float(self.site.ground.height(px, py))
            self.site.fixed.append(place(mesh, px, py, z, heading + yaw))

    def pave(self, x: tuple[float, float], distance: tuple[float, float], label: Label) -> None:
        """Give a rectangle of the ground another class.

        Args:
            x: from and to, along the street, metres.
            distance: from and to, metres from the middle line.
            label: class of the ground.
        """
        near, far = sorted((self.side * distance[0], self.side * distance[1]))
        self.site.ground.patches.append(Patch(x, (near, far), label))

    def overgrow(self, near: float, far: float) -> None:
        """Give the ground between two distances from the middle line the class vegetation.

        What `pave` paves, earlier or later, lies above it.
        """
        t = sorted((self.side * near, self.side * far))
        patch = Patch((self.x, self.end), (t[0], t[1]), Label.VEGETATION)
        self.site.ground.patches.insert(0, patch)


def covers(
    mesh: Mesh, pose: tuple[float, float, float], places: np.ndarray, clearance: float
) -> bool:
    """Return whether a body at (x, y, yaw) is nearer than `clearance` metres to any of P places.

    The places are (P, 2) x and y in metres. Parts of the body above `OBSTACLE_HEIGHT` do not count.
    """
    x, y, yaw = pose
    offset = places - np.array([x, y])
    if not len(offset) or np.abs(offset).sum(axis=1).min() > HALF_LONGEST_BODY:
        return False

    # Crowns of trees and arms of lamps over the road are no obstacles.
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
