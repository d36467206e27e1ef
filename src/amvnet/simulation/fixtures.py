"""What does not move: houses, fences, trees, hedges, poles, signs and street furniture as triangle meshes."""

from __future__ import annotations

import numpy as np

from amvnet.simulation.materials import Label, Surface
from amvnet.simulation.mesh import Mesh, box, hull, join, part, prism, tube


def _openings(rng: np.random.Generator, width: float, depth: float, height: float) -> np.ndarray:
    """Window panes just in front of the four walls, in rows by storey. (T, 3, 3)."""
    pitch, size = rng.uniform(2.0, 3.5), rng.uniform(0.8, 1.4)
    panes = []
    for sill in np.arange(0.9, height - 1.4, 2.8):
        for side in (-1, 1):
            across = np.arange(-width / 2 + 1.2, width / 2 - 0.8, pitch)
            panes += [box((size, 0.04, 1.3), (x, side * (depth / 2 + 0.01), sill)) for x in across]
            along = np.arange(-depth / 2 + 1.5, depth / 2 - 1.0, pitch * 1.3)
            panes += [box((0.04, size, 1.3), (side * (width / 2 + 0.01), y, sill)) for y in along]
    return np.concatenate(panes) if panes else np.zeros((0, 3, 3))


def _roof(
    rng: np.random.Generator, width: float, depth: float, height: float, flat: bool
) -> np.ndarray:
    """A flat roof with a rim, or a hipped or gabled one."""
    if flat:
        return box((width + 0.3, depth + 0.3, 0.5), (0, 0, height - 0.2))
    rise = depth * rng.uniform(0.25, 0.5)
    hip = 1.0 if rng.random() < 0.6 else 0.55
    return box((width + 0.6, depth + 0.8, rise), (0, 0, height), (hip, 0.02))


def _extras(
    rng: np.random.Generator, width: float, depth: float, height: float
) -> list[np.ndarray]:
    """Porch, bay, balcony, chimney, down pipe: what breaks a wall's plane. Walls facing -y and +y alike."""
    found = []
    x = rng.uniform(-width * 0.35, width * 0.35)
    for side in (-1, 1):
        wall = side * depth / 2
        if rng.random() < 0.4:
            found.append(
                box((rng.uniform(1.5, 3), 1.2, rng.uniform(2.2, height)), (x, wall + side * 0.6, 0))
            )
        if height > 5 and rng.random() < 0.4:
            found.append(box((2.5, 1.2, 1.0), (-x, wall + side * 0.6, 2.7)))
        found.append(
            tube(
                (width / 2 - 0.3, wall + side * 0.08, 0),
                (width / 2 - 0.3, wall + side * 0.08, height),
                0.06,
            )
        )
    found.append(box((0.7, 0.7, 1.4), (x * 0.5, 0.5, height + depth * 0.2)))
    return found


def building(
    rng: np.random.Generator, width: float, depth: float, height: float, flat: bool
) -> Mesh:
    """A house `width` along x and `depth` along y, standing a little in the ground so that slopes leave no gap."""
    wall = Surface.PLASTER if rng.random() < 0.6 else Surface.BRICK
    walls = [box((width, depth, height + 1.5), (0, 0, -1.5)), *_extras(rng, width, depth, height)]
    if rng.random() < 0.35:
        wing = rng.uniform(0.4, 0.7)
        walls.append(
            box((width * 0.5, depth * 0.6, height * wing + 1.5), (width * 0.3, -depth * 0.5, -1.5))
        )
    return join(
        [
            part(np.concatenate(walls), wall, Label.BUILDING),
            part(_roof(rng, width, depth, height, flat), Surface.ROOF_TILE, Label.BUILDING),
            part(_openings(rng, width, depth, height), Surface.WINDOW, Label.BUILDING),
        ]
    )


def shed(rng: np.random.Generator) -> Mesh:
    """A garage or a garden shed."""
    width, depth, height = rng.uniform(2.5, 4), rng.uniform(3, 6), rng.uniform(2.1, 2.8)
    hull = box((width, depth, height + 0.5), (0, 0, -0.5))
    lid = box((width + 0.3, depth + 0.3, 0.5), (0, 0, height), (0.4, 1.0))
    material = Surface.WOOD if rng.random() < 0.5 else Surface.PLASTER
    return part(np.concatenate([hull, lid]), material, Label.BUILDING)


