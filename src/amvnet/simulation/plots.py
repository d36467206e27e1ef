"""Fills the land on both sides of a street, plot by plot."""

from __future__ import annotations

import numpy as np

from amvnet.simulation import fixtures, vehicles
from amvnet.simulation.materials import Label
from amvnet.simulation.mesh import Mesh
from amvnet.simulation.site import Site
from amvnet.simulation.streets import Patch


def fill_plots(site: Site, side: int) -> None:
    """Houses, rows, woods, fields and car parks along one side (-1 right, 1 left), one after the other."""
    rng, style = site.rng, site.ground.style
    fillers = (_house, _row, _wood, _field, _car_park)
    x = rng.uniform(0, 8)
    while x < site.ground.length:
        kind = rng.choice(5, p=style.plots)
        width = rng.uniform(12, 24) if kind < 2 else rng.uniform(18, 45)
        if site.free(x + width / 2, side * (site.ground.front(side) + 8), width / 2 - 1):
            fillers[kind](site, side, x, width)
        else:
            _bushes(site, side, x, width, 4)
        x += width


def _house(site: Site, side: int, x: float, width: float) -> None:
    """A house in its garden, with a drive and something along the front."""
    rng, style, front = site.rng, site.ground.style, site.ground.front(side)
    wide, deep = width * rng.uniform(0.45, 0.75), rng.uniform(8, 12)
    setback = rng.uniform(*style.setback)
    middle = x + width / 2 + rng.uniform(-1, 1)
    body = fixtures.building(rng, wide, deep, rng.uniform(*style.storeys), rng.random() < 0.15)
    site.put(
        body, middle, side * (front + setback + deep / 2), rng.normal(scale=0.03), margin=wide * 0.5
    )
    drive = x + 0.3 if rng.random() < 0.5 else x + width - 3.3
    _drive(site, side, drive, setback + 5.0)
    if rng.random() < style.fenced:
        _boundary(site, side, x, width, drive)
    if rng.random() < 0.5:
        site.put(fixtures.steps(rng), middle, side * (front + setback), 0.0 if side > 0 else np.pi)
    _bushes(site, side, x, width, rng.poisson(4.5 * style.green), setback)
    for _ in range(rng.poisson(0.6 * style.green)):
        spot = side * (front + rng.uniform(1, setback + 1))
        site.put(any_tree(rng, rng.uniform(3, 8)), x + rng.uniform(0, width), spot)
    if rng.random() < 0.3 * style.green:
        thickets(site, side, x, width * 0.7, front + rng.uniform(1.8, 3.0))
    _fence_between(site, side, x, front + setback)


def _drive(site: Site, side: int, x: float, depth: float) -> None:
    """A paved way to a garage, with a car on it now and then."""
    rng, front = site.rng, site.ground.front(side)
    label = Label.PARKING if rng.random() < 0.2 else Label.SIDEWALK
    near, far = sorted((side * front, side * (front + depth)))
    site.ground.patches.append(Patch((x, x + 3.0), (near, far), label))
    if rng.random() < 0.4:
        site.put(
            vehicles.car(rng),
            x + 1.5,
            side * (front + min(3.0, depth / 2)),
            side * np.pi / 2,
            True,
            3.0,
        )
    if rng.random() < 0.4:
        site.put(fixtures.shed(rng), x + 1.5, side * (front + depth + 3.0), margin=4.0)


def _boundary(site: Site, side: int, x: float, width: float, gap: float) -> None:
    """A hedge, wall or fence along a plot's front, open at its drive."""
    rng, offset = site.rng, site.ground.front(side) + 0.5
    kind, height, length = rng.choice(4, p=[0.40, 0.16, 0.26, 0.18]), rng.uniform(0.7, 1.9), 2.5
    for spot in np.arange(x + length / 2, x + width, length):
        if gap - length / 2 < spot < gap + 3.0 + length / 2:
            continue
        makers = (
            lambda: fixtures.hedge(rng, length, height),
            lambda: fixtures.wall(length, height * 0.8),
            lambda: fixtures.board_fence(length, height, 0.1 if height > 1.3 else 0.4),
            lambda: fixtures.rail_fence(length, height),
        )
        site.put(makers[kind](), spot, side * offset, margin=1.5)


def _fence_between(site: Site, side: int, x: float, deep: float) -> None:
    """What parts a garden from the next one, across the street's direction."""
    rng = site.rng
    if rng.random() > site.ground.style.fenced:
        return
    leafy, height = rng.random() < 0.4, rng.uniform(1.0, 1.9)
    for t in np.arange(site.ground.front(side) + 1.8, deep + 8, 2.5):
        segment = (
            fixtures.hedge(rng, 2.5, height) if leafy else fixtures.board_fence(2.5, height, 0.15)
        )
        site.put(segment, x, side * t, np.pi / 2, margin=2.0)


