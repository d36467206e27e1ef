"""Fills a street with everything that stands and moves in it."""

from __future__ import annotations

import numpy as np

from amvnet.simulation.bodies import (
    buildings,
    clutter,
    fence_shapes,
    furniture,
    plants,
    trees,
    vehicles,
)
from amvnet.simulation.mesh import Mesh
from amvnet.simulation.sites.areas import add_areas
from amvnet.simulation.sites.boundaries import SEGMENT, draw_boundary
from amvnet.simulation.sites.crowd import add_people, park_two_wheelers
from amvnet.simulation.sites.land import plant_thickets
from amvnet.simulation.sites.plot import Plot
from amvnet.simulation.sites.plots import fill_plots
from amvnet.simulation.sites.site import Site
from amvnet.simulation.sites.traffic import (
    add_traffic,
    along_road,
    fill_bus_stops,
    fill_parking_lane,
    fill_side_roads,
    park_anywhere,
)
from amvnet.simulation.streets.plans import Roundabout, SideRoad
from amvnet.simulation.streets.styles import width_of

# Roadside furniture per 100 m of street on each side.
SIGNS = 3.0
POSTS = 0.5
CLUTTER = 1.6
SHELTERS = 0.15
# Work zones per 100 m of street.
WORK_ZONES = 0.25
# Metres between the trees, houses and copses of the second row, along the street.
BACKGROUND_STEP = 14.0
# Kinds of streets with houses behind the plots and along side roads.
BUILT_UP = ("residential", "urban", "living", "avenue")
# Share of the streets of a kind with a crash barrier along one side.
GUARD_RAIL = {"motorway": 0.75, "fast": 0.6, "rural": 0.15}
# Metres: distance between the segments of crash barriers, and by how much two of steel and two of
# concrete overlap, so that no gap shows in a bend.
BARRIER_STEP = 4.0
RAIL_OVERLAP = 0.1
CONCRETE_OVERLAP = 0.05
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
        _fill_roadside(site, side)
        _fill_background(site, side)

    _close_ends(site)
    _fill_islands(site)
    for road in ground.plan.crossings:
        for side in (-1, 1):
            _line_side_road(site, road, side)
    fill_side_roads(site)
    fill_bus_stops(site)
    add_traffic(site, ego_speed, ego)
    add_people(site)
    park_two_wheelers(site)
    _add_work_zones(site)


def _fill_roadside(site: Site, side: int) -> None:
    """Put lamps, trees, signs, posts, bins, shelters and perhaps a crash barrier along the road."""
    rng = site.rng
    ground = site.ground
    style = ground.style

    kerb_t = side * (ground.kerb_t(side) + 0.35)
    back_t = side * (max(ground.front(side), ground.kerb_t(side) + 0.5) - 0.3)
    yaw = along_road(side)

    has_wires = style.kind == "rural" or rng.random() < 0.15
    make_pole = furniture.utility_pole if has_wires else furniture.lamp
    for x in np.arange(rng.uniform(0, style.lamps), ground.length, style.lamps):
        _put_on_street(site, make_pole(rng), x, kerb_t if rng.random() < 0.7 else back_t, yaw)

    if np.isfinite(style.trees):
        for x in np.arange(rng.uniform(0, style.trees), ground.length, style.trees):
            tree = trees.random_tree(rng, rng.uniform(4, 9))
            site.put(tree, x + rng.normal(), back_t, margin=2.0)
    if np.isfinite(style.parking_period) and style.parking[int(side > 0)] and rng.random() < 0.6:
        _plant_parking_islands(site, side)

    roadside = (
        (furniture.sign, SIGNS, kerb_t),
        (furniture.post, POSTS, back_t),
        (clutter.clutter, CLUTTER, back_t),
        (clutter.shelter, SHELTERS, back_t),
    )

    for make, per_100_m, t in roadside:
        if make is clutter.shelter and style.kind == "motorway":
            continue
        for _ in range(rng.poisson(per_100_m * ground.length / 100)):
            _put_on_street(site, make(rng), rng.uniform(0, ground.length), t, yaw)

    _put_guard_rail(site, side)


