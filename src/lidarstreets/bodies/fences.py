"""Make meshes of fences, walls, railings and noise barriers, which SemanticKITTI labels fence.

A `Fence` is one kind of fence with all its measures. Its segments lie along x and look alike, so
that they form a line along a boundary.
"""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from lidarstreets.bodies.plants import bank, foliage
from lidarstreets.chance import weighted_choice
from lidarstreets.materials import Label, Surface
from lidarstreets.mesh import Mesh, join, part
from lidarstreets.solids import box, copies, leaning, loft, planks, prism, tube
from lidarstreets.tables import read_table

FENCE_SHARES = read_table(Path(__file__).with_suffix(".toml"))
BELOW_GROUND = 0.5  # depth of fences below the ground, so that a slope leaves no gap, metres
POROUS_THICKNESS = 0.04  # thickness of wire meshes and lattices, metres
# Section of the beam of a guard rail, which has two waves: corners (y, z) in metres.
BEAM = (
    (0.0, 0.0), (-0.06, 0.05), (-0.06, 0.11), (0.0, 0.155), (-0.06, 0.2), (-0.06, 0.26),
    (0.0, 0.31), (0.02, 0.155),
)  # fmt: skip
BEAM_HEIGHT = 0.31  # height of the section of a beam, metres
BEAM_PITCH = 0.42  # distance between two beams, one above the other, metres


@dataclass(frozen=True)
class Fence:
    """One kind of fence with all its measures, made segment by segment. Lengths are in metres.

    Attributes:
        kind: kind of fence, a key of `FENCE_KINDS`.
        height: height above the ground.
        pitch: distance between two boards, bars or stones.
        gap: open share between boards, and share of the pulses that pass a wire mesh; 0 to 1.
        surface: surface of boards and walls.
        lean: distance from the vertical for each metre of height.
        uneven: how far boards and stones are out of line.
        overgrown: chance that plants grow through a segment.
        tint: tint, as in `Mesh`.
    """

    kind: str
    height: float
    pitch: float
    gap: float
    surface: Surface
    lean: float
    uneven: float
    overgrown: float
    tint: float

    def solid(self, solids: list[np.ndarray], surface: Surface | None = None) -> Mesh:
        """Return parts of the fence that no pulse passes, from (T, 3, 3) triangles of each."""
        triangles = leaning(np.concatenate(solids), 0, self.lean)
        surface = self.surface if surface is None else surface
        return part([triangles], surface, Label.FENCE, tint=self.tint)

    def segment(self, rng: np.random.Generator, length: float) -> Mesh:
        """Return a piece of the fence, `length` metres along x."""
        mesh = FENCE_KINDS[self.kind].make(self, rng, length)
        if rng.random() < self.overgrown:
            mesh = join(mesh, _creepers(rng, self, length))
        return mesh


def draw_fence(rng: np.random.Generator, shares: dict[str, float]) -> Fence:
    """Draw a kind of fence and its measures. `shares` gives each kind its share."""
    kind = weighted_choice(rng, shares)
    surfaces = FENCE_KINDS[kind].surfaces
    if surfaces is WOODEN:
        surface = Surface.WOOD if rng.random() < 0.85 else Surface.PLASTIC
    else:
        surface = surfaces[rng.integers(len(surfaces))]

    is_neat = rng.random() < 0.6

    return Fence(
        kind=kind,
        height=float(rng.uniform(*FENCE_KINDS[kind].height)),
        pitch=float(rng.uniform(0.09, 0.22)),
        gap=float(rng.uniform(0.0, 0.55) if kind != "mesh" else rng.uniform(0.55, 0.93)),
        surface=surface,
        lean=float(rng.normal(scale=0.005 if is_neat else 0.05)),
        uneven=float(rng.uniform(0, 0.01) if is_neat else rng.uniform(0.01, 0.05)),
        overgrown=float(rng.choice([0.0, 0.15, 0.7], p=[0.6, 0.25, 0.15])),
        tint=float(rng.normal(scale=0.8)),
    )


