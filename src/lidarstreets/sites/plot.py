"""A stretch of land along one side of a street."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lidarstreets.materials import Label
from lidarstreets.mesh import Mesh, place
from lidarstreets.sites.site import Site
from lidarstreets.streets.ground import Patch
from lidarstreets.streets.styles import Style


@dataclass(frozen=True)
class Plot:
    """A stretch of land along one side of a street.

    Attributes:
        site: the street.
        side: -1 right, 1 left.
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
        """Distance from the middle line of the street at which the plot begins."""
        return self.site.ground.front(self.side)

    @property
    def middle(self) -> float:
        """Middle of the plot along the street."""
        return self.x + self.width / 2

    @property
    def end(self) -> float:
        """Where the plot ends along the street, metres."""
        return self.x + self.width

    @property
    def facing(self) -> float:
        """Yaw of a body whose front, -y, faces the street."""
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
        margin: float = 0.8,
    ) -> None:
        """Put a body at a distance from the middle line of the street; see `Site.put`."""
        self.site.put(mesh, x, self.side * distance, yaw, thing=thing, margin=margin)

    def put_as_is(
        self, mesh: Mesh, x: float, distance: float, yaw: float = 0.0, margin: float = 0.8
    ) -> None:
        """Put a piece of a larger body, which has one brightness; see `put`."""
        t = self.side * distance
        if not self.site.is_free(x, t, margin):
            return

        ground = self.site.ground
        px, py, heading = ground.pose_at(x, t)
        z = float(ground.height(px, py))
        self.site.fixed.append(place(mesh, px, py, z, heading + yaw))

    def pave(self, x: tuple[float, float], distance: tuple[float, float], label: Label) -> None:
        """Make a rectangle ground of another class; `distance` is from the middle line."""
        near, far = sorted((self.side * distance[0], self.side * distance[1]))
        self.site.ground.patches.append(Patch(x, (near, far), label))