def board_fence(length: float, height: float, gap: float) -> Mesh:
    """Upright boards on two rails; `gap` is the open share between the boards."""
    pitch = 0.16
    boards = [
        box((pitch * (1 - gap), 0.03, height), (x, 0, 0))
        for x in np.arange(-length / 2, length / 2, pitch)
    ]
    rails = [box((length, 0.05, 0.09), (0, 0.03, height * z)) for z in (0.2, 0.75)]
    return part(
        np.concatenate([*boards, *rails, box((0.1, 0.1, height + 0.5), (0, 0, -0.4))]),
        Surface.WOOD,
        Label.FENCE,
    )


def rail_fence(length: float, height: float) -> Mesh:
    """A metal railing or a wire fence: thin bars that most lasers pass."""
    bars = [box((length, 0.03, 0.04), (0, 0, height * z)) for z in (0.1, 0.35, 0.6, 0.97)]
    posts = [box((0.03, 0.03, height), (x, 0, 0)) for x in np.arange(-length / 2, length / 2, 0.3)]
    return part(np.concatenate([*bars, *posts]), Surface.METAL, Label.FENCE)


def wall(length: float, height: float) -> Mesh:
    """A garden wall; SemanticKITTI counts it as fence."""
    top = box((length, 0.36, 0.08), (0, 0, height))
    return part(
        np.concatenate([box((length, 0.28, height + 0.5), (0, 0, -0.5)), top]),
        Surface.BRICK,
        Label.FENCE,
    )


def guard_rail(length: float) -> Mesh:
    """A crash barrier beside a fast road."""
    beam = box((length, 0.08, 0.31), (0, 0, 0.44))
    return part(
        np.concatenate([beam, box((0.12, 0.12, 0.7), (0, 0.08, 0))]), Surface.METAL, Label.FENCE
    )


def barrier(length: float) -> Mesh:
    """A segment of the concrete wall that closes off a work zone."""
    half = [
        (-0.3, 0),
        (0.3, 0),
        (0.3, 0.08),
        (0.12, 0.35),
        (0.08, 0.8),
        (-0.08, 0.8),
        (-0.12, 0.35),
        (-0.3, 0.08),
    ]
    across = prism(half, length)[..., [1, 0, 2]]  # its side view is across the street
    return part(across, Surface.PLASTER, Label.BARRIER)


def traffic_cone(rng: np.random.Generator) -> Mesh:
    """A cone on its foot."""
    height = rng.uniform(0.5, 0.9)
    cone = np.concatenate([box((0.36, 0.36, 0.04)), tube((0, 0, 0.04), (0, 0, height), 0.15, 0.03)])
    return part(cone, Surface.SIGN_FACE, Label.TRAFFIC_CONE)


def _leaves(hulls: list[np.ndarray], depth: float) -> Mesh:
    """Foliage that pulses enter as far as `depth` metres on average."""
    return part(np.concatenate(hulls), Surface.LEAF, Label.VEGETATION, depth)


def hedge(rng: np.random.Generator, length: float, height: float) -> Mesh:
    """A clipped hedge."""
    radii = (length * 0.55, rng.uniform(0.25, 0.5), height * 0.55)
    return _leaves([hull(rng, (0, 0, height * 0.5), radii, square=0.5)], rng.uniform(0.02, 0.06))


def bush(rng: np.random.Generator, radius: float) -> Mesh:
    """A bush, from knee-high to taller than a man."""
    height = radius * rng.uniform(0.7, 1.4)
    radii = (radius, radius * rng.uniform(0.7, 1.3), height)
    return _leaves([hull(rng, (0, 0, height * 0.8), radii)], rng.uniform(0.03, 0.25))


def tall_grass(rng: np.random.Generator, length: float) -> Mesh:
    """A strip of weeds and tall grass, which is labelled vegetation."""
    radii = (length * 0.55, rng.uniform(0.3, 1.0), rng.uniform(0.2, 0.6))
    return _leaves([hull(rng, (0, 0, 0), radii, square=0.7)], rng.uniform(0.05, 0.12))


