"""Close off the view behind the plots, at the ends of a street and along its side roads."""

import numpy as np

from lidarstreets.bodies import buildings, plants, trees
from lidarstreets.mesh import Mesh
from lidarstreets.sites.boundaries import SEGMENT_LENGTH, draw_boundary
from lidarstreets.sites.land import plant_thickets
from lidarstreets.sites.site import Plot, Site
from lidarstreets.streets.plans import SideRoad
from lidarstreets.streets.styles import width_of

# Distance between the trees, houses and copses behind the plots, metres along the street.
BACKGROUND_STEP = 14.0
# Kinds of streets that have houses behind the plots and along side roads.
BUILT_UP = ("residential", "urban", "living", "avenue")


def fill_background(site: Site, side: int) -> None:
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
        if rng.random() < 0.6:
            plot = Plot(site, side, x, BACKGROUND_STEP)
            plant_thickets(plot, front + rng.uniform(24, 34))

        if rng.random() < 0.2 and has_houses:
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


def close_ends(site: Site) -> None:
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
        boundary = draw_boundary(rng)
        for t in np.arange(-reach, reach, SEGMENT_LENGTH) + SEGMENT_LENGTH / 2:
            away = rng.uniform(1.5, 2.0)
            if is_wild:
                site.put(plants.bush(rng, rng.uniform(0.8, 1.8)), x + outwards * away, t, np.pi / 2)
                continue

            for layer, offset in boundary.layers:
                segment = layer.segment(rng, SEGMENT_LENGTH)
                site.put(segment, x + outwards * (away + offset), t, np.pi / 2)


def line_side_road(site: Site, road: SideRoad, side: int) -> None:
    """Put hedges, walls, fences, trees and houses along one side (-1 or 1) of a side road."""
    rng = site.rng
    ground = site.ground
    if ground.style.kind == "motorway":
        return

    edge = road.width / 2 + width_of(road.strips)
    first = ground.front(road.side) + rng.uniform(1, 5)
    last = min(road.length, first + rng.uniform(6, 22))

    if rng.random() < 0.75:
        boundary = draw_boundary(rng)
        for along in np.arange(first, last, SEGMENT_LENGTH):
            for layer, offset in boundary.layers:
                segment = layer.segment(rng, SEGMENT_LENGTH)
                _put_along(site, road, segment, along, side * (edge + 0.4 + offset))

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
    """Put a body next to a side road, unless the street or a side road is within its reach.

    `along` and `across` are the body's coordinates on the side road, and `reach` is its radius;
    all are in metres.
    """
    ground = site.ground
    px, py, yaw = road.pose_at(along, across)
    x = np.array([px])
    y = np.array([py])
    _, t = ground.street_coordinates(x, y)
    is_clear = abs(t[0]) > ground.front(road.side) + reach
    if is_clear and ground.distance_from_crossings(x, y)[0] > reach:
        site.put_at(mesh, px, py, yaw)