def _creepers(rng: np.random.Generator, fence: Fence, length: float) -> Mesh:
    """Return leaves that grow through a fence or along it.

    Leaves that grow through a fence have its class, as people label them.
    """
    if rng.random() < 0.5:
        leaves = bank(rng, length, "box", (rng.uniform(0.1, 0.4), fence.height), 0.05, step=0.9)
        return part([leaves], Surface.LEAF, Label.FENCE, rng.uniform(0.03, 0.3), tint=fence.tint)

    width = rng.uniform(0.15, 0.9)
    height = fence.height * rng.uniform(0.4, 1.25)
    leaves = bank(rng, length * rng.uniform(0.4, 1.1), "bulge", (width, height), 0.07, step=0.9)
    leaves = leaves + np.array([0, rng.uniform(-0.5, 0.5), 0])
    return foliage([leaves], rng.uniform(0.068, 0.85), rng.normal(scale=0.5))


def _posts(length: float, height: float, radius: float = 0.04, y: float = 0.0) -> np.ndarray:
    """Return posts at both ends of a segment and, if it is long, in its middle."""
    post = tube((0, 0, -BELOW_GROUND), (0, 0, height), radius, sides=4)
    count = 2 if length < 3.5 else 3
    return copies(post, x=np.linspace(-length / 2, length / 2, count), y=y)


def _middles(length: float, pitch: float) -> np.ndarray:
    """Return x of the n middles of boards along a segment: (n,)."""
    count = max(1, round(length / pitch))
    return (np.arange(count) + 0.5) / count * length - length / 2


def _boards(fence: Fence, rng: np.random.Generator, length: float) -> Mesh:
    """Return upright boards on two rails."""
    x = _middles(length, fence.pitch)
    tops = fence.height + rng.normal(scale=0.6 * fence.uneven, size=len(x))
    if fence.gap > 0.4:
        tops += 0.12 * np.sin(np.pi * (x / length + 0.5))  # rounded from post to post
    y = np.where(np.arange(len(x)) % 2 == 0, 0.0, fence.uneven)

    open_share = fence.gap if fence.height < 1.5 else 0.2 * fence.gap
    boards = planks(x, fence.pitch * (1 - open_share), 0.03, tops, y)
    rails = _beams(length, fence.height * np.array([0.22, 0.78]), 0.09, 0.04)
    return fence.solid([boards, rails, _posts(length, fence.height, 0.05, 0.05)])


def _slats(fence: Fence, rng: np.random.Generator, length: float) -> Mesh:
    bottom = np.arange(0.05, fence.height - 0.06, fence.pitch)
    width = fence.pitch * (1 - 0.6 * fence.gap)
    y = rng.normal(scale=fence.uneven, size=len(bottom))
    boards = planks(0, length, bottom, bottom + width, y)
    return fence.solid([boards, _posts(length, fence.height, 0.05, 0.03)])


def _pickets(fence: Fence, rng: np.random.Generator, length: float) -> Mesh:
    """Return a palisade or pickets: narrow, pointed boards with gaps."""
    x = _middles(length, fence.pitch)
    width = fence.pitch * rng.uniform(0.35, 0.75)
    tops = fence.height + rng.normal(scale=0.8 * fence.uneven, size=len(x))
    boards = planks(x, width, 0.04, tops - 0.5 * width)

    # A pointed top is a narrower piece.
    points = planks(x, 0.5 * width, tops - 0.5 * width, tops)
    rails = _beams(length, fence.height * np.array([0.22, 0.78]), 0.07)
    return fence.solid([boards, points, rails, _posts(length, fence.height, 0.05, 0.04)])


def _beams(length: float, heights: np.ndarray, thickness: float, y: float = 0.02) -> np.ndarray:
    """Return horizontal beams along a segment, as upright rectangles."""
    return planks(0, length, heights - thickness / 2, heights + thickness / 2, y)


