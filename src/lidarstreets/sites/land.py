"""Fill plots with open land: woods, meadows, fields, orchards, allotments, parks, railways."""

from collections.abc import Callable

import numpy as np

from lidarstreets.bodies import buildings, clutter, furniture, plants, trees
from lidarstreets.chance import weighted_choice
from lidarstreets.materials import Label
from lidarstreets.sites.boundaries import draw_boundary, line_up
from lidarstreets.sites.site import Plot

MEADOW_TILE = 5.0  # side of a square patch of uncut grass, metres
COVER_TILE = 3.0  # side of a square patch of low plants, metres
# Functions that fill a plot, with their shares.
_Fillers = dict[Callable[[Plot], None], float]


def fill_wood(plot: Plot) -> None:
    """Plant a wood, its edge as a wall of leaves, an orchard or a park."""
    fillers: _Fillers = {_wood: 0.45, _wood_edge: 0.33, _orchard: 0.08, _park: 0.14}
    weighted_choice(plot.rng, fillers)(plot)


def fill_field(plot: Plot) -> None:
    """Fill a plot with open land, such as a meadow, a field, allotments or a building site."""
    fillers: _Fillers = {
        _meadow: 0.62,
        _crop_field: 0.12,
        _allotments: 0.08,
        _railway: 0.06,
        _playground: 0.07,
        _building_site: 0.05,
    }
    weighted_choice(plot.rng, fillers)(plot)


def _wood(plot: Plot) -> None:
    rng = plot.rng
    front = plot.front

    depth = rng.uniform(12, 28)
    density = rng.uniform(0.006, 0.025)  # trees per square metre
    for _ in range(rng.poisson(density * plot.width * depth)):
        tree = trees.random_tree(rng, rng.uniform(4, 13))
        plot.put(tree, plot.random_x(), front + rng.uniform(1.2, depth))
    if rng.random() < 0.3:
        plot.put(trees.stump(rng), plot.random_x(), front + rng.uniform(1, 8))

    plant_bushes(plot, rng.poisson(density * plot.width * 14), depth)
    if rng.random() < 0.9:
        grow_cover(plot, front + rng.uniform(0.1, 4), front + depth)
    if rng.random() < 0.75:
        plant_thickets(plot, front + rng.uniform(1.5, 10))
    if rng.random() < 0.4:
        _grow_grass(plot, front + rng.uniform(0.5, 3))
    if rng.random() < 0.3:
        _fence_off(plot, front + rng.uniform(0.3, 6))
    if rng.random() < 0.15:
        plot.put(plants.leaf_heap(rng), plot.random_x(), front + rng.uniform(1, 5))


def _wood_edge(plot: Plot) -> None:
    """Plant a high wall of leaves with stems in it, behind a strip of grass or bushes."""
    rng = plot.rng
    front = plot.front

    edge = front + rng.uniform(1.5, 8)
    plant_thickets(plot, edge, height=rng.uniform(3.5, 9))
    for x in np.arange(plot.x, plot.end, rng.uniform(4, 9)):
        tree = trees.tree(rng, rng.uniform(7, 14))
        plot.put(tree, x, edge + rng.uniform(-1.5, 1.5))
    if rng.random() < 0.6:
        grow_cover(plot, front + rng.uniform(0.1, edge - front), edge + 8)
    if rng.random() < 0.5:
        plant_bushes(plot, rng.poisson(4), edge - front + 0.5)
    if rng.random() < 0.5:
        _lay_turf(plot, front + 0.3, edge)
    if rng.random() < 0.35:
        _fence_off(plot, front + rng.uniform(0.3, edge - front))


def _orchard(plot: Plot) -> None:
    rng = plot.rng
    front = plot.front

    pitch = rng.uniform(3, 6)
    has_vines = rng.random() < 0.4

    for row in front + 2 + np.arange(4) * pitch * 0.9:
        for x in np.arange(plot.x + 1, plot.end, pitch):
            if has_vines:
                plot.put(plants.crop_row(rng, pitch, rng.uniform(1.3, 2.0)), x, row)
            else:
                plot.put(trees.tree(rng, rng.uniform(2.5, 5)), x, row)
    if rng.random() < 0.6:
        _fence_off(plot, front + 0.6)


def _park(plot: Plot) -> None:
    rng = plot.rng
    front = plot.front

    path_x = plot.random_x()
    label = Label.SIDEWALK if rng.random() < 0.5 else Label.OTHER_GROUND
    plot.pave((path_x, path_x + 2.2), (front, front + 25), label)
    path = front + rng.uniform(4, 15)
    plot.pave((plot.x, plot.end), (path, path + 2.0), label)

    for _ in range(rng.poisson(0.006 * plot.width * 25)):
        tree = trees.random_tree(rng, rng.uniform(4, 14))
        plot.put(tree, plot.random_x(), front + rng.uniform(1, 25))
    for _ in range(rng.poisson(2)):
        plot.put(clutter.clutter(rng), plot.random_x(), path - 0.8, plot.facing)
    plant_bushes(plot, rng.poisson(4), 18)
    if rng.random() < 0.4:
        line_up(plot, draw_boundary(rng), (plot.x, front + 0.3), (plot.end, front + 0.3))