def thicket(rng: np.random.Generator, length: float, height: float) -> Mesh:
    """A length of wild, dense undergrowth: clumps of leaves that bulge out and up."""
    clumps = []
    for x in np.arange(-length / 2, length / 2, 1.3):
        tall, wide = height * rng.uniform(0.35, 0.6), rng.uniform(0.7, 1.4)
        spot = (x + rng.normal(scale=0.3), rng.normal(scale=0.5), tall * 0.85)
        clumps.append(hull(rng, spot, (1.1, wide, tall)))
    return _leaves(clumps, rng.uniform(0.04, 0.3))


def tree(rng: np.random.Generator, height: float, fine: bool = True) -> Mesh:
    """A trunk with boughs and a crown of a few leafy clumps; not `fine` is for the far rows."""
    clear = height * rng.uniform(0.2, 0.4)
    thick = 0.025 * height * rng.uniform(0.7, 1.3)
    wide = height * rng.uniform(0.18, 0.32)
    lean = rng.normal(scale=0.02 * height, size=2)
    fork = (lean[0], lean[1], clear)
    boughs, crown, clumps = [], [], int(rng.integers(3, 8)) if fine else 2
    for _ in range(clumps):
        spot = (
            *(lean + rng.normal(scale=wide * 0.45, size=2)),
            rng.uniform(clear * 1.1 + wide * 0.4, height * 0.85),
        )
        boughs.append(tube(fork, spot, thick * 0.6, 0.03, sides=5))
        share = rng.uniform(0.45, 0.75)
        crown.append(hull(rng, spot, (wide * share, wide * share, wide * share * 0.9), fine=fine))
    # The benchmark's trunks end where the boughs begin.
    return join(
        [
            part(tube((0, 0, -0.5), fork, thick, thick * 0.8), Surface.BARK, Label.TRUNK),
            part(np.concatenate(boughs), Surface.BARK, Label.VEGETATION),
            _leaves(crown, rng.uniform(0.05, 0.7)),
        ]
    )


def conifer(rng: np.random.Generator, height: float) -> Mesh:
    """A fir: narrower upwards, nearly down to the ground."""
    trunk = part(
        tube((0, 0, -0.5), (0, 0, height * 0.5), 0.018 * height, 0.03), Surface.BARK, Label.TRUNK
    )
    wide = height * rng.uniform(0.13, 0.2)
    body = hull(rng, (0, 0, height * 0.55), (wide, wide, height * 0.47), taper=0.75)
    return join([trunk, _leaves([body], rng.uniform(0.05, 0.25))])


def copse(rng: np.random.Generator, length: float, height: float) -> Mesh:
    """The edge of a wood, seen from far away."""
    crowns = [
        hull(
            rng,
            (x, rng.normal(scale=2), height * 0.45),
            (3.5, 3.0, height * rng.uniform(0.4, 0.6)),
            fine=False,
        )
        for x in np.arange(-length / 2, length / 2, 4.5)
    ]
    return _leaves(crowns, rng.uniform(0.2, 0.6))


def lamp(rng: np.random.Generator) -> Mesh:
    """A street lamp with its arm over the road (towards +y)."""
    height, arm = rng.uniform(4, 9), rng.uniform(0.3, 2.0)
    mast = tube((0, 0, -0.3), (0, 0, height), rng.uniform(0.07, 0.13), 0.05)
    bough = tube((0, 0, height), (0, arm, height + 0.2), 0.04)
    return part(
        np.concatenate([mast, bough, box((0.3, 0.7, 0.15), (0, arm, height + 0.1))]),
        Surface.METAL,
        Label.POLE,
    )


def post(rng: np.random.Generator) -> Mesh:
    """A bollard or a thin post."""
    return part(
        tube((0, 0, -0.2), (0, 0, rng.uniform(0.8, 1.2)), rng.uniform(0.05, 0.1)),
        Surface.METAL,
        Label.POLE,
    )


def utility_pole(rng: np.random.Generator) -> Mesh:
    """A wooden pole that carries lines."""
    height = rng.uniform(7, 9)
    mast = tube((0, 0, -0.5), (0, 0, height), 0.15, 0.11)
    return part(
        np.concatenate([mast, box((0.12, 1.8, 0.12), (0, 0, height - 0.8))]),
        Surface.WOOD,
        Label.POLE,
    )


