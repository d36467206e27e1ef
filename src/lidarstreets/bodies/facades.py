"""Make meshes of the walls of houses, with windows, doors, balconies and what hangs on them.

A facade lies along x at y = 0 and faces -y.
"""

from dataclasses import dataclass, replace

import numpy as np

from lidarstreets.bodies.plants import ivy
from lidarstreets.materials import Label, Surface
from lidarstreets.mesh import Mesh, join, part
from lidarstreets.solids import box, copies, leaning, moved, planks, tube

BELOW_GROUND = 1.5  # depth of walls below the ground, so that a slope leaves no gap, metres
# Largest height of a window, metres: few pulses arrive above it.
HIGHEST_WINDOW = 9.0


@dataclass(frozen=True)
class Facade:
    """The measures and the look of the walls of one house; lengths are in metres.

    Attributes:
        surface: surface of the walls.
        storey: height of a storey.
        pitch: distance between two windows.
        window: width and height of a window.
        recess: depth of the windows in the wall.
        plinth: height of a plinth that sticks out; 0 if there is none.
        shutters: whether the windows have shutters.
        timber: whether the wall has a timber frame.
        patchy: standard deviation of the tint between the parts of a wall.
        shop: whether the ground floor is one band of windows.
        balconies: chance of a balcony at each window above the ground floor.
    """

    surface: Surface
    storey: float
    pitch: float
    window: tuple[float, float]
    recess: float
    plinth: float
    shutters: bool
    timber: bool
    patchy: float
    shop: bool
    balconies: float


def draw_facade(rng: np.random.Generator, height: float) -> Facade:
    """Draw the look of a house whose walls are `height` metres high."""
    surfaces = (Surface.PLASTER, Surface.BRICK, Surface.STONE, Surface.WOOD)
    is_tall = height > 7

    return Facade(
        surface=surfaces[rng.choice(4, p=[0.7, 0.18, 0.06, 0.06])],
        storey=float(rng.uniform(2.5, 3.4)),
        pitch=float(rng.uniform(1.8, 4.5)),
        window=(float(rng.uniform(0.7, 1.6)), float(rng.uniform(1.0, 1.7))),
        recess=float(rng.uniform(0.03, 0.3)),
        plinth=float(rng.uniform(0.3, 1.0) if rng.random() < 0.4 else 0),
        shutters=bool(rng.random() < 0.25),
        timber=bool(rng.random() < 0.06),
        patchy=float(rng.choice([0.0, 0.25, 0.7], p=[0.4, 0.4, 0.2])),
        shop=bool(rng.random() < (0.25 if is_tall else 0.04)),
        balconies=float(rng.choice([0.0, 0.2, 0.9], p=[0.6, 0.25, 0.15])),
    )


def plain_wall(facade: Facade, width: float, height: float) -> Mesh:
    """Return a wall without windows, `width` metres along x."""
    wall = planks(0, width, -BELOW_GROUND, height)
    return part([wall], facade.surface, Label.BUILDING)


def wall(rng: np.random.Generator, facade: Facade, width: float, height: float) -> Mesh:
    """Return a wall, `width` metres along x, with windows in every storey and what hangs on it."""
    margin = facade.window[0] / 2 + 0.3
    count = int((width - 2 * margin) / facade.pitch) + 1
    if width < 2 * margin or height < 2.3:
        return plain_wall(facade, width, height)

    middles = (np.arange(count) - (count - 1) / 2) * facade.pitch + rng.uniform(-0.2, 0.2)
    sills = np.arange(0.9, min(height, HIGHEST_WINDOW) - facade.window[1] - 0.1, facade.storey)

    parts = []
    bottom = -BELOW_GROUND

    for storey, sill in enumerate(sills):
        low = sill
        top = min(sill + facade.window[1], height)
        openings = facade.window[0]
        if storey == 0 and facade.shop:
            low = 0.5
            top = min(2.5, height)
            openings = 0.85 * facade.pitch

        levels = (bottom, low, top)
        parts += _storey(rng, facade, width, middles, levels=levels, opening=openings)
        if facade.shutters and not (storey == 0 and facade.shop):
            parts.append(_shutters(facade, middles, (low, top)))
        bottom = top
        if storey > 0:
            taken = rng.random(count) < facade.balconies
            parts += _balconies(rng, middles[taken], sill - 0.9)

    last = planks(0, width, bottom, height)
    parts.append(part([last], facade.surface, Label.BUILDING))
    return join(*parts, *_extras(rng, facade, width, height))


def _storey(
    rng: np.random.Generator,
    facade: Facade,
    width: float,
    middles: np.ndarray,
    levels: tuple[float, float, float],
    opening: float,
) -> list[Mesh]:
    """Return the wall and the windows of one storey.

    Args:
        rng: draws the tints of the parts of the wall.
        width: width of the wall, metres.
        middles: x of the middles of the windows, metres.
        levels: heights of the lower edge of the storey, of the sills and of the tops of the
            windows, metres.
        opening: width of a window, metres.
    """
    bottom, sill, top = levels
    edges = np.concatenate([[-width / 2], np.repeat(middles, 2), [width / 2]])
    edges[1:-1:2] -= opening / 2
    edges[2:-1:2] += opening / 2
    left = edges[::2]
    right = edges[1::2]

    # The band below the windows, and the pillars between them.
    x = np.concatenate([[0], (left + right) / 2])
    widths = np.concatenate([[width], np.maximum(right - left, 0.02)])
    lows = np.concatenate([[bottom], np.full(len(left), sill)])
    tops = np.concatenate([[sill], np.full(len(left), top)])
    walls = part([planks(x, widths, lows, tops)], facade.surface, Label.BUILDING)
    tints = np.tile(rng.normal(scale=facade.patchy, size=len(x)), 2)
    walls = replace(walls, tint=tints.astype(np.float32))

    panes = planks(0, width - 0.05, sill - 0.1, top + 0.1, facade.recess)
    sills = planks(middles, opening + 0.1, sill - 0.05, sill, -0.06)

    return [
        walls,
        part([panes], Surface.WINDOW, Label.BUILDING),
        part([sills], facade.surface, Label.BUILDING, tint=0.5),
    ]


