"""Add open areas next to a street: car parks, yards and squares."""

import numpy as np

from lidarstreets.bodies import clutter, trees
from lidarstreets.bodies.vehicles import people, two_wheelers
from lidarstreets.chance import weighted_choice
from lidarstreets.materials import Label, Surface
from lidarstreets.mesh import part
from lidarstreets.sites.crowd import put_rack
from lidarstreets.sites.site import Plot, Site
from lidarstreets.sites.traffic import car_with_trailer, choose_vehicle, length_of
from lidarstreets.solids import box

# Mean number of open areas per 100 m of street on each side, by kind of street.
AREAS_PER_100_M = {
    "urban": 0.24,
    "avenue": 0.24,
    "residential": 0.13,
    "living": 0.16,
    "rural": 0.10,
}
# Distance of the middle of the aisle from the front of a car park, and of the middle of each row
# from the middle of the aisle, metres.
AISLE_DISTANCE = 9.0
ROW_DISTANCE = 5.8


def add_areas(site: Site) -> None:
    """Reserve open areas along the street and fill them."""
    rng = site.rng
    ground = site.ground
    rate = AREAS_PER_100_M.get(ground.style.kind, 0.0) * ground.length / 100

    for side in (-1, 1):
        for _ in range(rng.poisson(rate)):
            start = rng.uniform(5, ground.length - 40)
            area = Plot(site, side, start, rng.uniform(16, 45))
            depth = rng.uniform(9, 28)
            kinds = {add_lot: 0.48, add_yard: 0.26, add_square: 0.26}
            fill = weighted_choice(rng, kinds)
            if has_room(area, depth):
                fill(area, depth)
                ground.reserved.append((side, area.x, area.end))


def has_room(area: Plot, depth: float) -> bool:
    """Return whether an area `depth` metres deep overlaps no side road and no other area."""
    site = area.site
    if not (site.ground.is_street(area.x, 5) and site.ground.is_street(area.end, 5)):
        return False

    t = area.side * (area.front + depth / 2)
    half = area.width / 2
    return site.is_free(area.middle, t, half) and site.is_free(area.middle, area.side, half)


def _pave(area: Plot, depth: float, chances: dict[Label, float]) -> None:
    """Make the ground of an area one class, drawn by its chance."""
    label = weighted_choice(area.rng, chances)
    area.pave((area.x, area.end), (area.front, area.front + depth), label)


def add_lot(area: Plot, depth: float) -> None:
    """Add a car park: rows of vehicles on one or both sides of an aisle, and a few trees."""
    rng = area.rng
    front = area.front
    chances = {Label.PARKING: 0.85, Label.OTHER_GROUND: 0.10, Label.SIDEWALK: 0.05}
    _pave(area, depth, chances)

    taken = rng.uniform(0.15, 0.95)
    angle = np.pi / 2 if rng.random() < 0.7 else rng.uniform(0.8, 1.3)
    pitch = rng.uniform(2.5, 3.1) / np.sin(angle)
    rows = (
        [AISLE_DISTANCE - ROW_DISTANCE]
        if depth < AISLE_DISTANCE + ROW_DISTANCE + 2
        else [AISLE_DISTANCE - ROW_DISTANCE, AISLE_DISTANCE + ROW_DISTANCE]
    )

    for row in rows:
        for x in np.arange(area.x + 1.8, area.end - 1.5, pitch):
            mesh = choose_vehicle(area.site, "lot")(rng)
            distance = front + row + rng.normal(scale=0.2)
            yaw = angle + np.pi * (rng.random() < 0.5) + rng.normal(scale=0.03)
            if rng.random() < 0.07:
                tree = trees.random_tree(rng, rng.uniform(3, 7))
                area.put(tree, x, distance, margin=None)
            elif rng.random() < taken and length_of(mesh) < 6.5:
                area.put(mesh, x, distance, yaw, thing=True, margin=None)
    _put_people(area, depth, 1.0)


def add_yard(area: Plot, depth: float) -> None:
    """Add a yard with trucks, trailers, machines and containers at any angle."""
    rng = area.rng
    chances = {
        Label.OTHER_GROUND: 0.5,
        Label.PARKING: 0.25,
        Label.SIDEWALK: 0.15,
        Label.TERRAIN: 0.10,
    }
    _pave(area, depth, chances)

    heading = rng.choice([0.0, np.pi / 2]) + rng.normal(scale=0.3)

    for row in np.arange(3.0, depth, 6.0):
        x = area.x + 4
        while x < area.end - 4:
            if rng.random() < 0.35:
                x += _put_large(area, x, area.front + row, heading)
            x += rng.uniform(3, 6)
    _put_people(area, depth, 0.8)


def _put_large(area: Plot, x: float, distance: float, heading: float) -> float:
    """Put a vehicle or a container that begins at x along the street; return its length."""
    rng = area.rng
    yaw = heading + np.pi * (rng.random() < 0.5) + rng.normal(scale=0.1)
    if rng.random() < 0.15:
        size = (rng.uniform(3, 6.1), 2.4, rng.uniform(1.2, 2.6))
        container = part([box(size)], Surface.COATING, Label.OTHER_OBJECT)
        area.put(container, x + size[0] / 2, distance, yaw, margin=None)
        return size[0]

    has_trailer = rng.random() < 0.12
    bodies = car_with_trailer(rng) if has_trailer else [choose_vehicle(area.site, "yard")(rng)]
    length = sum(length_of(body) for body in bodies)
    for body in bodies:
        area.put(body, x + length / 2, distance, yaw, thing=True, margin=None)
    return length


def add_square(area: Plot, depth: float) -> None:
    """Add a square with people, benches, bicycles at racks and a few trees."""
    rng = area.rng
    front = area.front
    chances = {Label.SIDEWALK: 0.6, Label.OTHER_GROUND: 0.25, Label.PARKING: 0.15}
    _pave(area, depth, chances)

    for _ in range(rng.poisson(2)):
        t = area.side * (front + rng.uniform(2, depth))
        make = two_wheelers.bicycle if rng.random() < 0.75 else two_wheelers.motorcycle
        x = rng.uniform(area.x, area.end - 4)
        put_rack(area.site, make, x, t, int(rng.integers(3, 9)))

    for _ in range(rng.poisson(2)):
        distance = front + rng.uniform(1, depth)
        tree = trees.random_tree(rng, rng.uniform(4, 9))
        area.put(tree, rng.uniform(area.x, area.end), distance, margin=None)
    for _ in range(rng.poisson(3)):
        distance = front + rng.uniform(1, depth)
        thing = clutter.clutter(rng)
        area.put(thing, rng.uniform(area.x, area.end), distance, margin=None)
    _put_people(area, depth, 4.0)


def _put_people(area: Plot, depth: float, mean: float) -> None:
    """Put people and groups of people anywhere in an area; on average there are `mean` of both."""
    rng = area.rng
    for _ in range(rng.poisson(mean)):
        x = rng.uniform(area.x, area.end)
        distance = area.front + rng.uniform(0.5, depth)
        group = people.people_group(rng) if rng.random() < 0.3 else [people.person(rng)]
        yaw = rng.uniform(0, 2 * np.pi)
        for person in group:
            area.put(person, x, distance, yaw, thing=True, margin=None)
