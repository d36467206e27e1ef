"""Fill a street with plots, roadside furniture, parked vehicles, traffic, people and work zones.

x and t are street coordinates in metres: along the middle line, and across it (left is positive).
A side is -1 (right) or 1 (left). Each street depends on the order of the random draws: keep it.
"""

from __future__ import annotations

import numpy as np

from amvnet.simulation import fixtures, vehicles
from amvnet.simulation.chance import weighted_choice
from amvnet.simulation.plots import Plot, fill_plots, plant_thickets, random_tree
from amvnet.simulation.site import Site
from amvnet.simulation.streets import Crossing, Ground

# Shares of the vehicles that park along the street, and of those that drive.
PARKED_VEHICLES = {
    vehicles.car: 0.91,
    vehicles.truck: 0.03,
    vehicles.trailer: 0.03,
    vehicles.motorcycle: 0.03,
}
DRIVING_VEHICLES = {
    vehicles.car: 0.80,
    vehicles.truck: 0.10,
    vehicles.bus: 0.04,
    vehicles.motorcyclist: 0.06,
}
# Roadside furniture per 100 m of street on each side.
SIGNS = 3.0
POSTS = 0.5
CLUTTER = 1.6
SHELTERS = 0.15
# Work zones per 100 m of street.
WORK_ZONES = 0.25
# Metres between the trees, houses and copses of the second row, along the street.
BACKGROUND_STEP = 14.0
# Metres: least distance between two vehicles of one lane.
VEHICLE_GAP = 14.0
# Largest random yaw. 2 pi, rounded up: the exact value would change the streets of every seed.
TURN = 6.3


def populate(ground: Ground, rng: np.random.Generator, ego_speed: float, ego_x: float) -> Site:
    """Return a street with everything that stands and moves in it.

    Args:
        ground: the street.
        rng: draws everything.
        ego_speed: speed of the car with the sensor, metres per second.
        ego_x: x of that car at time 0; no traffic in its lane starts near it.
    """
    site = Site(ground, rng)
    for side in (-1, 1):
        fill_plots(site, side)
        _fill_parking_lane(site, side)
        _fill_roadside(site, side)
        _fill_background(site, side)

    _fill_side_roads(site)
    _add_traffic(site, ego_speed, ego_x)
    _add_people(site)
    _park_two_wheelers(site)
    _add_work_zones(site)
    return site


def _fill_parking_lane(site: Site, side: int) -> None:
    """Put parked vehicles along one side of the road, if it has a parking lane."""
    rng = site.rng
    style = site.ground.style
    lane_width = style.parking[int(side > 0)]

    x = rng.uniform(0, 6)
    while lane_width and x < site.ground.length:
        make = weighted_choice(rng, PARKED_VEHICLES)
        space = 13.0 if make is vehicles.truck else rng.uniform(5.8, 7.5)
        if rng.random() < style.parked:
            t = side * (style.road / 2 + lane_width / 2 + rng.normal(scale=0.1))
            yaw = _along_road(side) + rng.normal(scale=0.02)
            site.put(make(rng), x + space / 2, t, yaw, thing=True, margin=6.0 + space / 2)
        x += space


def _fill_roadside(site: Site, side: int) -> None:
    """Put lamps, trees, signs, posts, bins, shelters and perhaps a crash barrier along the road."""
    rng = site.rng
    ground = site.ground
    style = ground.style

    kerb_t = side * (style.road / 2 + style.parking[int(side > 0)] + 0.35)
    back_t = side * (ground.front(side) - 0.3)
    yaw = _along_road(side)

    has_wires = style.kind == "rural" or rng.random() < 0.15
    make_pole = fixtures.utility_pole if has_wires else fixtures.lamp
    for x in np.arange(rng.uniform(0, style.lamps), ground.length, style.lamps):
        site.put(make_pole(rng), x, kerb_t if rng.random() < 0.7 else back_t, yaw)

    if np.isfinite(style.trees):
        for x in np.arange(rng.uniform(0, style.trees), ground.length, style.trees):
            tree = random_tree(rng, rng.uniform(4, 9))
            site.put(tree, x + rng.normal(), back_t, margin=2.0)

    furniture = (
        (fixtures.sign, SIGNS, kerb_t),
        (fixtures.post, POSTS, back_t),
        (fixtures.clutter, CLUTTER, back_t),
        (fixtures.shelter, SHELTERS, back_t),
    )
    for make, per_100_m, t in furniture:
        for _ in range(rng.poisson(per_100_m * ground.length / 100)):
            site.put(make(rng), rng.uniform(0, ground.length), t, yaw)

    if style.kind == "fast" and rng.random() < 0.7:
        for x in np.arange(0, ground.length, 4.0):
            site.put(fixtures.guard_rail(4.1), x, side * (style.road / 2 + 0.7), yaw)


def _fill_background(site: Site, side: int) -> None:
    """Put a second row of trees and houses behind the plots, to close off the view."""
    rng = site.rng
    ground = site.ground
    front = ground.front(side)
    has_houses = ground.style.kind in ("residential", "urban")

    for x in np.arange(rng.uniform(0, 10), ground.length, BACKGROUND_STEP):
        t = side * (front + rng.uniform(32, 45))
        if rng.random() < 0.45:
            plot = Plot(site, side, x, BACKGROUND_STEP)
            plant_thickets(plot, front + rng.uniform(24, 34))

        if rng.random() < 0.35 and has_houses:
            _put_background_house(site, x, t)
        else:
            site.put(random_tree(rng, rng.uniform(6, 14), fine=False), x, t)

        copse_t = side * (front + rng.uniform(42, 66))
        copse = fixtures.copse(rng, BACKGROUND_STEP, rng.uniform(5, 12))
        site.put(copse, x, copse_t, margin=10.0)


