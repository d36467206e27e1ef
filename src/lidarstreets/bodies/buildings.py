"""Make meshes of houses, halls and sheds.

The front of a building faces -y. Its walls begin below the ground, so that a slope leaves no gap.
"""

import numpy as np

from lidarstreets.bodies.facades import BELOW_GROUND, Facade, draw_facade, plain_wall, wall
from lidarstreets.materials import Label, Surface
from lidarstreets.mesh import Mesh, join, part, place
from lidarstreets.solids import box, copies, planks, prism, tube


def building(
    rng: np.random.Generator, width: float, depth: float, height: float, flat: bool
) -> Mesh:
    """Return a house with a flat or a pitched roof.

    Args:
        rng: draws its look, wings, dormers and garage.
        width: width along x, metres.
        depth: depth along y, metres.
        height: height of the walls, metres.
        flat: whether the roof is flat.
    """
    facade = draw_facade(rng, height)
    parts = [_walls(rng, facade, width, depth, height)]
    parts.append(part([_roof(rng, width, depth, height, flat)], Surface.ROOF_TILE, Label.BUILDING))

    chimney_x = rng.uniform(-0.3, 0.3) * width
    details = [box((0.7, 0.7, 1.4), (chimney_x, 0.5, height + depth * 0.2))]
    if not flat and rng.random() < 0.3:
        dormers = box((1.6, depth * 0.5, 1.5), (0, -depth * 0.22, height))
        details.append(copies(dormers, x=np.array([-0.25, 0.25]) * width))
    parts.append(part(details, facade.surface, Label.BUILDING))

    # A lower wing, and a garage at one side.
    if rng.random() < 0.3:
        size = (width * 0.5, depth * 0.6, height * rng.uniform(0.4, 0.7))
        wing = _walls(rng, facade, *size)
        lid = part([box((size[0], size[1], 0.2), (0, 0, size[2]))], facade.surface, Label.BUILDING)
        x = width * rng.uniform(0.1, 0.35) * rng.choice([-1, 1])
        parts.append(place(join(wing, lid), x, -depth * 0.5, 0, 0))
    if rng.random() < 0.2:
        side = rng.choice([-1, 1])
        parts.append(place(garages(rng, 1), side * (width / 2 + 1.6), -depth * 0.1, 0, 0))
    return join(*parts)


def _walls(
    rng: np.random.Generator, facade: Facade, width: float, depth: float, height: float
) -> Mesh:
    """Return four walls; the wall at the back has no windows."""
    return join(
        place(wall(rng, facade, width, height), 0, -depth / 2, 0, 0),
        place(wall(rng, facade, depth, height), -width / 2, 0, 0, -np.pi / 2),
        place(wall(rng, facade, depth, height), width / 2, 0, 0, np.pi / 2),
        place(plain_wall(facade, width, height), 0, depth / 2, 0, np.pi),
    )


def _roof(
    rng: np.random.Generator, width: float, depth: float, height: float, flat: bool
) -> np.ndarray:
    """Return the triangles of a flat, hipped or gabled roof."""
    if flat:
        return box((width + 0.3, depth + 0.3, 0.5), (0, 0, height - 0.2))

    rise = depth * rng.uniform(0.25, 0.5)
    ridge = 1.0 if rng.random() < 0.6 else 0.55  # share of the width
    eaves = rng.uniform(0.3, 1.2)
    return box((width + eaves, depth + eaves, rise), (0, 0, height), top=(ridge, 0.02))


def shed(rng: np.random.Generator) -> Mesh:
    """Return a garage, a carport or a garden shed."""
    kind = rng.random()
    if kind < 0.3:
        return garages(rng, 1)
    if kind < 0.45:
        return carport(rng)

    width = rng.uniform(1.8, 4)
    depth = rng.uniform(2, 6)
    height = rng.uniform(1.9, 2.8)
    walls = box((width, depth, height + 0.5), (0, 0, -0.5))
    roof = box((width + 0.3, depth + 0.3, rng.uniform(0.1, 0.7)), (0, 0, height), top=(0.4, 1.0))
    door = planks(0, 0.9, 0, 1.8, -depth / 2 - 0.03)

    surface = Surface.WOOD if rng.random() < 0.6 else Surface.PLASTER

    return join(
        part([walls, door], surface, Label.BUILDING),
        part([roof], Surface.ROOF_TILE, Label.BUILDING),
    )


def garages(rng: np.random.Generator, count: int) -> Mesh:
    """Return a row of garages with recessed gates."""
    pitch = rng.uniform(2.8, 3.3)
    height = rng.uniform(2.3, 2.9)
    depth = rng.uniform(5, 6.5)
    width = count * pitch

    middles = (np.arange(count) - (count - 1) / 2) * pitch
    pillars = box((pitch - 2.3, depth, height + 0.5), (0, 0, -0.5))
    solids = [
        copies(pillars, x=np.append(middles - pitch / 2, width / 2)),
        box((width + 0.2, depth + 0.1, height - 2.0), (0, 0, 2.05)),
    ]
    gates = planks(middles, 2.6, -0.1, 2.1, -depth / 2 + rng.uniform(0.05, 0.4))
    surface = Surface.METAL if rng.random() < 0.5 else Surface.WOOD

    return join(
        part(solids, Surface.PLASTER, Label.BUILDING, tint=rng.normal(scale=0.5)),
        part([gates], surface, Label.BUILDING, tint=rng.normal(scale=0.5)),
    )