def _meadow(plot: Plot) -> None:
    """Make a plot a meadow or gravel with a few bushes, perhaps with a fence and a barn."""
    rng = plot.rng
    front = plot.front

    if rng.random() < 0.1:
        gravel = (front + 1, front + rng.uniform(4, 20))
        plot.pave((plot.x, plot.end), gravel, Label.OTHER_GROUND)
    elif rng.random() < 0.5:
        _lay_turf(plot, front + 0.5, front + rng.uniform(6, 22))
    if rng.random() < plot.style.fenced * 0.5:
        _fence_off(plot, front + rng.choice([0.4, 1.5, 4.0, 10.0]))

    plant_bushes(plot, rng.poisson(2), 12)
    if rng.random() < 0.4:
        near = front + rng.uniform(0.1, 6)
        grow_cover(plot, near, near + rng.uniform(1.5, 10))
    if rng.random() < 0.75:
        plant_thickets(plot, front + rng.uniform(7, 26))
    if rng.random() < 0.25:
        _grow_grass(plot, front + rng.uniform(0.5, 6))
    if rng.random() < 0.2:
        _put_hall(plot)
    if rng.random() < 0.3:
        tree = trees.tree(rng, rng.uniform(6, 12))
        plot.put(tree, plot.x + plot.width * 0.7, front + rng.uniform(3, 10))
    if rng.random() < 0.25:
        plot.put(clutter.yard_clutter(rng), plot.random_x(), front + rng.uniform(2, 9))


def _put_hall(plot: Plot) -> None:
    rng = plot.rng
    kind = rng.random()
    if kind < 0.6:
        size = (rng.uniform(8, 14), rng.uniform(10, 16), rng.uniform(3, 5))
        building = buildings.gable_barn(rng, *size)
    elif kind < 0.9:
        building = buildings.hall(rng, rng.uniform(12, 25), rng.uniform(10, 14), rng.uniform(4, 8))
    else:
        building = buildings.church(rng)
    plot.put(building, plot.middle, plot.front + 22, plot.facing, margin=9.0)


def _crop_field(plot: Plot) -> None:
    rng = plot.rng
    front = plot.front

    start = front + rng.uniform(1.5, 5)
    if rng.random() < 0.5:
        _lay_turf(plot, start, start + 20)
        return
    height = rng.uniform(0.5, 2.5)
    for row in start + np.arange(5) * rng.uniform(0.8, 1.6):
        for x in np.arange(plot.x, plot.end, 5.0):
            plot.put(plants.crop_row(rng, 5.2, height), x, row, margin=3.0)


def _allotments(plot: Plot) -> None:
    rng = plot.rng
    front = plot.front

    boundary = draw_boundary(rng)
    line_up(plot, boundary, (plot.x, front + 0.5), (plot.end, front + 0.5))

    for x in np.arange(plot.x + 4, plot.end, 9.0):
        side = draw_boundary(rng)
        line_up(plot, side, (x + 4.5, front + 0.5), (x + 4.5, front + 14))
        plot.put(buildings.shed(rng), x, front + rng.uniform(4, 12), plot.facing, margin=4.0)
        plot.put(plants.flower_bed(rng, 3.5), x, front + rng.uniform(1.5, 5), margin=2.5)
        tree = trees.tree(rng, rng.uniform(2.5, 5))
        plot.put(tree, x + rng.uniform(-3, 3), front + rng.uniform(1.5, 9))
        if rng.random() < 0.3:
            plot.put(buildings.greenhouse(rng), x, front + 13, margin=5.0)
        if rng.random() < 0.7:
            plot.put(clutter.yard_clutter(rng), x + 2, front + rng.uniform(2, 7))


def _railway(plot: Plot) -> None:
    rng = plot.rng
    track = plot.front + rng.uniform(4, 14)

    plot.pave((plot.x, plot.end), (track - 2.2, track + 2.2), Label.OTHER_GROUND)
    for x in np.arange(plot.x + 5, plot.end, 25.0):
        mast = furniture.railway_mast(rng)
        plot.put(mast, x, track - 2.8, plot.facing + np.pi if plot.side < 0 else 0.0)
    if rng.random() < 0.6:
        _fence_off(plot, track - 3.5)
    _grow_grass(plot, track - 3.2)
    if rng.random() < 0.5:
        plant_thickets(plot, track + rng.uniform(4, 8))