def _porous(
    fence: Fence, length: float, bottom: float, top: float, surface: Surface, passing: float
) -> Mesh:
    """Return an upright sheet; the share `passing` of the pulses that hit it head-on pass."""
    sheet = box((length, POROUS_THICKNESS, top - bottom), (0, 0, bottom))
    depth = POROUS_THICKNESS / -np.log(passing)
    return part(
        [leaning(sheet, 0, fence.lean)], surface, Label.FENCE, float(depth), tint=fence.tint
    )


def _mesh(fence: Fence, rng: np.random.Generator, length: float) -> Mesh:
    """Return a wire mesh between thin posts, perhaps on a low base."""
    posts = _posts(length, fence.height + 0.05, rng.uniform(0.02, 0.04))
    wires = _beams(length, np.array([0.06, fence.height]), 0.02)
    sheet = _porous(fence, length, 0.03, fence.height, fence.surface, passing=fence.gap)
    parts = [fence.solid([posts, wires]), sheet]
    if fence.pitch < 0.12:
        base = box((length, 0.12, 0.15 + BELOW_GROUND), (0, 0, -BELOW_GROUND))
        parts.append(fence.solid([base], Surface.PLASTER))
    return join(*parts)


def _lattice(fence: Fence, rng: np.random.Generator, length: float) -> Mesh:
    frame = _beams(length, np.array([0.12, fence.height - 0.04]), 0.08)
    sheet = _porous(fence, length, 0.1, fence.height, fence.surface, passing=0.25 + 0.8 * fence.gap)
    return join(fence.solid([frame, _posts(length, fence.height, 0.05)]), sheet)


def _railing(fence: Fence, rng: np.random.Generator, length: float, foot: float = 0.0) -> Mesh:
    """Return thin upright bars between two beams, `foot` metres above the ground."""
    rise = max(fence.height - foot, 0.4)
    x = _middles(length, max(fence.pitch, 0.11))
    bars = planks(x, rng.uniform(0.014, 0.03), foot + 0.08, foot + rise)
    beams = _beams(length, foot + np.array([0.1, rise - 0.02]), 0.04)
    posts = _posts(length, foot + rise, 0.03)
    return fence.solid([bars, beams, posts], Surface.METAL)


def _rails(fence: Fence, rng: np.random.Generator, length: float) -> Mesh:
    """Return a paddock fence or a pipe barrier: a few horizontal bars between posts."""
    count = int(rng.integers(1, 4))
    heights = fence.height * np.linspace(1, 0.35, count)
    thickness = rng.uniform(0.04, 0.14)
    beams = []
    for z in heights:
        sag = rng.normal(scale=fence.uneven)
        start = (-length / 2, 0, z)
        beams.append(tube(start, (length / 2, 0, z + sag), thickness / 2, sides=5, closed=False))
    return fence.solid([*beams, _posts(length, fence.height + 0.05, 0.06)])


def _wire(fence: Fence, rng: np.random.Generator, length: float) -> Mesh:
    """Return wires between wooden posts, which most pulses pass."""
    sheet = _porous(fence, length, 0.2, fence.height, Surface.METAL, passing=rng.uniform(0.9, 0.97))
    return join(fence.solid([_posts(length, fence.height, rng.uniform(0.03, 0.07))]), sheet)


def _wall(fence: Fence, rng: np.random.Generator, length: float) -> Mesh:
    """Return a garden wall with a coping and perhaps a pillar."""
    thickness = 0.15 + fence.pitch
    solids = [box((length, thickness, fence.height + BELOW_GROUND), (0, 0, -BELOW_GROUND))]
    if fence.gap < 0.35:
        solids.append(box((length, thickness + 0.08, 0.08), (0, 0, fence.height)))
    if fence.gap < 0.15:
        pillar = (0.4, thickness + 0.12, fence.height + BELOW_GROUND + 0.15)
        solids.append(box(pillar, (-length / 2, 0, -BELOW_GROUND)))
    return fence.solid(solids)