def carport(rng: np.random.Generator) -> Mesh:
    """Return a roof on posts."""
    width = rng.uniform(2.8, 6)
    posts = copies(
        box((0.12, 0.12, 2.6), (0, 0, -0.3)), x=[[-0.5 * width], [0.5 * width]], y=[-2.3, 2.3]
    )
    roof = box((width + 0.4, 5.2, 0.25), (0, 0, 2.25))
    return part([posts, roof], Surface.WOOD, Label.BUILDING)


def canopy(rng: np.random.Generator) -> Mesh:
    """Return the roof of a petrol station on its columns."""
    width = rng.uniform(9, 16)
    columns = box((0.45, 0.45, 5.3), (0, 0, -0.3))
    roof = box((width, 8, 0.9), (0, 0, 4.8))
    return part(
        [copies(columns, x=np.array([-0.3, 0.3]) * width), roof], Surface.PLASTER, Label.BUILDING
    )


def hall(rng: np.random.Generator, width: float, depth: float, height: float) -> Mesh:
    """Return an industrial hall with ribbed walls, a band of windows and gates; see `building`."""
    pitch = rng.uniform(0.25, 1.0)
    rib = rng.choice([0.0, 0.04, 0.12])

    parts = []
    for yaw, length, distance in (
        (0.0, width, depth / 2),
        (-np.pi / 2, depth, width / 2),
        (np.pi / 2, depth, width / 2),
        (np.pi, width, depth / 2),
    ):
        x = (np.arange(int(length / pitch) + 1) + 0.5) * pitch - length / 2
        y = np.where(np.arange(len(x)) % 2 == 0, 0.0, rib)
        sheets = part(
            [planks(x, pitch, -BELOW_GROUND, height, y)], Surface.METAL, Label.BUILDING, tint=0.8
        )
        gates = planks(rng.uniform(-0.3, 0.3, 2) * length, rng.uniform(2.5, 4.5), -0.2, 3.6, -0.05)
        band = planks(0, length * 0.9, height - 1.6, height - 0.7, -0.04)
        side = join(
            sheets,
            part([gates], Surface.PLASTIC, Label.BUILDING, tint=rng.normal()),
            part([band], Surface.WINDOW, Label.BUILDING),
        )
        at = distance * np.array([np.sin(yaw), -np.cos(yaw)])
        parts.append(place(side, at[0], at[1], 0, yaw))

    roof = box((width + 0.2, depth + 0.2, 0.4), (0, 0, height - 0.1))
    parts.append(part([roof], Surface.METAL, Label.BUILDING))
    return join(*parts)


def greenhouse(rng: np.random.Generator) -> Mesh:
    """Return a greenhouse: panes in a thin frame."""
    length = rng.uniform(3, 14)
    half = rng.uniform(1.2, 3.5)
    height = rng.uniform(1.5, 2.4)
    profile = [
        (-half, -0.3), (half, -0.3), (half, height), (0, height + half * 0.5), (-half, height),
    ]  # fmt: skip
    base = box((2 * half + 0.1, length + 0.1, 0.9), (0, 0, -0.5))
    x = np.array([-half, half])
    frame = tube((0, 0, 0), (0, 0, height), 0.04, sides=4)
    posts = copies(frame, x=x[:, None], y=np.linspace(-length / 2, length / 2, 6))

    return join(
        part([prism(profile, length)], Surface.WINDOW, Label.BUILDING),
        part([base, posts], Surface.METAL, Label.BUILDING),
    )


def church(rng: np.random.Generator) -> Mesh:
    """Return a nave with a tower."""
    height = rng.uniform(7, 11)
    nave = box((10, 20, height + BELOW_GROUND), (0, 2, -BELOW_GROUND))
    buttresses = copies(
        box((11.4, 0.9, height * 0.7 + BELOW_GROUND), (0, 0, -BELOW_GROUND)),
        y=np.linspace(-6, 11, 5),
    )
    tower = box((6, 6, 24 + BELOW_GROUND), (0, -10, -BELOW_GROUND))
    roof = box((11, 21, 7), (0, 2, height), top=(0.02, 1.0))

    return join(
        part([nave, buttresses, tower], Surface.STONE, Label.BUILDING),
        part([roof], Surface.ROOF_TILE, Label.BUILDING),
    )


def gable_barn(rng: np.random.Generator, width: float, depth: float, height: float) -> Mesh:
    """Return a long barn whose gable faces -y and has a gate; see `building`."""
    half = width / 2
    ridge = height + width * rng.uniform(0.15, 0.3)
    profile = [
        (-half, -BELOW_GROUND),
        (half, -BELOW_GROUND),
        (half, height),
        (0, ridge),
        (-half, height),
    ]
    surface = (Surface.PLASTER, Surface.WOOD, Surface.BRICK)[rng.integers(3)]
    gate = planks(rng.uniform(-0.2, 0.2) * width, 3.2, 0, 3.0, -depth / 2 - 0.05)
    return join(
        part([prism(profile, depth)], surface, Label.BUILDING),
        part([gate], Surface.WOOD, Label.BUILDING),
    )
