"""Fills the land on both sides of a street, plot by plot."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from amvnet.simulation import fixtures, vehicles
from amvnet.simulation.chance import weighted_choice
from amvnet.simulation.materials import Label
from amvnet.simulation.mesh import Mesh
from amvnet.simulation.site import Site
from amvnet.simulation.streets import Patch
from amvnet.simulation.styles import Style

# Shares of what stands along the front of a plot, and of the vehicles in a car park.
BOUNDARIES = {"hedge": 0.40, "wall": 0.16, "board fence": 0.26, "rail fence": 0.18}
CAR_PARK_VEHICLES = {
    vehicles.car: 0.90,
    vehicles.trailer: 0.05,
    vehicles.truck: 0.02,
    vehicles.motorcycle: 0.03,
}
# Metres: length of a segment of a plot's boundary, and width of the drive to a garage.
BOUNDARY_SEGMENT = 2.5
DRIVE_WIDTH = 3.0


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
        return self.site.rng

    @property
    def style(self) -> Style:
        return self.site.ground.style

    @property
    def front(self) -> float:
        """Distance from the middle line of the street at which the plot begins."""
        return self.site.ground.front(self.side)

    @property
    def middle(self) -> float:
        """Middle of the plot along the street."""
        return self.x + self.width / 2

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

    def pave(self, x: tuple[float, float], distance: tuple[float, float], label: Label) -> None:
        """Make a rectangle ground of another class; `distance` is from the middle line."""
        near, far = sorted((self.side * distance[0], self.side * distance[1]))
        self.site.ground.patches.append(Patch(x, (near, far), label))


def fill_plots(site: Site, side: int) -> None:
    """Fill one side of a street (-1 right, 1 left) with plots, one after the other."""
    fillers = (_fill_house, _fill_row, _fill_wood, _fill_field, _fill_car_park)
    rng = site.rng

    x = rng.uniform(0, 8)
    while x < site.ground.length:
        fill = fillers[rng.choice(len(fillers), p=site.ground.style.plots)]
        has_house = fill in (_fill_house, _fill_row)
        width = rng.uniform(12, 24) if has_house else rng.uniform(18, 45)

        plot = Plot(site, side, x, width)
        if site.is_free(plot.middle, side * (plot.front + 8), width / 2 - 1):
            fill(plot)
        else:
            _plant_bushes(plot, 4)
        x += width


def _fill_house(plot: Plot) -> None:
    """Put a house in a garden, with a drive and perhaps a hedge, wall or fence along the front."""
    rng = plot.rng
    style = plot.style

    width = plot.width * rng.uniform(0.45, 0.75)
    depth = rng.uniform(8, 12)
    setback = rng.uniform(*style.setback)
    x = plot.middle + rng.uniform(-1, 1)

    house = fixtures.building(
        rng, width, depth, height=rng.uniform(*style.storeys), flat=rng.random() < 0.15
    )
    middle = plot.front + setback + depth / 2
    plot.put(house, x, middle, rng.normal(scale=0.03), margin=width * 0.5)

    drive_x = plot.x + 0.3 if rng.random() < 0.5 else plot.x + plot.width - 3.3
    _add_drive(plot, drive_x, setback + 5.0)
    if rng.random() < style.fenced:
        _add_boundary(plot, drive_x)
    if rng.random() < 0.5:
        facing = 0.0 if plot.side > 0 else np.pi
        plot.put(fixtures.steps(rng), x, plot.front + setback, facing)

    _plant_garden(plot, setback)
    _add_side_fence(plot, plot.front + setback)


def _plant_garden(plot: Plot, depth: float) -> None:
    """Plant bushes, trees and perhaps thickets in a front garden."""
    rng = plot.rng
    green = plot.style.green

    _plant_bushes(plot, rng.poisson(4.5 * green), depth)
    for _ in range(rng.poisson(0.6 * green)):
        distance = plot.front + rng.uniform(1, depth + 1)
        tree = random_tree(rng, rng.uniform(3, 8))
        plot.put(tree, plot.random_x(), distance)

    if rng.random() < 0.3 * green:
        overgrown = replace(plot, width=plot.width * 0.7)
        plant_thickets(overgrown, plot.front + rng.uniform(1.8, 3.0))


def _add_drive(plot: Plot, x: float, depth: float) -> None:
    """Pave a way to a garage, sometimes with a car on it."""
    rng = plot.rng
    front = plot.front

    label = Label.PARKING if rng.random() < 0.2 else Label.SIDEWALK
    plot.pave((x, x + DRIVE_WIDTH), (front, front + depth), label)

    middle = x + DRIVE_WIDTH / 2
    if rng.random() < 0.4:
        car = vehicles.car(rng)
        distance = front + min(3.0, depth / 2)
        plot.put(car, middle, distance, plot.side * np.pi / 2, thing=True, margin=3.0)
    if rng.random() < 0.4:
        plot.put(fixtures.shed(rng), middle, front + depth + 3.0, margin=4.0)


def _add_boundary(plot: Plot, drive_x: float | None = None) -> None:
    """Put a hedge, wall or fence along the front of a plot, with a gap for its drive if any."""
    rng = plot.rng

    kind = weighted_choice(rng, BOUNDARIES)
    height = rng.uniform(0.7, 1.9)
    half = BOUNDARY_SEGMENT / 2

    for x in np.arange(plot.x + half, plot.x + plot.width, BOUNDARY_SEGMENT):
        if drive_x is not None and drive_x - half < x < drive_x + DRIVE_WIDTH + half:
            continue

        segment = _boundary_segment(rng, kind, height)
        plot.put(segment, x, plot.front + 0.5, margin=1.5)


def _boundary_segment(rng: np.random.Generator, kind: str, height: float) -> Mesh:
    if kind == "hedge":
        return fixtures.hedge(rng, BOUNDARY_SEGMENT, height)
    if kind == "wall":
        return fixtures.wall(BOUNDARY_SEGMENT, height * 0.8)
    if kind == "board fence":
        gap = 0.1 if height > 1.3 else 0.4
        return fixtures.board_fence(BOUNDARY_SEGMENT, height, gap)

    return fixtures.rail_fence(BOUNDARY_SEGMENT, height)


def _add_side_fence(plot: Plot, house_front: float) -> None:
    """Put a hedge or a fence between a garden and the next one, past the front of the house."""
    rng = plot.rng
    if rng.random() > plot.style.fenced:
        return

    is_hedge = rng.random() < 0.4
    height = rng.uniform(1.0, 1.9)
    for distance in np.arange(plot.front + 1.8, house_front + 8, 2.5):
        if is_hedge:
            segment = fixtures.hedge(rng, 2.5, height)
        else:
            segment = fixtures.board_fence(2.5, height, 0.15)
        plot.put(segment, plot.x, distance, np.pi / 2, margin=2.0)


def _fill_row(plot: Plot) -> None:
    """Put a house that fills the width of the plot, with a paved front."""
    rng = plot.rng
    style = plot.style
    front = plot.front

    setback = rng.uniform(*style.setback)
    depth = rng.uniform(9, 14)

    house = fixtures.building(
        rng, plot.width, depth, height=rng.uniform(*style.storeys), flat=rng.random() < 0.4
    )
    plot.put(house, plot.middle, front + setback + depth / 2, margin=plot.width * 0.5)

    label = Label.SIDEWALK if rng.random() < 0.7 else Label.OTHER_GROUND
    plot.pave((plot.x, plot.x + plot.width), (front, front + setback + 0.5), label)
    if rng.random() < 0.4:
        _park_two_wheelers(plot)


def _park_two_wheelers(plot: Plot) -> None:
    """Put up to three bicycles or motorcycles side by side at the front of a plot."""
    rng = plot.rng

    make = vehicles.bicycle if rng.random() < 0.75 else vehicles.motorcycle
    for index in range(int(rng.integers(1, 4))):
        two_wheeler = make(rng)
        x = plot.x + plot.width * 0.3 + 0.6 * index
        yaw = np.pi / 2 + rng.normal(scale=0.1)
        plot.put(two_wheeler, x, plot.front - 0.4, yaw, thing=True)


def _fill_wood(plot: Plot) -> None:
    """Plant trees and undergrowth."""
    rng = plot.rng
    front = plot.front

    depth = rng.uniform(12, 28)
    density = rng.uniform(0.006, 0.022)  # trees per square metre
    for _ in range(rng.poisson(density * plot.width * depth)):
        tree = random_tree(rng, rng.uniform(4, 13))
        plot.put(tree, plot.random_x(), front + rng.uniform(1.5, depth))

    _plant_bushes(plot, rng.poisson(density * plot.width * 14), depth)
    if rng.random() < 0.75:
        plant_thickets(plot, front + rng.uniform(1.5, 10))
    if rng.random() < 0.5:
        for x in np.arange(plot.x, plot.x + plot.width, 3.0):
            plot.put(fixtures.tall_grass(rng, 3.0), x, front + rng.uniform(0.5, 3))


def _fill_field(plot: Plot) -> None:
    """Leave open ground: a meadow or gravel, with a few bushes, perhaps a fence and a barn."""
    rng = plot.rng
    front = plot.front

    if rng.random() < 0.35:
        gravel = (front + 1, front + rng.uniform(6, 25))
        plot.pave((plot.x, plot.x + plot.width), gravel, Label.OTHER_GROUND)
    if rng.random() < plot.style.fenced * 0.6:
        _add_boundary(plot)

    _plant_bushes(plot, rng.poisson(2), 12)
    if rng.random() < 0.75:
        plant_thickets(plot, front + rng.uniform(7, 26))
    if rng.random() < 0.2:
        barn = fixtures.gable_barn(rng, rng.uniform(8, 14), rng.uniform(10, 16), rng.uniform(3, 5))
        plot.put(barn, plot.middle, front + 22, margin=9.0)
    if rng.random() < 0.3:
        tree = fixtures.tree(rng, rng.uniform(6, 12))
        plot.put(tree, plot.x + plot.width * 0.7, front + rng.uniform(3, 10))


def _fill_car_park(plot: Plot) -> None:
    """Pave a lot and put two rows of vehicles on it."""
    rng = plot.rng
    front = plot.front

    plot.pave((plot.x + 1, plot.x + plot.width - 1), (front + 0.5, front + 20), Label.PARKING)

    chance = plot.style.parked + 0.2
    for row in (4.0, 14.5):
        for x in np.arange(plot.x + 3, plot.x + plot.width - 3, 2.8):
            make = weighted_choice(rng, CAR_PARK_VEHICLES)
            is_taken = rng.random() < chance
            has_room = make is not vehicles.truck or row > 10  # trucks are too long for the front
            if is_taken and has_room:
                yaw = rng.choice([-1, 1]) * np.pi / 2 + rng.normal(scale=0.03)
                plot.put(make(rng), x, front + row, yaw, thing=True, margin=3.0)


def plant_thickets(plot: Plot, distance: float) -> None:
    """Plant undergrowth in a line along the street, its height changing slowly, with gaps."""
    rng = plot.rng

    height = rng.uniform(1.2, 4.5)
    for x in np.arange(plot.x + 2, plot.x + plot.width, 4.0):
        height = float(np.clip(height + rng.normal(scale=0.5), 0.8, 6.0))
        if rng.random() < 0.9:
            thicket = fixtures.thicket(rng, 4.0, height)
            plot.put(thicket, x, distance + rng.normal(scale=0.5), margin=2.5)


def _plant_bushes(plot: Plot, count: int, depth: float = 6.0) -> None:
    rng = plot.rng
    for _ in range(count):
        distance = plot.front + rng.uniform(0.8, max(depth, 1.5))
        bush = fixtures.bush(rng, rng.uniform(0.35, 1.6))
        plot.put(bush, plot.random_x(), distance)


def random_tree(rng: np.random.Generator, height: float, fine: bool = True) -> Mesh:
    """Return a broad-leaved tree or a fir."""
    if rng.random() < 0.2:
        return fixtures.conifer(rng, height)
    return fixtures.tree(rng, height, fine)
