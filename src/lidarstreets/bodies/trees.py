"""Make meshes of trees: stems, boughs and crowns."""

import numpy as np

from lidarstreets.bodies.plants import bank, foliage
from lidarstreets.materials import Label, Surface
from lidarstreets.mesh import Mesh, join, part
from lidarstreets.solids import Vector, hull, tube


def tree(rng: np.random.Generator, height: float, fine: bool = True) -> Mesh:
    """Return a broad-leaved tree, `height` metres high.

    It has one or more stems, and either a crown of several clumps, one airy crown or bare boughs.
    `fine=False` gives it one stem and fewer triangles, for rows of distant trees.
    """
    fork_height = height * rng.uniform(0.12, 0.4)
    spread = height * rng.uniform(0.18, 0.38)
    radius = height * rng.uniform(0.01, 0.042)

    stems = 1 if rng.random() < 0.8 or not fine else int(rng.integers(2, 5))
    parts = []
    fork: Vector = (0, 0, fork_height)
    for _ in range(stems):
        stem, fork = _stem(rng, fork_height, radius, slant=0.07 if stems == 1 else 0.22)
        parts.append(part(stem, Surface.BARK, Label.TRUNK))
    if rng.random() < 0.1:
        parts.append(_ivy(rng, fork, radius))
    if rng.random() < 0.4:  # grass and shoots grow at its foot
        wide = radius + rng.uniform(0.1, 0.5)
        tuft = hull(rng, (0, 0, 0), (wide, wide, rng.uniform(0.1, 0.45)), fine=False)
        parts.append(foliage([tuft], rng.uniform(0.05, 0.6)))

    kind = rng.random()
    if not fine:
        return join(*parts, _distant_crown(rng, fork, height, spread))
    if kind < 0.45:
        crown = _clumps(rng, fork, height, spread, radius)
    elif kind < 0.85:
        crown = _cloud(rng, fork, height, spread, radius)
    else:
        crown = _bare_boughs(rng, fork, height, spread, radius)
    return join(*parts, crown)


def _stem(
    rng: np.random.Generator, height: float, radius: float, slant: float
) -> tuple[list[np.ndarray], Vector]:
    """Return the solids of a crooked stem, and the point (x, y, z) where it ends."""
    lean = rng.normal(scale=slant, size=2)
    crook = radius * rng.uniform(0.1, 0.9)

    pieces = 3

    solids = []
    start = (0.0, 0.0, -0.4)
    for index in range(pieces):
        z = height * (index + 1) / pieces
        x, y = lean * z + rng.normal(scale=crook, size=2)
        end = (float(x), float(y), z)
        # The stem is thick at the root, then nearly even.
        first = radius * (1.35 if index == 0 else 1.0)
        solids.append(tube(start, end, first, radius * 0.97, sides=7, closed=False))
        start = end
    return solids, start


def _ivy(rng: np.random.Generator, fork: Vector, radius: float) -> Mesh:
    half = max(fork[2], 0.6) * rng.uniform(0.3, 0.6)
    wide = radius * rng.uniform(1.3, 2.0) + 0.05
    return foliage([hull(rng, (0, 0, half * 0.8), (wide, wide, half), fine=False)], 0.085)


def _clumps(
    rng: np.random.Generator, fork: Vector, height: float, spread: float, radius: float
) -> Mesh:
    """Return a crown of several clumps of leaves, each at the end of a bough."""
    depth = rng.uniform(0.051, 0.85)
    boughs = []
    clumps = []
    for _ in range(int(rng.integers(3, 8))):
        x, y = np.array(fork[:2]) + rng.normal(scale=spread * 0.5, size=2)
        z = rng.uniform(fork[2] * 1.1 + spread * 0.3, height * 0.85)
        boughs.append(tube(fork, (x, y, z), radius * 0.6, 0.02, sides=4, closed=False))
        size = spread * rng.uniform(0.4, 0.75)
        clump = hull(rng, (x, y, z), (size, size, size * 0.9), fine=False)
        clumps.append(foliage([clump], depth, rng.normal(scale=0.4)))

    return join(part(boughs, Surface.BARK, Label.VEGETATION), *clumps)


def _cloud(
    rng: np.random.Generator, fork: Vector, height: float, spread: float, radius: float
) -> Mesh:
    """Return one large airy crown, which may reach down near the ground; pulses go far into it."""
    boughs = []

    for _ in range(int(rng.integers(3, 6))):
        x, y = np.array(fork[:2]) + rng.normal(scale=spread * 0.5, size=2)
        end = (float(x), float(y), height * rng.uniform(0.5, 0.9))
        boughs.append(tube(fork, end, radius * 0.6, 0.02, sides=4, closed=False))

    low = max(0.4, fork[2] * rng.uniform(0.5, 1.2))
    half = (height - low) / 2
    centre = (fork[0], fork[1], low + half)
    crown = hull(rng, centre, (spread, spread * rng.uniform(0.8, 1.2), half))
    depth = float(np.exp(rng.uniform(np.log(0.17), np.log(3.4))))
    return join(part(boughs, Surface.BARK, Label.VEGETATION), foliage([crown], depth))


