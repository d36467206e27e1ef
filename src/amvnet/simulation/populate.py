"""Fills a street: its plots, furniture and trees along the road, parked cars, and who drives and walks."""

from __future__ import annotations

import numpy as np

from amvnet.simulation import fixtures, vehicles
from amvnet.simulation.plots import any_tree, fill_plots, thickets
from amvnet.simulation.site import Site
from amvnet.simulation.streets import Ground

WORKS_PER_100 = 0.25  # work zones per 100 m of street


def populate(ground: Ground, rng: np.random.Generator, ego_speed: float, ego_x: float) -> Site:
    """All that stands and moves in a street, kept clear of the sensor's own car, which is at `ego_x` at time 0."""
    site = Site(ground, rng)
    for side in (-1, 1):
        fill_plots(site, side)
        _parking_lane(site, side)
        _roadside(site, side)
        _background(site, side)
    _side_roads(site)
    _traffic(site, ego_speed, ego_x)
    _people(site)
    _works(site)
    return site


def _parking_lane(site: Site, side: int) -> None:
    rng, style = site.rng, site.ground.style
    lane = style.parking[int(side > 0)]
    makers = (vehicles.car, vehicles.truck, vehicles.trailer, vehicles.motorcycle)
    spot = rng.uniform(0, 6)
    while lane and spot < site.ground.length:
        kind = rng.choice(4, p=[0.91, 0.03, 0.03, 0.03])
        room = 13.0 if kind == 1 else rng.uniform(5.8, 7.5)
        if rng.random() < style.parked:
            t = side * (style.road / 2 + lane / 2 + rng.normal(scale=0.1))
            turn = (0 if side < 0 else np.pi) + rng.normal(scale=0.02)
            site.put(makers[kind](rng), spot + room / 2, t, turn, True, 6.0 + room / 2)
        spot += room


def _roadside(site: Site, side: int) -> None:
    """Lamps, trees, signs, posts, bins and shelters along the kerb; a crash barrier beside a fast road."""
    rng, style, ground = site.rng, site.ground.style, site.ground
    i = int(side > 0)
    kerb = side * (style.road / 2 + style.parking[i] + 0.35)
    back = side * (ground.front(side) - 0.3)
    turn = 0.0 if side < 0 else np.pi
    pole = fixtures.utility_pole if style.kind == "rural" or rng.random() < 0.15 else fixtures.lamp
    for spot in np.arange(rng.uniform(0, style.lamps), ground.length, style.lamps):
        site.put(pole(rng), spot, kerb if rng.random() < 0.7 else back, turn)
    if np.isfinite(style.trees):
        for spot in np.arange(rng.uniform(0, style.trees), ground.length, style.trees):
            site.put(any_tree(rng, rng.uniform(4, 9)), spot + rng.normal(), back, margin=2.0)
    makers = (
        (fixtures.sign, 3.0),
        (fixtures.post, 0.5),
        (fixtures.clutter, 1.6),
        (fixtures.shelter, 0.15),
    )
    for make, per_100 in makers:
        for _ in range(rng.poisson(per_100 * ground.length / 100)):
            site.put(
                make(rng),
                rng.uniform(0, ground.length),
                kerb if make is fixtures.sign else back,
                turn,
            )
    if style.kind == "fast" and rng.random() < 0.7:
        for spot in np.arange(0, ground.length, 4.0):
            site.put(fixtures.guard_rail(4.1), spot, side * (style.road / 2 + 0.7), turn)


def _background(site: Site, side: int) -> None:
    """A second row of trees and houses behind the plots, which closes the view."""
    rng, ground = site.rng, site.ground
    for x in np.arange(rng.uniform(0, 10), ground.length, 14.0):
        t = side * (ground.front(side) + rng.uniform(32, 45))
        if rng.random() < 0.45:
            thickets(site, side, x, 14.0, ground.front(side) + rng.uniform(24, 34))
        if rng.random() < 0.35 and ground.style.kind in ("residential", "urban"):
            size = rng.uniform(9, 16), rng.uniform(8, 12), rng.uniform(*ground.style.storeys)
            site.put(
                fixtures.building(rng, *size, rng.random() < 0.2),
                x,
                t,
                rng.normal(scale=0.3),
                margin=6.0,
            )
        else:
            site.put(any_tree(rng, rng.uniform(6, 14), fine=False), x, t)
        far = side * (ground.front(side) + rng.uniform(42, 66))
        site.put(fixtures.copse(rng, 14.0, rng.uniform(5, 12)), x, far, margin=10.0)


