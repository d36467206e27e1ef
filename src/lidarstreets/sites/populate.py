"""Fills a street with everything that stands and moves in it."""

from __future__ import annotations

import numpy as np

from lidarstreets.bodies import furniture, vehicles
from lidarstreets.sites.areas import add_areas
from lidarstreets.sites.background import close_ends, fill_background, line_side_road
from lidarstreets.sites.crowd import add_people, park_two_wheelers
from lidarstreets.sites.plots import fill_plots
from lidarstreets.sites.roadside import fill_islands, fill_roadside
from lidarstreets.sites.site import Site
from lidarstreets.sites.traffic import (
    add_traffic,
    fill_bus_stops,
    fill_parking_lane,
    fill_side_roads,
    park_anywhere,
)

# Work zones per 100 m of street.
WORK_ZONES = 0.25
# Metres between the barriers and between the cones of a work zone.
WORK_BARRIER_STEP = 2.05
CONE_STEP = 3.0


def populate(site: Site, ego_speed: float, ego: tuple[float, float]) -> None:
    """Fill a street with everything that stands and moves in it.

    Args:
        site: the street; its open areas may be reserved already.
        ego_speed: speed of the car with the sensor, metres per second.
        ego: x and t of that car at time 0; no traffic in its lane starts near it.
    """
    ground = site.ground
    add_areas(site)

    for side in (-1, 1):
        fill_plots(site, side)
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


def _add_work_zones(site: Site) -> None:
    """Put rows of barriers or cones at the edge of the road, some with a machine behind them."""
    rng = site.rng
    ground = site.ground

    for _ in range(rng.poisson(WORK_ZONES * ground.length / 100)):
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
            machine = vehicles.machine(rng)
            yaw = rng.uniform(0, 2 * np.pi)
            site.put(machine, start + length / 2, t, yaw, thing=True, margin=3.0)
        for _ in range(rng.poisson(0.8)):
            t = side * (ground.front(side) + rng.uniform(0.5, 3))
            worker = vehicles.person(rng)
            site.put(worker, start + rng.uniform(0, length), t, rng.uniform(0, 6.3), thing=True)