def sign(rng: np.random.Generator) -> Mesh:
    """One or two faces on a post, facing along x; round, square, three-cornered or a wide board."""
    height = rng.uniform(1.9, 2.6)
    mast = tube((0, 0, -0.3), (0, 0, height + 0.6), 0.035)
    shape = rng.random()
    if shape < 0.4:
        face = tube((-0.06, 0, height + 0.3), (-0.04, 0, height + 0.3), 0.33, sides=12)
    elif shape < 0.6:
        face = tube((-0.06, 0, height + 0.3), (-0.04, 0, height + 0.3), 0.42, sides=3)
    elif shape < 0.85:
        face = box((0.02, rng.uniform(0.4, 0.7), 0.6), (-0.05, 0, height))
    else:
        face = box((0.03, rng.uniform(1.2, 2.5), rng.uniform(0.5, 1.2)), (-0.05, 0, height - 0.5))
    return join(
        [part(mast, Surface.METAL, Label.POLE), part(face, Surface.SIGN_FACE, Label.TRAFFIC_SIGN)]
    )


def traffic_light(rng: np.random.Generator) -> Mesh:
    """A mast with its lamps' housing; SemanticKITTI counts the housing as traffic sign."""
    mast = tube((0, 0, -0.3), (0, 0, 3.4), 0.07)
    housing = np.concatenate(
        [box((0.25, 0.3, 0.9), (0, 0.1, 2.4)), box((0.02, 0.5, 1.1), (0.1, 0.1, 2.3))]
    )
    return join(
        [part(mast, Surface.METAL, Label.POLE), part(housing, Surface.PLASTIC, Label.TRAFFIC_SIGN)]
    )


def clutter(rng: np.random.Generator) -> Mesh:
    """A bin, a box of the grid or the post, a bench: objects that the benchmark ignores."""
    kind = rng.random()
    if kind < 0.5:
        solid = box((0.6, 0.7, 1.05), (0, 0, 0), (1.1, 1.1))
    elif kind < 0.8:
        solid = box((rng.uniform(0.6, 1.4), 0.4, rng.uniform(0.9, 1.4)))
    else:
        solid = np.concatenate(
            [
                box((1.7, 0.45, 0.08), (0, 0, 0.42)),
                box((1.7, 0.08, 0.4), (0, 0.2, 0.5)),
                box((0.1, 0.4, 0.4)),
            ]
        )
    return part(solid, Surface.PLASTIC, Label.OTHER_OBJECT)


def shelter(rng: np.random.Generator) -> Mesh:
    """A bus stop's shelter, open towards -y."""
    length = rng.uniform(2.5, 4.5)
    frame = [
        box((0.1, 0.1, 2.3), (x, y, 0)) for x in (-length / 2, length / 2) for y in (-0.6, 0.6)
    ]
    solid = np.concatenate(
        [
            *frame,
            box((length + 0.3, 1.6, 0.12), (0, 0, 2.3)),
            box((length, 0.4, 0.1), (0, 0.4, 0.5)),
        ]
    )
    panes = part(box((length, 0.03, 1.9), (0, 0.6, 0.3)), Surface.GLASS, Label.OTHER_STRUCTURE)
    return join([part(solid, Surface.METAL, Label.OTHER_STRUCTURE), panes])


def steps(rng: np.random.Generator) -> Mesh:
    """A stair before a door, or a low ramp."""
    rows = int(rng.integers(2, 6))
    solid = [
        box((1.6, 0.3 * (rows - row), 0.17), (0, -0.15 * (rows - row), 0.17 * row))
        for row in range(rows)
    ]
    return part(np.concatenate(solid), Surface.PAVING, Label.OTHER_STRUCTURE)


def gable_barn(rng: np.random.Generator, width: float, depth: float, height: float) -> Mesh:
    """A long hall whose gable faces along y."""
    half = width / 2
    view = [
        (-half, -1.5),
        (half, -1.5),
        (half, height),
        (0, height + width * rng.uniform(0.15, 0.3)),
        (-half, height),
    ]
    return part(prism(view, depth), Surface.PLASTER, Label.BUILDING)