def _row(site: Site, side: int, x: float, width: float) -> None:
    """Houses that touch each other, with a paved front."""
    rng, style, front = site.rng, site.ground.style, site.ground.front(side)
    setback, deep = rng.uniform(*style.setback), rng.uniform(9, 14)
    body = fixtures.building(rng, width, deep, rng.uniform(*style.storeys), rng.random() < 0.4)
    site.put(body, x + width / 2, side * (front + setback + deep / 2), margin=width * 0.5)
    near, far = sorted((side * front, side * (front + setback + 0.5)))
    label = Label.SIDEWALK if rng.random() < 0.7 else Label.OTHER_GROUND
    site.ground.patches.append(Patch((x, x + width), (near, far), label))
    if rng.random() < 0.4:
        bike = vehicles.bicycle if rng.random() < 0.75 else vehicles.motorcycle
        for step in range(int(rng.integers(1, 4))):
            spot = x + width * 0.3 + 0.6 * step
            site.put(bike(rng), spot, side * (front - 0.4), np.pi / 2 + rng.normal(scale=0.1), True)


def _wood(site: Site, side: int, x: float, width: float) -> None:
    """Trees and undergrowth, denser or lighter."""
    rng, front = site.rng, site.ground.front(side)
    deep, density = rng.uniform(12, 28), rng.uniform(0.006, 0.022)
    for _ in range(rng.poisson(density * width * deep)):
        site.put(
            any_tree(rng, rng.uniform(4, 13)),
            x + rng.uniform(0, width),
            side * (front + rng.uniform(1.5, deep)),
        )
    _bushes(site, side, x, width, rng.poisson(density * width * 14), deep)
    if rng.random() < 0.75:
        thickets(site, side, x, width, front + rng.uniform(1.5, 10))
    if rng.random() < 0.5:
        for spot in np.arange(x, x + width, 3.0):
            site.put(fixtures.tall_grass(rng, 3.0), spot, side * (front + rng.uniform(0.5, 3)))


def thickets(site: Site, side: int, x: float, width: float, t: float) -> None:
    """Undergrowth in a line beside the street, of a height that changes slowly, with gaps."""
    rng = site.rng
    height = rng.uniform(1.2, 4.5)
    for spot in np.arange(x + 2, x + width, 4.0):
        height = float(np.clip(height + rng.normal(scale=0.5), 0.8, 6.0))
        if rng.random() < 0.9:
            site.put(
                fixtures.thicket(rng, 4.0, height),
                spot,
                side * (t + rng.normal(scale=0.5)),
                margin=2.5,
            )


def _field(site: Site, side: int, x: float, width: float) -> None:
    """Open ground: a meadow or gravel, perhaps fenced, a few bushes and a barn."""
    rng, front = site.rng, site.ground.front(side)
    if rng.random() < 0.35:
        near, far = sorted((side * (front + 1), side * (front + rng.uniform(6, 25))))
        site.ground.patches.append(Patch((x, x + width), (near, far), Label.OTHER_GROUND))
    if rng.random() < site.ground.style.fenced * 0.6:
        _boundary(site, side, x, width, -9.0)
    _bushes(site, side, x, width, rng.poisson(2), 12)
    if rng.random() < 0.75:
        thickets(site, side, x, width, front + rng.uniform(7, 26))
    if rng.random() < 0.2:
        barn = fixtures.gable_barn(rng, rng.uniform(8, 14), rng.uniform(10, 16), rng.uniform(3, 5))
        site.put(barn, x + width / 2, side * (front + 22), margin=9.0)
    if rng.random() < 0.3:
        site.put(
            fixtures.tree(rng, rng.uniform(6, 12)),
            x + width * 0.7,
            side * (front + rng.uniform(3, 10)),
        )


def _car_park(site: Site, side: int, x: float, width: float) -> None:
    """A paved lot with rows of cars, a trailer or a lorry among them."""
    rng, front = site.rng, site.ground.front(side)
    near, far = sorted((side * (front + 0.5), side * (front + 20)))
    site.ground.patches.append(Patch((x + 1, x + width - 1), (near, far), Label.PARKING))
    makers = (vehicles.car, vehicles.trailer, vehicles.truck, vehicles.motorcycle)
    for t in (4.0, 14.5):
        for spot in np.arange(x + 3, x + width - 3, 2.8):
            kind = rng.choice(4, p=[0.90, 0.05, 0.02, 0.03])
            if rng.random() < site.ground.style.parked + 0.2 and (kind != 2 or t > 10):
                turn = rng.choice([-1, 1]) * np.pi / 2 + rng.normal(scale=0.03)
                site.put(makers[kind](rng), spot, side * (front + t), turn, True, 3.0)


def _bushes(site: Site, side: int, x: float, width: float, count: int, deep: float = 6.0) -> None:
    rng, front = site.rng, site.ground.front(side)
    for _ in range(count):
        spot = side * (front + rng.uniform(0.8, max(deep, 1.5)))
        site.put(fixtures.bush(rng, rng.uniform(0.35, 1.6)), x + rng.uniform(0, width), spot)


def any_tree(rng: np.random.Generator, height: float, fine: bool = True) -> Mesh:
    """A broad-leaved tree or a fir."""
    return fixtures.conifer(rng, height) if rng.random() < 0.2 else fixtures.tree(rng, height, fine)
