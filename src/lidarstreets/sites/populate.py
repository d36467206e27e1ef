"""Fill a street with everything that stands and moves in it."""

import numpy as np

from lidarstreets.bodies import clutter, furniture
from lidarstreets.bodies.vehicles import machines, people
from lidarstreets.sites.areas import add_areas
from lidarstreets.sites.background import close_ends, fill_background, line_side_road
from lidarstreets.sites.boundaries import draw_boundary, line_up
from lidarstreets.sites.crowd import add_people, park_two_wheelers
from lidarstreets.sites.gardens import fill_house, fill_row
from lidarstreets.sites.land import fill_field, fill_wood, plant_bushes
from lidarstreets.sites.roadside import fill_islands, fill_roadside
from lidarstreets.sites.site import Plot, Site
from lidarstreets.sites.traffic import (
    add_traffic,
    fill_bus_stops,
    fill_parking_lane,
    fill_side_roads,
    park_anywhere,
)
from lidarstreets.sites.yards import fill_yard

WORK_ZONES_PER_100_M = 0.25  # mean number of work zones per 100 m of street
WORK_BARRIER_STEP = 2.05  # distance between the barriers of a work zone, metres
CONE_STEP = 3.0  # distance between the cones of a work zone, metres

# Chance of a long barrier or fence along one side of a street, by kind of street.
LONG_BARRIER_CHANCE = {"fast": 0.65, "rural": 0.25, "residential": 0.05, "urban": 0.05}
# Chance of a gantry over a street, by kind of street.
GANTRY_CHANCE = {"fast": 0.35, "urban": 0.04}
BRIDGE_CHANCE = 0.05  # chance of a bridge over a street that has no gantry


def populate(site: Site, ego_speed: float, ego: tuple[float, float]) -> None:
    """Fill a street with everything that stands and moves in it.

    Args:
        ego_speed: speed of the car with the sensor, metres per second.
        ego: x and t of the car with the sensor at time 0; no body in its lane starts near it.
    """
    ground = site.ground
    add_areas(site)

    for side in (-1, 1):
        _fill_plots(site, side)
        fill_parking_lane(site, side)
        park_anywhere(site, side)
        fill_roadside(site, side)
        fill_background(site, side)

    close_ends(site)
    fill_islands(site)
    for road in ground.plan.crossings:
        for side in (-1, 1):
            line_side_road(site, road, side)
    fill_side_roads(site)
    fill_bus_stops(site)
    add_traffic(site, ego_speed, ego)
    add_people(site)
    park_two_wheelers(site)
    _add_work_zones(site)


def _fill_plots(site: Site, side: int) -> None:
    """Fill one side of a street (-1 right, 1 left) with plots, one after the other."""
    fillers = (fill_house, fill_row, fill_wood, fill_field, fill_yard)
    rng = site.rng

    x = rng.uniform(0, 8)

    while x < site.ground.length:
        fill = fillers[rng.choice(len(fillers), p=site.ground.style.plots)]
        has_house = fill in (fill_house, fill_row)
        width = rng.uniform(12, 24) if has_house else rng.uniform(18, 45)

        plot = Plot(site, side, x, width)
        if site.is_free(plot.middle, side * (plot.front + 8), width / 2 - 1):
            fill(plot)
        else:
            plant_bushes(plot, 4)
        x += width

    _add_long_barrier(site, side)
    _add_guide_posts(site, side)
    if side > 0:
        _add_overhead(site)


def _add_long_barrier(site: Site, side: int) -> None:
    """Put a guard rail, a noise barrier or a fence along a long stretch of a street."""
    rng = site.rng
    kind = site.ground.style.kind
    if rng.random() > LONG_BARRIER_CHANCE.get(kind, 0.1):
        return

    length = site.ground.length * rng.uniform(0.3, 1.0)
    start = rng.uniform(0, site.ground.length - length)
    plot = Plot(site, side, start, length)
    is_fast = kind == "fast" or rng.random() < 0.3
    boundary = draw_boundary(rng, "roadside" if is_fast else "open")

    nearest = site.ground.style.road / 2 + site.ground.style.parking[int(side > 0)] + 0.6
    tallest = max(layer.height for layer, _ in boundary.layers)
    if is_fast and tallest < 1.3 and rng.random() < 0.6:
        distance = nearest
    else:
        distance = plot.front + rng.choice([0.5, 2.0, 6.0, 14.0])
    line_up(plot, boundary, (plot.x, distance), (plot.end, distance))


def _add_guide_posts(site: Site, side: int) -> None:
    rng = site.rng
    style = site.ground.style
    if style.kind not in ("rural", "fast") or rng.random() < 0.3:
        return

    t = side * (style.road / 2 + style.parking[int(side > 0)] + rng.uniform(0.4, 1.2))
    spacing = rng.uniform(25, 50)
    for x in np.arange(rng.uniform(0, spacing), site.ground.length, spacing):
        site.put(furniture.guide_post(rng), x, t, 0.0 if side < 0 else np.pi)


def _add_overhead(site: Site) -> None:
    rng = site.rng
    ground = site.ground

    clear = ground.front(-1) + ground.front(1) + 2.0
    x = rng.uniform(0.3, 0.7) * ground.length
    offset = (ground.front(1) - ground.front(-1)) / 2
    if rng.random() < GANTRY_CHANCE.get(ground.style.kind, 0.0):
        site.put(furniture.gantry(rng, clear), x, offset, margin=3.0)
    elif rng.random() < BRIDGE_CHANCE:
        site.put(clutter.bridge(rng, clear), x, offset, margin=12.0)


def _add_work_zones(site: Site) -> None:
    """Put rows of barriers or cones at the edge of the road, some with a machine and workers."""
    rng = site.rng
    ground = site.ground

    rate = WORK_ZONES_PER_100_M * ground.style.region.work_zones
    for _ in range(rng.poisson(rate * ground.length / 100)):
        side = int(rng.choice([-1, 1]))
        start = rng.uniform(0, ground.length)
        edge = side * (ground.kerb_t(side) - 0.4)
        has_barriers = rng.random() < 0.5
        length = rng.uniform(8, 25)

        step = WORK_BARRIER_STEP if has_barriers else CONE_STEP
        for x in np.arange(start, start + length, step):
            segment = furniture.barrier(2.0) if has_barriers else furniture.traffic_cone(rng)
            site.put(segment, x, edge)

        if rng.random() < 0.45:
            t = side * (ground.front(side) + 2.5)
            machine = machines.machine(rng)
            yaw = rng.uniform(0, 2 * np.pi)
            site.put(machine, start + length / 2, t, yaw, thing=True, margin=3.0)
        for _ in range(rng.poisson(0.8)):
            t = side * (ground.front(side) + rng.uniform(0.5, 3))
            worker = people.person(rng)
            site.put(worker, start + rng.uniform(0, length), t, rng.uniform(0, 6.3), thing=True)