def _put_guard_rail(site: Site, side: int) -> None:
    """Put a crash barrier along one side of most fast roads."""
    rng = site.rng
    ground = site.ground
    style = ground.style
    yaw = along_road(side)

    if rng.random() >= GUARD_RAIL.get(style.kind, 0.0):
        return

    t = side * (style.road / 2 + rng.uniform(0.5, 0.9))
    if style.strips[int(side > 0)] and style.kind == "motorway":
        t = side * (ground.front(side) - rng.uniform(0.3, 0.8))
    for x in np.arange(0, ground.length, BARRIER_STEP):
        site.put(fence_shapes.guard_rail(BARRIER_STEP + RAIL_OVERLAP), x, t, yaw)


def _put_on_street(site: Site, mesh: Mesh, x: float, t: float, yaw: float) -> None:
    """Put a body at x, t if the street passes x."""
    if site.ground.is_street(x):
        site.put(mesh, x, t, yaw)


def _plant_parking_islands(site: Site, side: int) -> None:
    """Plant trees on the islands between parking bays."""
    style = site.ground.style
    t = side * (style.road / 2 + style.parking[int(side > 0)] * 0.6)
    for x in np.arange(1.0, site.ground.length, style.parking_period):
        tree = trees.random_tree(site.rng, site.rng.uniform(3, 8))
        site.put(tree, x, t, margin=2.0)


def _fill_background(site: Site, side: int) -> None:
    """Put a second row of trees and houses behind the plots, which closes off the view."""
    rng = site.rng
    ground = site.ground
    front = ground.front(side)
    has_houses = ground.style.kind in BUILT_UP
    # Some streets have a free view.
    density = rng.choice([1.0, 0.6, 0.2], p=[0.6, 0.25, 0.15])

    for x in np.arange(rng.uniform(0, 10), ground.length, BACKGROUND_STEP):
        if rng.random() > density:
            continue

        t = side * (front + rng.uniform(32, 45))
        if rng.random() < 0.45:
            plot = Plot(site, side, x, BACKGROUND_STEP)
            plant_thickets(plot, front + rng.uniform(24, 34))

        if rng.random() < 0.35 and has_houses:
            _put_background_house(site, x, t)
        else:
            site.put(trees.random_tree(rng, rng.uniform(6, 14), fine=False), x, t)

        copse_t = side * (front + rng.uniform(42, 66))
        copse = trees.copse(rng, BACKGROUND_STEP, rng.uniform(5, 12))
        site.put(copse, x, copse_t, margin=10.0)


def _put_background_house(site: Site, x: float, t: float) -> None:
    rng = site.rng

    width = rng.uniform(9, 16)
    depth = rng.uniform(8, 12)
    height = rng.uniform(*site.ground.style.storeys)

    house = buildings.building(rng, width, depth, height, flat=rng.random() < 0.2)
    site.put(house, x, t, rng.normal(scale=0.3), margin=6.0)


def _close_ends(site: Site) -> None:
    """Put a hedge, a fence, a wall or a house behind the end of a street."""
    rng = site.rng
    ground = site.ground

    for x, outwards in ((ground.plan.start, -1), (ground.plan.end, 1)):
        if not np.isfinite(x):
            continue

        reach = max(ground.front(-1), ground.front(1))
        if rng.random() < 0.4:
            house = buildings.building(
                rng, 2 * reach, 9.0, rng.uniform(*ground.style.storeys), flat=False
            )
            away = rng.uniform(9, 18)
            site.put(house, x + outwards * away, 0.0, np.pi / 2, margin=5.0)
            continue

        is_wild = rng.random() < 0.33
        layer, _ = draw_boundary(rng).layers[0]
        for t in np.arange(-reach, reach, SEGMENT):
            if is_wild:
                segment = plants.bush(rng, rng.uniform(0.8, 1.8))
            else:
                segment = layer.segment(rng, SEGMENT)
            site.put(segment, x + outwards * rng.uniform(1.5, 2.0), t + 1.2, np.pi / 2)