def _put_background_house(site: Site, x: float, t: float) -> None:
    rng = site.rng

    width = rng.uniform(9, 16)
    depth = rng.uniform(8, 12)
    height = rng.uniform(*site.ground.style.storeys)

    house = fixtures.building(rng, width, depth, height, flat=rng.random() < 0.2)
    site.put(house, x, t, rng.normal(scale=0.3), margin=6.0)


def _fill_side_roads(site: Site) -> None:
    """Put waiting vehicles on the side roads, and a traffic light or a sign where they begin."""
    rng = site.rng

    for crossing in site.ground.crossings:
        for side in crossing.sides:
            for _ in range(rng.poisson(0.8)):
                distance = rng.uniform(4.5, 25)
                _put_waiting_car(site, crossing, side, distance)

            make = fixtures.traffic_light if rng.random() < 0.3 else fixtures.sign
            corner_x = crossing.x - crossing.width / 2 - 2.5
            corner_t = side * (site.ground.style.road / 2 + 1.2)
            site.put(make(rng), corner_x, corner_t, margin=0.3)


def _put_waiting_car(site: Site, crossing: Crossing, side: int, distance: float) -> None:
    """Put a car or a bus on the right half of a side road, facing the street."""
    rng = site.rng
    vehicle = vehicles.car(rng) if rng.random() < 0.93 else vehicles.bus(rng)
    x = crossing.x + side * crossing.width / 4
    t = side * (site.ground.style.road / 2 + distance)
    site.put(vehicle, x, t, -side * np.pi / 2, thing=True, margin=-np.inf)


def _add_traffic(site: Site, ego_speed: float, ego_x: float) -> None:
    """Add vehicles to both lanes; all in one lane have one speed, so that none hits another."""
    rng = site.rng
    ground = site.ground
    style = ground.style

    oncoming_speed = -ego_speed * rng.uniform(0.8, 1.3)
    for direction, speed in ((1, ego_speed), (-1, oncoming_speed)):
        x = rng.uniform(5, 60)
        while x < ground.length - 10:
            if direction < 0 or abs(x - ego_x) > VEHICLE_GAP:
                make = weighted_choice(rng, DRIVING_VEHICLES)
                site.put_moving(make(rng), x, -direction * style.road / 4, speed)
            x += VEHICLE_GAP + rng.exponential(100 / max(style.traffic, 0.05))


def _add_people(site: Site) -> None:
    """Add riders at the edges of the road, and people who walk or stand on the sidewalks."""
    rng = site.rng
    ground = site.ground
    style = ground.style

    for _ in range(rng.poisson(style.people * ground.length / 100)):
        side = int(rng.choice([-1, 1]))
        x = rng.uniform(0, ground.length)

        if rng.random() < 0.3:
            make = vehicles.bicyclist if rng.random() < 0.85 else vehicles.motorcyclist
            t = side * (style.road / 2 - 0.5)
            site.put_moving(make(rng), x, t, -side * rng.uniform(3, 6))
        elif rng.random() < 0.6:
            t = side * (ground.front(side) - rng.uniform(0.3, 1.3))
            walker = vehicles.person(rng)
            site.put_moving(walker, x, t, rng.choice([-1, 1]) * rng.uniform(0.8, 1.7))
        else:
            t = side * (ground.front(side) + rng.uniform(-1.2, 1.5))
            person = vehicles.person(rng)
            site.put(person, x, t, rng.uniform(0, TURN), thing=True, margin=-np.inf)


def _park_two_wheelers(site: Site) -> None:
    """Put parked bicycles and motorcycles at the fronts of the plots."""
    rng = site.rng
    ground = site.ground

    for _ in range(rng.poisson(0.8 * ground.style.people * ground.length / 100)):
        side = int(rng.choice([-1, 1]))
        make = vehicles.bicycle if rng.random() < 0.7 else vehicles.motorcycle
        two_wheeler = make(rng)
        x = rng.uniform(0, ground.length)
        t = side * (ground.front(side) - 0.4)
        site.put(two_wheeler, x, t, rng.normal(scale=0.2), thing=True)


def _add_work_zones(site: Site) -> None:
    """Put rows of barriers or cones at the edge of the road, some with an excavator behind them."""
    rng = site.rng
    ground = site.ground
    style = ground.style

    for _ in range(rng.poisson(WORK_ZONES * ground.length / 100)):
        side = int(rng.choice([-1, 1]))
        start = rng.uniform(0, ground.length)
        edge = side * (style.road / 2 + style.parking[int(side > 0)] - 0.4)
        has_barriers = rng.random() < 0.5
        length = rng.uniform(8, 25)

        for x in np.arange(start, start + length, 2.05 if has_barriers else 3.0):
            segment = fixtures.barrier(2.0) if has_barriers else fixtures.traffic_cone(rng)
            site.put(segment, x, edge)

        if rng.random() < 0.5:
            t = side * (ground.front(side) + 2.5)
            excavator = vehicles.excavator(rng)
            yaw = rng.uniform(0, TURN)
            site.put(excavator, start + length / 2, t, yaw, thing=True, margin=3.0)


def _along_road(side: int) -> float:
    """Return the yaw, relative to the street, of vehicles on one side of the road."""
    return 0.0 if side < 0 else np.pi
