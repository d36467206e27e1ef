"""Add people, riders and parked two-wheelers along a street."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from lidarstreets.bodies.vehicles import people, two_wheelers
from lidarstreets.bodies.vehicles.two_wheelers import fallen_bicycle
from lidarstreets.chance import weighted_choice
from lidarstreets.materials import Label, Surface
from lidarstreets.mesh import Maker, part
from lidarstreets.sites.site import Site
from lidarstreets.solids import box
from lidarstreets.tables import read_table

OCCASIONS = read_table(Path(__file__).with_suffix(".toml"))["occasions"]
PEOPLE_FACTOR = 0.9  # number of occasions for each person that `Style.people` counts
TWO_WHEELER_FACTOR = 0.6  # number of two-wheelers or racks for each person of `Style.people`
END_MARGIN = 2.0  # smallest distance of people from the end of a street, metres


def add_people(site: Site) -> None:
    """Add riders, and people who walk, stand, meet, sit or cross the road."""
    ground = site.ground
    rate = PEOPLE_FACTOR * ground.style.people * ground.length / 100

    for side, x in _random_places(site, rate):
        _add_occasion(site, weighted_choice(site.rng, OCCASIONS), side, x)


def _random_places(site: Site, rate: float) -> Iterator[tuple[int, float]]:
    """Yield random sides (-1 or 1) and x along the street, on average at most `rate` of them.

    A place beyond an end of the street is left out.
    """
    rng = site.rng
    for _ in range(rng.poisson(rate)):
        side = int(rng.choice([-1, 1]))
        x = rng.uniform(0, site.ground.length)
        if site.ground.is_street(x, END_MARGIN):
            yield side, x


def _add_occasion(site: Site, occasion: str, side: int, x: float) -> None:
    """Add the people of an occasion, a key of `OCCASIONS`, on a side of the street at x."""
    rng = site.rng
    ground = site.ground
    style = ground.style
    kerb = ground.kerb_t(side)
    front = ground.front(side)
    # From the kerb to a little behind the front of the plots.
    t = side * rng.uniform(kerb + 0.4, max(front, kerb + 0.8) + 1.0)
    turn = rng.uniform(0, 2 * np.pi)

    if occasion == "ride":
        make = two_wheelers.bicyclist if rng.random() < 0.8 else two_wheelers.motorcyclist
        on_path = make is two_wheelers.bicyclist and rng.random() < 0.35
        edge = side * (front - rng.uniform(0.3, 1.5)) if on_path else side * (style.road / 2 - 0.3)
        site.put_moving(make(rng), x, edge, -side * rng.uniform(2.5, 7))
    elif occasion == "walk":
        speed = rng.choice([-1, 1]) * rng.uniform(0.7, 2.5)
        for index in range(int(rng.choice([1, 1, 1, 2, 3]))):
            site.put_moving(people.person(rng), x + 0.3 * index, t + 0.6 * index, speed)
    elif occasion == "stand":
        site.put(people.person(rng), x, t, turn, thing=True, margin=None)
    elif occasion == "meet":
        for person in people.people_group(rng):
            site.put(person, x, t, turn, thing=True, margin=None)
    elif occasion == "cross":
        walker = people.person(rng)
        across = rng.uniform(-1, 1) * style.road / 2
        yaw = side * np.pi / 2 + rng.normal(scale=0.4)
        site.put(walker, x, across, yaw, thing=True, margin=None)
    elif occasion == "sit":
        bench_t = side * (front + rng.uniform(-0.3, 0.6))
        facing = -side * np.pi / 2
        seat = part([box((0.42, 1.7, 0.08), (-0.1, 0, 0.36))], Surface.WOOD, Label.OTHER_OBJECT)
        site.put(seat, x, bench_t, facing)
        sitters = int(rng.integers(1, 3))
        for offset in (-0.5, 0.4)[:sitters]:
            site.put(people.sitter(rng), x + offset, bench_t, facing, thing=True)
    else:  # stand by a car
        door_t = side * (style.road / 2 - 0.3 + rng.uniform(0.0, 0.8))
        site.put(people.person(rng), x, door_t, turn, thing=True, margin=None)


def park_two_wheelers(site: Site) -> None:
    """Park bicycles and motorcycles at the fronts of plots, at the kerb and on racks."""
    rng = site.rng
    ground = site.ground
    rate = TWO_WHEELER_FACTOR * ground.style.people * ground.length / 100

    for side, x in _random_places(site, rate):
        front = ground.front(side)
        kerb = ground.kerb_t(side)
        make = two_wheelers.bicycle if rng.random() < 0.62 else two_wheelers.motorcycle
        way = rng.random()
        if way < 0.45:  # along a wall, a hedge or a fence
            t = side * (front + rng.uniform(-0.5, 0.3))
            yaw = rng.normal(scale=0.15) + np.pi * (rng.random() < 0.5)
            site.put(make(rng), x, t, yaw, thing=True)
        elif way < 0.65:  # at the kerb
            t = side * (kerb + rng.uniform(-0.6, 0.5))
            site.put(make(rng), x, t, rng.uniform(0, 2 * np.pi), thing=True)
        elif way < 0.68:
            site.put(fallen_bicycle(rng), x, side * front, rng.uniform(0, 2 * np.pi), thing=True)
        else:
            t = side * (front - 0.6 if rng.random() < 0.6 else kerb + 0.9)
            put_rack(site, make, x, t, int(rng.integers(2, 8)))


def put_rack(site: Site, make: Maker, x: float, t: float, places: int) -> None:
    """Put two-wheelers side by side at a rack; some of its `places` stay empty."""
    rng = site.rng
    pitch = rng.uniform(0.45, 0.8) if make is two_wheelers.bicycle else rng.uniform(0.8, 1.2)
    yaw = np.pi / 2 + rng.normal(scale=0.3)

    hoops = []
    for index in range(places):
        place = x + pitch * index
        if rng.random() < 0.75:
            turn = np.pi * (rng.random() < 0.2) + rng.normal(scale=0.08)
            site.put(make(rng), place, t + rng.normal(scale=0.08), yaw + turn, thing=True)
        hoops.append(box((0.04, 0.5, 0.8), (pitch * (index + 0.5), 0, 0)))
    if rng.random() < 0.5:
        site.put(part(hoops, Surface.METAL, Label.OTHER_OBJECT), x, t)