def _side_roads(site: Site) -> None:
    """Cars that wait or park in the side roads, traffic lights and signs at their mouths."""
    rng, style = site.rng, site.ground.style
    for crossing in site.ground.crossings:
        for side in crossing.sides:
            for _ in range(rng.poisson(0.8)):
                _waiting_car(site, crossing.x, side, crossing.width, rng.uniform(4.5, 25))
            corner = side * (style.road / 2 + 1.2)
            make = fixtures.traffic_light if rng.random() < 0.3 else fixtures.sign
            site.put(make(rng), crossing.x - crossing.width / 2 - 2.5, corner, 0.0, margin=0.3)


def _waiting_car(site: Site, x: float, side: int, width: float, off: float) -> None:
    """One car on the right half of a side road, facing the street."""
    t = side * (site.ground.style.road / 2 + off)
    body = vehicles.car(site.rng) if site.rng.random() < 0.93 else vehicles.bus(site.rng)
    site.put(body, x + side * width / 4, t, -side * np.pi / 2, True, margin=-np.inf)


def _traffic(site: Site, ego_speed: float, ego_x: float) -> None:
    """Cars and others in both lanes; those of one lane share a speed, so that none runs into another."""
    rng, ground, style = site.rng, site.ground, site.ground.style
    makers = (vehicles.car, vehicles.truck, vehicles.bus, vehicles.motorcyclist)
    for direction, speed in ((1, ego_speed), (-1, -ego_speed * rng.uniform(0.8, 1.3))):
        x = rng.uniform(5, 60)
        while x < ground.length - 10:
            if direction < 0 or abs(x - ego_x) > 14:
                kind = rng.choice(4, p=[0.80, 0.10, 0.04, 0.06])
                site.moving(makers[kind](rng), x, -direction * style.road / 4, speed)
            x += 14 + rng.exponential(100 / max(style.traffic, 0.05))


def _people(site: Site) -> None:
    """People on the sidewalks, cyclists at the road's edges; some stand still."""
    rng, ground, style = site.rng, site.ground, site.ground.style
    for _ in range(rng.poisson(style.people * ground.length / 100)):
        side, x = int(rng.choice([-1, 1])), rng.uniform(0, ground.length)
        if rng.random() < 0.3:
            rider = vehicles.bicyclist if rng.random() < 0.85 else vehicles.motorcyclist
            site.moving(rider(rng), x, side * (style.road / 2 - 0.5), -side * rng.uniform(3, 6))
        elif rng.random() < 0.6:
            spot = side * (ground.front(side) - rng.uniform(0.3, 1.3))
            site.moving(vehicles.person(rng), x, spot, rng.choice([-1, 1]) * rng.uniform(0.8, 1.7))
        else:
            spot = side * (ground.front(side) + rng.uniform(-1.2, 1.5))
            site.put(vehicles.person(rng), x, spot, rng.uniform(0, 6.3), True, margin=-np.inf)
    for _ in range(rng.poisson(0.8 * style.people * ground.length / 100)):
        side = int(rng.choice([-1, 1]))
        body = vehicles.bicycle(rng) if rng.random() < 0.7 else vehicles.motorcycle(rng)
        site.put(
            body,
            rng.uniform(0, ground.length),
            side * (ground.front(side) - 0.4),
            rng.normal(scale=0.2),
            True,
        )


def _works(site: Site) -> None:
    """Work zones at the road's edge: a row of barriers or cones, and a digger behind it now and then."""
    rng, ground, style = site.rng, site.ground, site.ground.style
    for _ in range(rng.poisson(WORKS_PER_100 * ground.length / 100)):
        side, start = int(rng.choice([-1, 1])), rng.uniform(0, ground.length)
        edge = side * (style.road / 2 + style.parking[int(side > 0)] - 0.4)
        barriers, length = rng.random() < 0.5, rng.uniform(8, 25)
        for spot in np.arange(start, start + length, 2.05 if barriers else 3.0):
            site.put(fixtures.barrier(2.0) if barriers else fixtures.traffic_cone(rng), spot, edge)
        if rng.random() < 0.5:
            middle = side * (ground.front(side) + 2.5)
            site.put(
                vehicles.excavator(rng),
                start + length / 2,
                middle,
                rng.uniform(0, 6.3),
                True,
                margin=3.0,
            )