def _stone_wall(fence: Fence, rng: np.random.Generator, length: float) -> Mesh:
    """Return a wall of rough stones, out of line by a few centimetres."""
    half = 0.15 + fence.pitch
    middle = 0.5 * fence.height
    flank = np.array([(half, -BELOW_GROUND), (half, middle), (0.8 * half, fence.height)])
    section = np.concatenate([flank, flank[::-1] * (-1, 1)])
    count = max(2, round(length / 0.35)) + 1
    rings = np.empty((count, len(section), 3))
    rings[..., 0] = np.linspace(-length / 2, length / 2, count)[:, None]
    rings[..., 1:] = section + rng.normal(scale=0.03, size=(count, len(section), 2))
    return fence.solid([loft(rings)], Surface.STONE)


def _wall_and_railing(fence: Fence, rng: np.random.Generator, length: float) -> Mesh:
    """Return a low wall that carries a railing or boards."""
    low = fence.height * (0.2 + fence.gap)
    wall = fence.solid(
        [box((length, 0.15 + fence.pitch, low + BELOW_GROUND), (0, 0, -BELOW_GROUND))]
    )
    if fence.uneven < 0.006:
        return join(wall, _railing(fence, rng, length, foot=low))

    boards = planks(_middles(length, fence.pitch), fence.pitch * 0.8, low, fence.height)
    return join(wall, fence.solid([boards], Surface.WOOD))


def _panels(fence: Fence, rng: np.random.Generator, length: float) -> Mesh:
    panel = box((length, 0.05, fence.height + BELOW_GROUND), (0, 0, -BELOW_GROUND))
    posts = copies(
        box((0.14, 0.16, fence.height + BELOW_GROUND + 0.08), (0, 0, -BELOW_GROUND)),
        x=[-length / 2],
    )
    bands = _beams(length, np.array([0.33, 0.66]) * fence.height, 0.05, -0.03)
    return fence.solid([panel, posts, bands])


def _screen(fence: Fence, rng: np.random.Generator, length: float) -> Mesh:
    panel = planks(0, length, 0.04, fence.height)
    return fence.solid([panel, _posts(length, fence.height + 0.06, 0.05)])


def guard_rail(length: float, height: float = 0.75, beams: int = 1) -> Mesh:
    """Return a segment of a steel crash barrier along x.

    Args:
        length: length of the segment, metres.
        height: height of the upper edge of the lower beam, metres.
        beams: number of beams, 1 or 2.
    """
    profile = [(y, z + height - BEAM_HEIGHT) for y, z in BEAM]
    beam = prism(profile, length)[..., [1, 0, 2]]  # the profile lies across the street
    solids = [beam]
    if beams > 1:
        solids.append(beam + np.array([0, 0, BEAM_PITCH]))

    post = box((0.1, 0.1, height + BELOW_GROUND - 0.05), (0, 0.08, -BELOW_GROUND))
    solids.append(copies(post, x=[-length / 4, length / 4]))
    return part(solids, Surface.METAL, Label.FENCE)


def _crash_barrier(fence: Fence, rng: np.random.Generator, length: float) -> Mesh:
    beams = 2 if fence.kind == "double guard rail" else 1
    return guard_rail(length, fence.height, beams)


def _parapet(fence: Fence, rng: np.random.Generator, length: float) -> Mesh:
    """Return the low concrete wall along a fast road or a bridge."""
    body = box((length, 0.5, fence.height + BELOW_GROUND), (0, 0, -BELOW_GROUND), top=(1.0, 0.45))
    return fence.solid([body])