def _shutters(facade: Facade, middles: np.ndarray, levels: tuple[float, float]) -> Mesh:
    half = facade.window[0] / 2
    width = 0.55 * facade.window[0]
    x = np.concatenate([middles - half - width / 2, middles + half + width / 2])
    return part([planks(x, width, *levels, -0.05)], Surface.WOOD, Label.BUILDING)


def _balconies(rng: np.random.Generator, middles: np.ndarray, floor: float) -> list[Mesh]:
    """Return balconies at the windows `middles` (x) of a storey whose floor is `floor` high."""
    if not len(middles):
        return []

    reach = rng.uniform(0.8, 1.8)
    slab = box((2.6, reach, 0.18), (0, -reach / 2, floor - 0.18))
    rail = planks(0, 2.6, floor, floor + 0.95, -reach)
    sides = moved(planks(0, reach, floor, floor + 0.95), (0, -reach / 2, 0), np.pi / 2)
    rails = np.concatenate([rail, copies(sides, x=[-1.3, 1.3])])

    surface = Surface.METAL if rng.random() < 0.4 else Surface.PLASTER

    return [
        part([copies(slab, x=middles)], Surface.PLASTER, Label.BUILDING),
        part([copies(rails, x=middles)], surface, Label.BUILDING, tint=rng.normal(scale=0.5)),
    ]


def _extras(rng: np.random.Generator, facade: Facade, width: float, height: float) -> list[Mesh]:
    """Return what hangs on a wall or stands in front of it."""
    parts = [_pipes(rng, width, height)]
    x = rng.uniform(-0.35, 0.35) * width

    solids = _annexes(rng, facade, width, height)
    if facade.timber:
        beams = planks(_spaced(width, 1.2), 0.18, 0.5, height, -0.04)
        cross = planks(0, width, np.array([0.5, 2.6]), np.array([0.7, 2.8]), -0.045)
        parts.append(part([beams, cross], Surface.WOOD, Label.BUILDING))
    if rng.random() < 0.5:
        door = planks(x, rng.uniform(0.9, 1.4), 0, 2.1, -0.03)
        parts.append(part([door], Surface.WOOD, Label.BUILDING, tint=rng.normal(scale=0.6)))
        solids.append(box((1.8, 0.9, 0.12), (x, -0.45, 2.3)))  # the door's canopy
    if facade.shop or rng.random() < 0.06:
        awning = leaning(planks(x, rng.uniform(2, 5), -0.9, 0.0), 0, 1.2)
        awning = moved(awning, (0, -0.05, rng.uniform(2.6, 3.0)))
        parts.append(part([awning], Surface.CLOTH, Label.BUILDING))

    if solids:
        parts.append(part(solids, facade.surface, Label.BUILDING, tint=rng.normal(scale=0.5)))
    if rng.random() < 0.06:
        leaves = ivy(rng, width * rng.uniform(0.3, 0.9), height * rng.uniform(0.4, 0.9))
        parts.append(leaves)
    return parts


def _annexes(
    rng: np.random.Generator, facade: Facade, width: float, height: float
) -> list[np.ndarray]:
    """Return the plinth, a porch on posts, a bay and a wing of a wall: (T, 3, 3) triangles each.

    The wall may lack any of them.
    """
    solids = []
    x = rng.uniform(-0.35, 0.35) * width

    if facade.plinth:
        solids.append(box((width + 0.1, 0.12, BELOW_GROUND + facade.plinth), (0, 0, -BELOW_GROUND)))
    if rng.random() < 0.15:
        post = box((0.15, 0.15, 2.4 + BELOW_GROUND), (0, -1.3, -BELOW_GROUND))
        solids.append(copies(post, x=[x - 1.2, x + 1.2]))
        solids.append(box((2.8, 1.6, 0.2), (x, -0.75, 2.4)))
    if rng.random() < 0.2:
        reach = rng.uniform(0.5, 1.2)
        bay_height = rng.uniform(2.4, max(height, 2.5))
        size = (rng.uniform(1.5, 3.5), 2 * reach, bay_height + BELOW_GROUND)
        solids.append(box(size, (-x, 0, -BELOW_GROUND)))
    if rng.random() < 0.08:
        reach = rng.uniform(2, 4)
        size = (width * 0.4, 2 * reach, height * rng.uniform(0.4, 0.8) + BELOW_GROUND)
        solids.append(box(size, (x, 0, -BELOW_GROUND)))
    return solids


def _spaced(width: float, pitch: float) -> np.ndarray:
    """Return x of the n middles of beams that are evenly spaced over a wall: (n,)."""
    return np.linspace(-width / 2, width / 2, max(2, round(width / pitch) + 1))


def _pipes(rng: np.random.Generator, width: float, height: float) -> Mesh:
    """Return the gutter below the roof and a down pipe at one or both ends."""
    radius = rng.uniform(0.04, 0.07)
    x = np.array([-0.5, 0.5]) * (width - 0.4)
    if rng.random() < 0.6:
        x = x[:1]
    pipe = tube((0, -0.08, 0), (0, -0.08, height), radius, sides=5, closed=False)
    gutter = box((width + 0.4, 0.15, 0.12), (0, -0.3, height - 0.1))
    return part([copies(pipe, x=x), gutter], Surface.METAL, Label.BUILDING)