def _line_side_road(site: Site, road: SideRoad, side: int) -> None:
    """Put hedges, walls, fences, trees and houses along one side of a side road."""
    rng = site.rng
    ground = site.ground
    if ground.style.kind == "motorway":
        return

    edge = road.width / 2 + width_of(road.strips)
    first = ground.front(road.side) + rng.uniform(1, 5)
    last = min(road.length, first + rng.uniform(6, 22))

    if rng.random() < 0.75:
        layer, _ = draw_boundary(rng).layers[0]
        for along in np.arange(first, last, SEGMENT):
            _put_along(site, road, layer.segment(rng, SEGMENT), along, side * (edge + 0.4))

    has_houses = ground.style.kind in BUILT_UP

    for along in np.arange(first + 5, last + 10, rng.uniform(10, 20)):
        width = rng.uniform(7, 12)
        depth = rng.uniform(7, 11)
        across = side * (edge + depth / 2 + rng.uniform(0.5, 6.0))
        if has_houses and rng.random() < 0.5:
            storeys = rng.uniform(*ground.style.storeys)
            house = buildings.building(rng, width, depth, storeys, flat=rng.random() < 0.2)
            _put_along(site, road, house, along + width / 2, across, reach=width / 2)
        else:
            _put_along(site, road, trees.random_tree(rng, rng.uniform(4, 9)), along, across)


def _put_along(
    site: Site, road: SideRoad, mesh: Mesh, along: float, across: float, reach: float = 1.0
) -> None:
    """Put a body next to a side road, unless the street or another road is within its reach."""
    ground = site.ground
    px, py, yaw = road.pose_at(along, across)
    x = np.array([px])
    y = np.array([py])
    _, t = ground.street_coordinates(x, y)
    is_clear = abs(t[0]) > ground.front(road.side) + reach
    if is_clear and ground.distance_from_crossings(x, y)[0] > reach:
        site.put_at(mesh, px, py, yaw)


def _fill_islands(site: Site) -> None:
    """Put crash barriers, trees, bushes, lamps and signs on the islands in the road."""
    rng = site.rng
    ground = site.ground
    style = ground.style
    has_trees = rng.random() < 0.45
    barrier = rng.choice(["rail", "concrete", "none"], p=[0.5, 0.3, 0.2])

    for island in ground.plan.islands:
        start = max(island.x[0], 0.0)
        stop = min(island.x[1], ground.length)
        middle = sum(island.t) / 2
        if style.kind in ("motorway", "fast") and style.has_long_median and barrier != "none":
            _put_barriers(site, (start, stop), middle, str(barrier))
            continue
        if not style.has_long_median:
            for x in (start + 0.7, stop - 0.7):
                site.put(furniture.sign(rng), x, middle, along_road(-1), margin=-np.inf)
            continue

        for x in np.arange(start + 3, stop - 3, rng.uniform(7, 16)):
            if has_trees and style.median > 1.5:
                site.put(trees.random_tree(rng, rng.uniform(4, 9)), x, middle)
            elif rng.random() < 0.3:
                site.put(furniture.lamp(rng), x, middle)
            elif rng.random() < 0.4:
                site.put(plants.hedge(rng, 4.0, rng.uniform(0.6, 1.4)), x, middle)

    if ground.plan.roundabout is not None:
        _fill_roundabout(site, ground.plan.roundabout)


def _put_barriers(site: Site, x: tuple[float, float], t: float, kind: str) -> None:
    """Put a crash barrier along the middle of the road between two x.

    Args:
        site: the street.
        x: from and to, along the street.
        t: of the barrier.
        kind: "rail" for steel on both sides, otherwise concrete.
    """
    rail = fence_shapes.guard_rail(BARRIER_STEP + RAIL_OVERLAP)
    concrete = furniture.barrier(BARRIER_STEP + CONCRETE_OVERLAP)
    for middle in np.arange(x[0], x[1], BARRIER_STEP):
        if kind == "rail":
            site.put(rail, middle, t + 0.3, margin=-np.inf)
            site.put(rail, middle, t - 0.3, np.pi, margin=-np.inf)
        else:
            site.put(concrete, middle, t, margin=-np.inf)


def _fill_roundabout(site: Site, roundabout: Roundabout) -> None:
    """Plant trees and bushes on the island of the roundabout."""
    rng = site.rng
    reach = roundabout.island - 1.5

    for _ in range(rng.poisson(0.3 * max(reach, 0) ** 1.5)):
        angle = rng.uniform(0, 2 * np.pi)
        radius = reach * np.sqrt(rng.random())
        if rng.random() < 0.3:
            plant = trees.random_tree(rng, rng.uniform(3, 8))
        else:
            plant = plants.bush(rng, rng.uniform(0.3, 1.2))

        x = roundabout.x + radius * np.cos(angle)
        site.put_at(plant, x, roundabout.y + radius * np.sin(angle), 0.0)


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
