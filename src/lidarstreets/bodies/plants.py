"""Make meshes of plants without a stem: hedges, bushes, undergrowth, reeds, crops and creepers.

Banks and rows of plants lie along x.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from lidarstreets.materials import Label, Surface
from lidarstreets.mesh import Mesh, join, part
from lidarstreets.solids import box, hull, leaning, loft, tube
from lidarstreets.tables import read_table

# Cross sections of banks of leaves by name.
SECTIONS = read_table(Path(__file__).with_suffix(".toml"))["sections"]
BELOW_GROUND = 0.3  # depth of plants below the ground, so that a slope leaves no gap, metres


def foliage(
    hulls: list[np.ndarray],
    depth: float,
    tint: float = 0.0,
    surface: Surface = Surface.LEAF,
) -> Mesh:
    """Return clumps of leaves as one mesh with the class vegetation.

    Args:
        hulls: (T, 3, 3) triangles of the closed hull of each clump, metres.
        depth: mean distance that a pulse travels inside, metres; see `Mesh`.
        tint: brightness, as in `Mesh`.
        surface: surface of leaves or twigs.
    """
    return part(hulls, surface, Label.VEGETATION, depth, tint=tint)


def bank(
    rng: np.random.Generator,
    length: float,
    section: str,
    size: tuple[float, float],
    uneven: float,
    step: float,
) -> np.ndarray:
    """Return the (T, 3, 3) triangles of a closed bank of leaves along x.

    Args:
        rng: draws how uneven it is.
        length: length along x, metres.
        section: its cross section, a key of `SECTIONS`.
        size: width and height of the section, metres.
        uneven: standard deviation of the position of a corner, metres.
        step: distance between two rings of corners along x, metres.
    """
    width, height = size
    corners = np.array(SECTIONS[section]) * (width, height)
    count = max(2, round(length / step) + 1)

    rings = np.empty((count, len(corners), 3))
    rings[..., 0] = np.linspace(-length / 2, length / 2, count)[:, None]
    rings[..., 1:] = corners

    swell = 1 + rng.normal(scale=uneven / height, size=count)
    rings[..., 2] *= np.clip(swell, 0.4, 1.7)[:, None]
    # This limit keeps the two sides from crossing.
    limit = 0.2 * min(width, height)
    rings += np.clip(rng.normal(scale=uneven, size=rings.shape), -limit, limit)
    rings[:, (0, -1), 2] = -BELOW_GROUND
    return loft(rings)


@dataclass(frozen=True)
class Hedge:
    """A kind of hedge, the same along a whole boundary. Lengths are in metres.

    Attributes:
        section: its cross section, a key of `SECTIONS`.
        width: width of the section.
        height: height of the section.
        depth: depth of the leaves, as in `Mesh`.
        uneven: how far the surface is off the section.
        tint: tint, as in `Mesh`.
    """

    section: str
    width: float
    height: float
    depth: float
    uneven: float
    tint: float

    def segment(self, rng: np.random.Generator, length: float) -> Mesh:
        """Return a piece of the hedge, `length` metres along x."""
        size = (self.width, self.height)
        leaves = bank(rng, length + 0.05, self.section, size, self.uneven, step=1.3)
        return foliage([leaves], self.depth, self.tint + rng.normal(scale=0.3))


def draw_hedge(rng: np.random.Generator, height: float) -> Hedge:
    """Draw a kind of hedge, `height` metres high: clipped, or grown wild."""
    is_clipped = rng.random() < 0.7
    sections = ("box", "wedge", "dome", "cone") if is_clipped else ("dome", "bulge", "cone")
    return Hedge(
        section=sections[rng.integers(len(sections))],
        width=float(rng.uniform(0.3, 1.2) if is_clipped else rng.uniform(0.8, 1.8)),
        height=height,
        depth=float(rng.uniform(0.014, 0.1) if is_clipped else rng.uniform(0.05, 0.5)),
        uneven=float(rng.uniform(0.005, 0.05) if is_clipped else rng.uniform(0.05, 0.2)),
        tint=float(rng.normal(scale=0.7)),
    )


def bush(rng: np.random.Generator, radius: float) -> Mesh:
    """Return a bush; some are dense, others are thin or have bare twigs."""
    height = radius * rng.uniform(0.7, 1.6)
    kind = rng.random()

    if kind < 0.15:
        return join(_sticks(rng, radius, 1.7 * height), _ball(rng, radius, height, 1.5))
    if kind < 0.33:
        return _ball(rng, radius, height, rng.uniform(0.26, 1.5))
    if kind < 0.5:
        clipped = hull(rng, (0, 0, height), (radius, radius, height), square=0.6, fine=False)
        return foliage([clipped], rng.uniform(0.017, 0.068))

    return _ball(rng, radius, height, rng.uniform(0.034, 0.26))


def slender_bush(rng: np.random.Generator) -> Mesh:
    """Return a rose, a young thuja or a perennial, 0.5 to 1.9 m high and narrow."""
    radius = rng.uniform(0.1, 0.35)
    height = rng.uniform(0.5, 1.9)
    middle = height * rng.uniform(0.45, 0.7)

    # Some are bare below.
    half = min(middle, height - middle) if rng.random() < 0.5 else middle
    radii = (radius, radius * rng.uniform(0.7, 1.3), half)
    taper = rng.uniform(0.3, 1.0)
    leaves = hull(rng, (0, 0, middle), radii, taper=taper, fine=False)
    depth = rng.uniform(0.017, 0.51)
    stem = tube(
        (0, 0, -BELOW_GROUND), (0, 0, middle), rng.uniform(0.01, 0.03), sides=4, closed=False
    )

    return join(
        part([stem], Surface.BARK, Label.VEGETATION),
        foliage([leaves], depth, rng.normal(scale=0.6)),
    )


def _ball(rng: np.random.Generator, radius: float, height: float, depth: float) -> Mesh:
    radii = (radius, radius * rng.uniform(0.7, 1.3), height)
    clump = hull(rng, (0, 0, height * rng.uniform(0.6, 0.9)), radii, fine=radius > 1)
    return foliage([clump], depth, rng.normal(scale=0.5))


def _sticks(rng: np.random.Generator, radius: float, height: float) -> Mesh:
    """Return thin stems that spread upwards from one root."""
    stems = []
    for _ in range(int(rng.integers(4, 10))):
        x, y = rng.normal(scale=radius * 0.6, size=2)
        foot = (x * 0.15, y * 0.15, -0.1)
        tip = (x, y, height * rng.uniform(0.6, 1.1))
        stems.append(tube(foot, tip, 0.015, 0.008, sides=3, closed=False))
    return part(stems, Surface.BARK, Label.VEGETATION)


def tall_grass(rng: np.random.Generator, length: float) -> Mesh:
    """Return a strip of weeds, tall grass or reeds with the class vegetation."""
    is_reed = rng.random() < 0.2
    height = rng.uniform(1.2, 2.4) if is_reed else rng.uniform(0.2, 0.9)
    size = (rng.uniform(0.5, 2.2), height)
    blades = bank(rng, length + 0.3, "dome", size, 0.15 * height, step=0.8)
    return foliage([blades], rng.uniform(0.1, 0.85), rng.normal(scale=0.5))


def turf(
    rng: np.random.Generator, size: tuple[float, float], height: float, tint: float = 0.0
) -> Mesh:
    """Return a patch of uncut grass or stubble with the class terrain.

    Pulses that arrive at a low angle end in it at very different ranges.

    Args:
        rng: draws the depth.
        size: size along x and y, metres.
        height: height of the grass, metres.
        tint: brightness, as in `Mesh`.
    """
    blades = box((size[0], size[1], height + BELOW_GROUND), (0, 0, -BELOW_GROUND))
    return part([blades], Surface.GRASS, Label.TERRAIN, rng.uniform(0.3, 1.6), tint=tint)


def ground_cover(rng: np.random.Generator, width: float, height: float) -> Mesh:
    """Return a patch of low plants with the class vegetation, about `width` metres wide."""
    leaves = bank(rng, width + 0.4, "dome", (1.2 * width, height), 0.3 * height, step=0.8)
    return foliage([leaves], rng.uniform(0.034, 0.68), rng.normal(scale=0.5))


@dataclass(frozen=True)
class Thicket:
    """A kind of undergrowth or wood edge. Lengths are in metres.

    Attributes:
        section: its cross section, a key of `SECTIONS`.
        width: smallest and largest width.
        depth: depth of the leaves, as in `Mesh`. Some kinds are nearly solid; most pulses pass
            others.
        uneven: how far the surface is off the section, as a share of the height.
        stems: mean number of trunks per metre that are visible through the leaves.
        tint: tint, as in `Mesh`.
    """

    section: str
    width: tuple[float, float]
    depth: float
    uneven: float
    stems: float
    tint: float

    def segment(self, rng: np.random.Generator, length: float, height: float) -> Mesh:
        """Return a piece, `length` metres along x and `height` metres high."""
        size = (rng.uniform(*self.width), height)
        uneven = self.uneven * min(height, 4.0)
        leaves = [bank(rng, length + 0.6, self.section, size, uneven, step=1.0)]
        if rng.random() < 0.4:
            x = rng.uniform(-length / 3, length / 3)
            radii = (1.0, size[0] * 0.6, height * 0.4)
            leaves.append(hull(rng, (x, 0, height * 0.6), radii, fine=False))

        stems = []
        for _ in range(rng.poisson(self.stems * length)):
            x = rng.uniform(-length / 2, length / 2)
            y = rng.uniform(-0.5, 0.5) * size[0]
            lean_x, lean_y = rng.normal(scale=0.06 * height, size=2)
            tip = (x + lean_x, y + lean_y, height)
            stems.append(
                tube((x, y, -BELOW_GROUND), tip, rng.uniform(0.03, 0.12), 0.03, 5, closed=False)
            )

        trunks = part(stems, Surface.BARK, Label.TRUNK)
        return join(trunks, foliage(leaves, self.depth, self.tint + rng.normal(scale=0.3)))


def draw_thicket(rng: np.random.Generator) -> Thicket:
    """Draw a kind of undergrowth: a dense green wall, a wild bank or a thin wood edge."""
    tint = float(rng.normal(scale=0.8))
    kind = rng.random()
    if kind < 0.5:
        depth = rng.uniform(0.02, 0.17)
        return Thicket("dome", (1.2, 3.0), depth, rng.uniform(0.01, 0.05), stems=0.0, tint=tint)
    if kind < 0.82:
        depth = rng.uniform(0.068, 0.51)
        return Thicket("bulge", (1.0, 3.0), depth, rng.uniform(0.04, 0.12), stems=0.05, tint=tint)
    depth = rng.uniform(0.68, 3.1)
    return Thicket("bulge", (2.0, 6.0), depth, rng.uniform(0.06, 0.15), stems=0.25, tint=tint)


def ivy(rng: np.random.Generator, length: float, height: float) -> Mesh:
    """Return creepers that cover a wall at y = 0 on its side -y."""
    leaves = bank(rng, length, "bulge", (0.35, height), 0.04, step=0.8)
    return foliage([leaves], rng.uniform(0.051, 0.2), rng.normal(scale=0.5))


def crop_row(rng: np.random.Generator, length: float, height: float) -> Mesh:
    """Return a row of maize, vines or berries."""
    size = (rng.uniform(0.4, 0.8), height)
    leaves = bank(rng, length, "bulge", size, 0.06, step=1.0)
    return foliage([leaves], rng.uniform(0.14, 0.68), rng.normal(scale=0.3))


def flower_bed(rng: np.random.Generator, length: float) -> Mesh:
    """Return a low bed of flowers or a ground cover."""
    size = (rng.uniform(0.5, 2.0), rng.uniform(0.15, 0.5))
    leaves = bank(rng, length, "dome", size, 0.05, step=0.7)
    return foliage([leaves], rng.uniform(0.051, 0.26), rng.normal(scale=0.7))


def leaf_heap(rng: np.random.Generator) -> Mesh:
    """Return a heap of cut branches and leaves."""
    radii = (rng.uniform(0.5, 1.6), rng.uniform(0.5, 1.2), rng.uniform(0.3, 0.9))
    heap = leaning(hull(rng, (0, 0, 0), radii, fine=False), rng.normal(scale=0.2), 0)
    return foliage([heap], rng.uniform(0.085, 0.51), surface=Surface.TWIG)
