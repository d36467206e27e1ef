"""Open areas next to a street: car parks, yards and squares."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lidarstreets.bodies import clutter, trees, vehicles
from lidarstreets.chance import weighted_choice
from lidarstreets.materials import Label, Surface
from lidarstreets.mesh import part
from lidarstreets.sites.crowd import put_rack
from lidarstreets.sites.site import Site
from lidarstreets.sites.traffic import car_with_trailer, length_of
from lidarstreets.solids import box
from lidarstreets.streets.ground import Patch

# Open areas per 100 m of street on each side.
AREAS = {"urban": 0.24, "avenue": 0.24, "residential": 0.13, "living": 0.16, "rural": 0.10}
LOT_VEHICLES = {
    vehicles.car: 0.90,
    vehicles.trailer: 0.03,
    vehicles.truck: 0.03,
    vehicles.motorcycle: 0.03,
    vehicles.bus: 0.01,
}
YARD_VEHICLES = {
    vehicles.truck: 0.50,
    vehicles.trailer: 0.15,
    vehicles.machine: 0.12,
    vehicles.bus: 0.04,
    vehicles.car: 0.19,
}
# Metres from the front of a car park to the middle of its aisle, and of its two rows from there.
AISLE = 9.0
ROW = 5.8


@dataclass(frozen=True)
class Area:
    """An open area on one side of a street, -1 right and 1 left, between two x; metres."""

    side: int
    start: float
    stop: float
    depth: float

    @property
    def middle(self) -> float:
        """Middle of the area along the street."""
        return (self.start + self.stop) / 2

    def label(self, site: Site, label: Label) -> None:
        """Make the whole area ground of a class."""
        front = site.ground.front(self.side)
        near, far = sorted((self.side * front, self.side * (front + self.depth)))
        site.ground.patches.append(Patch((self.start, self.stop), (near, far), label))


def add_areas(site: Site) -> None:
    """Reserve open areas along the street and fill them."""
    rng = site.rng
    ground = site.ground
    rate = AREAS.get(ground.style.kind, 0.0) * ground.length / 100

    for side in (-1, 1):
        for _ in range(rng.poisson(rate)):
            start = rng.uniform(5, ground.length - 40)
            area = Area(side, start, start + rng.uniform(16, 45), rng.uniform(9, 28))
            kinds = {add_lot: 0.48, add_yard: 0.26, add_square: 0.26}
            fill = weighted_choice(rng, kinds)
            if has_room(site, area):
                fill(site, area)
                ground.reserved.append((side, area.start, area.stop))


def has_room(site: Site, area: Area) -> bool:
    """Return whether no side road and no other area lies within an area."""
    if not (site.ground.is_street(area.start, 5) and site.ground.is_street(area.stop, 5)):
        return False

    t = area.side * (site.ground.front(area.side) + area.depth / 2)
    half = (area.stop - area.start) / 2
    return site.is_free(area.middle, t, half) and site.is_free(area.middle, area.side, half)


def add_lot(site: Site, area: Area) -> None:
    """Add a car park: rows of vehicles on both sides of an aisle, perhaps islands with trees."""
    rng = site.rng
    chances = {Label.PARKING: 0.85, Label.OTHER_GROUND: 0.10, Label.SIDEWALK: 0.05}
    area.label(site, weighted_choice(rng, chances))

    front = site.ground.front(area.side)
    taken = rng.uniform(0.15, 0.95)
    angle = np.pi / 2 if rng.random() < 0.7 else rng.uniform(0.8, 1.3)
    pitch = rng.uniform(2.5, 3.1) / np.sin(angle)
    rows = [AISLE - ROW] if area.depth < AISLE + ROW + 2 else [AISLE - ROW, AISLE + ROW]

    for row in rows:
        for x in np.arange(area.start + 1.8, area.stop - 1.5, pitch):
            mesh = weighted_choice(rng, LOT_VEHICLES)(rng)
            t = area.side * (front + row + rng.normal(scale=0.2))
            yaw = angle + np.pi * (rng.random() < 0.5) + rng.normal(scale=0.03)
            if rng.random() < 0.07:
                tree = trees.random_tree(rng, rng.uniform(3, 7))
                site.put(tree, x, t, margin=-np.inf)
            elif rng.random() < taken and length_of(mesh) < 6.5:
                site.put(mesh, x, t, yaw, thing=True, margin=-np.inf)
    _put_people(site, area, 1.0)


def add_yard(site: Site, area: Area) -> None:
    """Add a yard with trucks, trailers, machines and containers at any angle."""
    rng = site.rng
    chances = {
        Label.OTHER_GROUND: 0.5,
        Label.PARKING: 0.25,
        Label.SIDEWALK: 0.15,
        Label.TERRAIN: 0.10,
    }
    area.label(site, weighted_choice(rng, chances))

    front = site.ground.front(area.side)
    heading = rng.choice([0.0, np.pi / 2]) + rng.normal(scale=0.3)

    for distance in np.arange(3.0, area.depth, 6.0):
        x = area.start + 4
        while x < area.stop - 4:
            t = area.side * (front + distance)
            if rng.random() < 0.35:
                x += _put_large(site, x, t, heading)
            x += rng.uniform(3, 6)
    _put_people(site, area, 0.8)


def _put_large(site: Site, x: float, t: float, heading: float) -> float:
    """Put a vehicle or a container behind x along the street; return its length."""
    rng = site.rng
    yaw = heading + np.pi * (rng.random() < 0.5) + rng.normal(scale=0.1)
    if rng.random() < 0.15:
        size = (rng.uniform(3, 6.1), 2.4, rng.uniform(1.2, 2.6))
        container = part([box(size)], Surface.LIGHT_PAINT, Label.OTHER_OBJECT)
        site.put(container, x + size[0] / 2, t, yaw, margin=-np.inf)
        return size[0]

    if rng.random() < 0.12:
        bodies = car_with_trailer(rng)
    else:
        bodies = [weighted_choice(rng, YARD_VEHICLES)(rng)]
    length = sum(length_of(body) for body in bodies)
    for body in bodies:
        site.put(body, x + length / 2, t, yaw, thing=True, margin=-np.inf)
    return length


def add_square(site: Site, area: Area) -> None:
    """Add a square with people, benches, bicycles at racks and a few trees."""
    rng = site.rng
    chances = {Label.SIDEWALK: 0.6, Label.OTHER_GROUND: 0.25, Label.PARKING: 0.15}
    area.label(site, weighted_choice(rng, chances))

    front = site.ground.front(area.side)

    for _ in range(rng.poisson(2)):
        t = area.side * (front + rng.uniform(2, area.depth))
        make = vehicles.bicycle if rng.random() < 0.75 else vehicles.motorcycle
        put_rack(site, make, rng.uniform(area.start, area.stop - 4), t, int(rng.integers(3, 9)))

    for _ in range(rng.poisson(2)):
        t = area.side * (front + rng.uniform(1, area.depth))
        tree = trees.random_tree(rng, rng.uniform(4, 9))
        site.put(tree, rng.uniform(area.start, area.stop), t, margin=-np.inf)
    for _ in range(rng.poisson(3)):
        t = area.side * (front + rng.uniform(1, area.depth))
        site.put(clutter.clutter(rng), rng.uniform(area.start, area.stop), t, margin=-np.inf)
    _put_people(site, area, 4.0)


def _put_people(site: Site, area: Area, mean: float) -> None:
    """Put people and groups of people anywhere in an area; `mean` is their average number."""
    rng = site.rng
    front = site.ground.front(area.side)
    for _ in range(rng.poisson(mean)):
        x = rng.uniform(area.start, area.stop)
        t = area.side * (front + rng.uniform(0.5, area.depth))
        group = vehicles.people_group(rng) if rng.random() < 0.3 else [vehicles.person(rng)]
        yaw = rng.uniform(0, 2 * np.pi)
        for person in group:
            site.put(person, x, t, yaw, thing=True, margin=-np.inf)