def _playground(plot: Plot) -> None:
    rng = plot.rng
    front = plot.front

    if rng.random() < 0.6:
        plot.pave((plot.x + 1, plot.end - 1), (front + 2, front + 16), Label.OTHER_GROUND)
    for _ in range(rng.poisson(4)):
        thing = clutter.yard_clutter(rng)
        plot.put(thing, plot.random_x(), front + rng.uniform(3, 15), rng.uniform(0, 6))
    for _ in range(rng.poisson(3)):
        tree = trees.random_tree(rng, rng.uniform(4, 9))
        plot.put(tree, plot.random_x(), front + rng.uniform(1.5, 16))
    _fence_off(plot, front + 0.5)


def _building_site(plot: Plot) -> None:
    rng = plot.rng
    front = plot.front

    plot.pave((plot.x + 1, plot.end - 1), (front + 1, front + 18), Label.OTHER_GROUND)
    for _ in range(rng.poisson(6)):
        thing = clutter.yard_clutter(rng) if rng.random() < 0.7 else clutter.clutter(rng)
        plot.put(thing, plot.random_x(), front + rng.uniform(2, 15), rng.uniform(0, 6))
    _fence_off(plot, front + 0.7)


def _fence_off(plot: Plot, distance: float) -> None:
    """Put a fence along a plot, `distance` metres from the middle line of the street."""
    boundary = draw_boundary(plot.rng, "open")
    drift = plot.rng.normal(scale=0.4)
    line_up(plot, boundary, (plot.x, distance), (plot.end, distance + drift))


def _grow_grass(plot: Plot, distance: float) -> None:
    for x in np.arange(plot.x, plot.end, 3.0):
        plot.put(plants.tall_grass(plot.rng, 3.0), x, distance)


def _lay_turf(plot: Plot, near: float, far: float) -> None:
    """Cover a plot with uncut grass or stubble between two distances from the middle line."""
    rng = plot.rng
    height = rng.uniform(0.06, 0.25)
    size = (MEADOW_TILE, MEADOW_TILE)
    for x in np.arange(plot.x, plot.end, MEADOW_TILE) + MEADOW_TILE / 2:
        for distance in np.arange(near, min(far, near + 20), MEADOW_TILE) + MEADOW_TILE / 2:
            if rng.random() < 0.85:
                tile = plants.turf(rng, size, height, tint=_ground_tint(plot, x, distance))
                plot.put_piece(tile, x, distance, margin=3.0)


def grow_cover(plot: Plot, near: float, far: float) -> None:
    """Cover a plot with ivy, brambles or fern between two distances from the middle line."""
    rng = plot.rng
    plot.overgrow(near, far)

    height = rng.uniform(0.03, 0.4)
    filled = rng.uniform(0.0, 0.9)
    for x in np.arange(plot.x, plot.end, COVER_TILE) + COVER_TILE / 2:
        for distance in np.arange(near, min(far, near + 15), COVER_TILE) + COVER_TILE / 2:
            if rng.random() < filled:
                tile = plants.ground_cover(rng, COVER_TILE, height * rng.uniform(0.5, 1.5))
                plot.put_piece(tile, x, distance, margin=2.0)


def _ground_tint(plot: Plot, x: float, distance: float) -> float:
    ground = plot.site.ground
    px, py, _ = ground.pose_at(x, plot.side * distance)
    return float(ground.tint(np.array([px]), np.array([py]), np.array([Label.TERRAIN]))[0])


def plant_thickets(plot: Plot, distance: float, height: float | None = None) -> None:
    """Plant undergrowth along a street, perhaps with gaps.

    It begins `height` metres high, or as high as drawn if that is None, and changes slowly.
    """
    rng = plot.rng
    thicket = plants.draw_thicket(rng)
    change = rng.choice([0.1, 0.5])
    filled = rng.choice([0.85, 1.0])

    # The ground under and behind undergrowth also has the class vegetation.
    if rng.random() < 0.7:
        plot.overgrow(distance - rng.uniform(0.2, 1.5), distance + rng.uniform(1, 10))

    height = float(rng.uniform(1.2, 5.0)) if height is None else height
    highest = max(6.0, 1.3 * height)

    for x in np.arange(plot.x + 2, plot.end, 4.0):
        height = float(np.clip(height + rng.normal(scale=change), 0.8, highest))
        if rng.random() < filled:
            piece = thicket.segment(rng, 4.0, height)
            plot.put_piece(piece, x, distance + rng.normal(scale=0.2), margin=2.5)


def plant_bushes(plot: Plot, count: int, depth: float = 6.0) -> None:
    """Plant `count` bushes within `depth` metres of the front of a plot."""
    rng = plot.rng
    for _ in range(count):
        distance = plot.front + rng.uniform(0.8, max(depth, 1.5))
        is_slender = rng.random() < 0.3
        bush = plants.slender_bush(rng) if is_slender else plants.bush(rng, rng.uniform(0.3, 1.6))
        plot.put(bush, plot.random_x(), distance)