def _bare_boughs(
    rng: np.random.Generator, fork: Vector, height: float, spread: float, radius: float
) -> Mesh:
    """Return boughs and branches without leaves, in a haze of twigs."""
    rods = []

    for _ in range(int(rng.integers(4, 8))):
        x, y = np.array(fork[:2]) + rng.normal(scale=spread * 0.6, size=2)
        bough = np.array([x, y, height * rng.uniform(0.4, 0.95)])
        rods.append(tube(fork, tuple(bough), radius * 0.6, 0.02, sides=4, closed=False))

        for share in rng.uniform(0.2, 0.9, size=4):
            root = np.array(fork) + share * (bough - np.array(fork))
            tip = root + rng.normal(scale=spread * 0.35, size=3) + np.array([0, 0, 0.2])
            rods.append(tube(tuple(root), tuple(tip), 0.025, 0.008, sides=3, closed=False))

    half = (height - fork[2] * 0.8) / 2
    twigs = hull(rng, (*fork[:2], height - half), (spread, spread, half), fine=False)
    haze = foliage([twigs], rng.uniform(3.4, 12), surface=Surface.TWIG)
    return join(part(rods, Surface.BARK, Label.VEGETATION), haze)


def _distant_crown(rng: np.random.Generator, fork: Vector, height: float, spread: float) -> Mesh:
    half = (height - fork[2] * 0.8) / 2
    crown = hull(rng, (*fork[:2], height - half), (spread, spread, half), fine=False)
    return foliage([crown], rng.uniform(0.17, 2), rng.normal(scale=0.4))


def conifer(rng: np.random.Generator, height: float) -> Mesh:
    """Return a fir, whose branches begin near the ground and narrow towards the top."""
    radius = height * rng.uniform(0.12, 0.22)
    start = rng.uniform(0.0, 0.15)  # share of the height where the branches begin

    trunk = tube((0, 0, -0.5), (0, 0, height * 0.5), 0.018 * height, 0.03, closed=False)
    half = height * (1 - start) / 2
    branches = hull(
        rng, (0, 0, height - half), (radius, radius, half), taper=rng.uniform(0.5, 0.8), fine=False
    )
    leaves = foliage([branches], rng.uniform(0.085, 0.85), rng.normal(scale=0.5))
    return join(part([trunk], Surface.BARK, Label.TRUNK), leaves)


def column(rng: np.random.Generator, height: float) -> Mesh:
    """Return a thuja or a cypress: a narrow, dense column without a visible stem."""
    radius = rng.uniform(0.25, 0.7)
    radii = (radius, radius, height * 0.55)
    leaves = hull(rng, (0, 0, height * 0.45), radii, taper=0.35, square=0.8, fine=False)
    return foliage([leaves], rng.uniform(0.025, 0.14), rng.normal(scale=0.5))


def stump(rng: np.random.Generator) -> Mesh:
    """Return a dead stem without boughs."""
    stem, _ = _stem(rng, rng.uniform(0.5, 4), rng.uniform(0.06, 0.25), slant=0.12)
    return part(stem, Surface.BARK, Label.TRUNK)


def sapling(rng: np.random.Generator) -> Mesh:
    """Return a young tree, perhaps tied to stakes."""
    height = rng.uniform(2, 4.5)
    stem, fork = _stem(rng, height * 0.55, rng.uniform(0.02, 0.05), slant=0.03)

    radius = height * rng.uniform(0.12, 0.25)
    crown = hull(rng, (*fork[:2], height * 0.75), (radius, radius, height * 0.3), fine=False)
    parts = [part(stem, Surface.BARK, Label.TRUNK), foliage([crown], rng.uniform(0.26, 1.5))]
    if rng.random() < 0.5:
        stakes = []
        for x in (-0.3, 0.3):
            stakes.append(tube((x, 0, -0.2), (x, 0, 1.6), 0.035, sides=5, closed=False))
        parts.append(part(stakes, Surface.WOOD, Label.POLE))
    return join(*parts)


def random_tree(rng: np.random.Generator, height: float, fine: bool = True) -> Mesh:
    """Return a broad-leaved tree, a fir, a column or a young tree; see `tree` for `fine`."""
    kind = rng.random()
    if kind < 0.14:
        return conifer(rng, height)
    if kind < 0.18:
        return column(rng, min(height, 6.0))
    if kind < 0.26 and fine:
        return sapling(rng)
    return tree(rng, height, fine)


def palm(rng: np.random.Generator, height: float) -> Mesh:
    """Return a palm: a bare stem, with a crown of leaves at its top."""
    stem, fork = _stem(rng, height * 0.9, rng.uniform(0.12, 0.25), slant=0.04)
    wide = rng.uniform(0.9, 2.2)
    crown = hull(rng, fork, (wide, wide, wide * rng.uniform(0.4, 0.8)), fine=False)
    return join(part(stem, Surface.BARK, Label.TRUNK), foliage([crown], rng.uniform(0.2, 1.2)))


def street_tree(rng: np.random.Generator, height: float, palms: float) -> Mesh:
    """Return a tree of a street or a garden, in a region with a share `palms` of palms."""
    if palms and rng.random() < palms:
        return palm(rng, height * rng.uniform(0.8, 1.8))
    return random_tree(rng, height)


def copse(rng: np.random.Generator, length: float, height: float) -> Mesh:
    """Return the edge of a distant wood, `length` metres along x."""
    size = (rng.uniform(4, 9), height * rng.uniform(0.8, 1.2))
    edge = bank(rng, length + 2, "bulge", size, height * rng.uniform(0.03, 0.12), step=2.5)
    return foliage([edge], rng.uniform(0.1, 1.5), rng.normal(scale=0.4))