def _noise_barrier(fence: Fence, rng: np.random.Generator, length: float) -> Mesh:
    """Return panels with horizontal ribs between steel posts; the upper part may be of glass."""
    base = box((length, 0.18, 0.5 + BELOW_GROUND), (0, 0, -BELOW_GROUND))
    posts = copies(
        box((0.2, 0.24, fence.height + BELOW_GROUND), (0, 0, -BELOW_GROUND)), x=[-length / 2]
    )

    glass_from = fence.height * 0.5 if fence.kind == "glass barrier" else fence.height
    bottom = np.arange(0.5, glass_from - 0.1, 0.25)
    y = np.where(np.arange(len(bottom)) % 2 == 0, -0.07, -0.07 + fence.pitch * 0.3)
    ribs = planks(0, length, bottom, np.minimum(bottom + 0.25, glass_from), y)
    parts = [
        fence.solid([base], Surface.PLASTER),
        fence.solid([posts], Surface.METAL),
        fence.solid([ribs]),
    ]
    if glass_from < fence.height:
        parts.append(fence.solid([planks(0, length, glass_from, fence.height)], Surface.GLASS))
    return join(*parts)


def gate(rng: np.random.Generator, length: float, height: float) -> Mesh:
    """Return a closed gate: bars, a mesh or a smooth leaf in a frame, between two pillars."""
    frame = _beams(length, np.array([0.12, height - 0.03]), 0.06)
    pillar = box((0.35, 0.35, height + BELOW_GROUND + 0.1), (0, 0, -BELOW_GROUND))
    pillars = copies(pillar, x=[-length / 2 - 0.18, length / 2 + 0.18])
    parts = [part([pillars], Surface.BRICK, Label.FENCE)]

    if rng.random() < 0.5:
        leaf = planks(_middles(length, 0.13), rng.uniform(0.02, 0.1), 0.1, height)
    else:
        leaf = planks(0, length, 0.1, height)
    surface = Surface.METAL if rng.random() < 0.6 else Surface.WOOD
    return join(*parts, part([frame, leaf], surface, Label.FENCE))


@dataclass(frozen=True)
class FenceKind:
    """How to make a kind of fence.

    Attributes:
        make: returns one segment of a fence, `length` metres along x.
        height: smallest and largest height, metres.
        surfaces: surfaces that the fence may have.
    """

    make: Callable[[Fence, np.random.Generator, float], Mesh]
    height: tuple[float, float] = (0.6, 2.0)
    surfaces: tuple[Surface, ...] = (Surface.METAL,)


WOODEN = (Surface.WOOD, Surface.PLASTIC)  # surfaces of boards; most boards are of wood
_WALLS = (Surface.PLASTER, Surface.BRICK, Surface.STONE)
_CONCRETE = (Surface.PLASTER,)
_PANELS = (Surface.PLASTER, Surface.WOOD, Surface.METAL)
FENCE_KINDS = {
    "boards": FenceKind(_boards, surfaces=WOODEN),
    "slats": FenceKind(_slats, surfaces=WOODEN),
    "pickets": FenceKind(_pickets, (0.5, 1.3), WOODEN),
    "lattice": FenceKind(_lattice, surfaces=WOODEN),
    "mesh": FenceKind(_mesh, (0.8, 2.4)),
    "railing": FenceKind(_railing),
    "rails": FenceKind(_rails, (0.7, 1.4), WOODEN),
    "wire": FenceKind(_wire, (0.7, 1.5), WOODEN),
    "wall": FenceKind(_wall, (0.3, 2.3), _WALLS),
    "stone wall": FenceKind(_stone_wall, (0.3, 1.8), (Surface.STONE,)),
    "wall and railing": FenceKind(_wall_and_railing, surfaces=_WALLS),
    "panels": FenceKind(_panels, surfaces=_CONCRETE),
    "screen": FenceKind(_screen, (1.5, 2.2), WOODEN),
    "guard rail": FenceKind(_crash_barrier, (0.65, 0.85)),
    "double guard rail": FenceKind(_crash_barrier, (0.65, 0.85)),
    "parapet": FenceKind(_parapet, (0.8, 1.2), _CONCRETE),
    "noise barrier": FenceKind(_noise_barrier, (2.0, 5.0), _PANELS),
    "glass barrier": FenceKind(_noise_barrier, (1.5, 4.0)),
}
