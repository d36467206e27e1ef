"""Put lamps, signs, trees, crash barriers and other furniture along a road and on its islands."""

import numpy as np

from lidarstreets.bodies import clutter, fences, furniture, plants, trees
from lidarstreets.mesh import Mesh
from lidarstreets.sites.site import Site
from lidarstreets.sites.traffic import along_road
from lidarstreets.streets.plans import Roundabout

# Mean numbers of pieces of furniture per 100 m of street on each side.
SIGNS = 3.0
POSTS = 0.5
SLENDER_BUSHES = 0.8  # multiplied by `Style.green`
CLUTTER = 1.6
SHELTERS = 0.15
# Mean number of direction boards per 100 m of street on each side, by kind of street.
BOARDS = {"motorway": 0.35, "fast": 0.35, "rural": 0.12, "avenue": 0.12, "urban": 0.05}
# Chance of a crash barrier along one side of a street, by kind of street.
GUARD_RAIL_CHANCE = {"motorway": 0.75, "fast": 0.6, "rural": 0.15}
BARRIER_STEP = 4.0  # distance between the segments of a crash barrier, metres
# Overlap of two segments, so that no gap shows in a bend, metres.
RAIL_OVERLAP = 0.1
CONCRETE_OVERLAP = 0.05


def fill_roadside(site: Site, side: int) -> None:
    """Put lamps, trees, signs, posts, shelters and perhaps a crash barrier along one side."""
    rng = site.rng
    ground = site.ground
    style = ground.style

    kerb_t = side * (ground.kerb_t(side) + 0.35)
    back_t = side * (max(ground.front(side), ground.kerb_t(side) + 0.5) - 0.3)
    yaw = along_road(side)

    has_wires = style.kind == "rural" or rng.random() < 0.15 * style.region.wires
    make_pole = furniture.utility_pole if has_wires else furniture.lamp
    for x in np.arange(rng.uniform(0, style.lamps), ground.length, style.lamps):
        _put_on_street(site, make_pole(rng), x, kerb_t if rng.random() < 0.7 else back_t, yaw)

    if np.isfinite(style.trees):
        for x in np.arange(rng.uniform(0, style.trees), ground.length, style.trees):
            tree = trees.street_tree(rng, rng.uniform(4, 9), style.region.palms)
            site.put(tree, x + rng.normal(), back_t, margin=2.0)
    has_parking = style.parking[int(side > 0)] > 0 and not style.is_bus_bay[int(side > 0)]
    if np.isfinite(style.parking_period) and has_parking and rng.random() < 0.6:
        _plant_parking_islands(site, side)

    roadside = (
        (furniture.sign, SIGNS, kerb_t),
        (furniture.post, POSTS, back_t),
        (plants.slender_bush, SLENDER_BUSHES * style.green, back_t),
        (clutter.clutter, CLUTTER, back_t),
        (clutter.shelter, SHELTERS, back_t),
        (furniture.direction_board, BOARDS.get(style.kind, 0.0), back_t + side * 1.5),
    )

    for make, per_100_m, t in roadside:
        if make is clutter.shelter and style.kind == "motorway":
            continue
        for _ in range(rng.poisson(per_100_m * ground.length / 100)):
            _put_on_street(site, make(rng), rng.uniform(0, ground.length), t, yaw)

    _put_guard_rail(site, side)


def _put_guard_rail(site: Site, side: int) -> None:
    rng = site.rng
    ground = site.ground
    style = ground.style
    yaw = along_road(side)

    if rng.random() >= GUARD_RAIL_CHANCE.get(style.kind, 0.0):
        return

    t = side * (style.road / 2 + rng.uniform(0.5, 0.9))
    if style.strips[int(side > 0)] and style.kind == "motorway":
        t = side * (ground.front(side) - rng.uniform(0.3, 0.8))
    for x in np.arange(0, ground.length, BARRIER_STEP):
        site.put(fences.guard_rail(BARRIER_STEP + RAIL_OVERLAP), x, t, yaw)


def _put_on_street(site: Site, mesh: Mesh, x: float, t: float, yaw: float) -> None:
    """Put a body at street coordinates x, t, unless x is beyond an end of the street."""
    if site.ground.is_street(x):
        site.put(mesh, x, t, yaw)


def _plant_parking_islands(site: Site, side: int) -> None:
    style = site.ground.style
    t = side * (style.road / 2 + style.parking[int(side > 0)] * 0.6)
    for x in np.arange(1.0, site.ground.length, style.parking_period):
        tree = trees.street_tree(site.rng, site.rng.uniform(3, 8), site.ground.style.region.palms)
        site.put(tree, x, t, margin=2.0)


def fill_islands(site: Site) -> None:
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
                site.put(furniture.sign(rng), x, middle, along_road(-1), margin=None)
            continue

        for x in np.arange(start + 3, stop - 3, rng.uniform(7, 16)):
            if has_trees and style.median > 1.5:
                palms = site.ground.style.region.palms
                site.put(trees.street_tree(rng, rng.uniform(4, 9), palms), x, middle)
            elif rng.random() < 0.3:
                site.put(furniture.lamp(rng), x, middle)
            elif rng.random() < 0.4:
                hedge = plants.draw_hedge(rng, rng.uniform(0.6, 1.4))
                site.put(hedge.segment(rng, 4.0), x, middle)

    if ground.plan.roundabout is not None:
        _fill_roundabout(site, ground.plan.roundabout)


def _put_barriers(site: Site, x: tuple[float, float], t: float, kind: str) -> None:
    """Put a crash barrier at t from `x[0]` to `x[1]` along the street.

    If `kind` is "rail", it is a steel rail on each side, otherwise a concrete barrier.
    """
    rail = fences.guard_rail(BARRIER_STEP + RAIL_OVERLAP)
    concrete = furniture.barrier(BARRIER_STEP + CONCRETE_OVERLAP)
    for middle in np.arange(x[0], x[1], BARRIER_STEP):
        if kind == "rail":
            site.put(rail, middle, t + 0.3, margin=None)
            site.put(rail, middle, t - 0.3, np.pi, margin=None)
        else:
            site.put(concrete, middle, t, margin=None)


def _fill_roundabout(site: Site, roundabout: Roundabout) -> None:
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
