"""Meshes of what stands still: houses, fences, plants, poles, signs and street furniture."""

from __future__ import annotations

import numpy as np

from amvnet.simulation.materials import Label, Surface
from amvnet.simulation.mesh import Mesh, box, copies, hull, join, part, prism, tube


def building(
    rng: np.random.Generator, width: float, depth: float, height: float, flat: bool
) -> Mesh:
    """Return a house, `width` along x and `depth` along y, with a flat or a pitched roof."""
    surface = Surface.PLASTER if rng.random() < 0.6 else Surface.BRICK

    # The walls begin 1.5 m below the ground, so that a slope leaves no gap.
    walls = [box((width, depth, height + 1.5), (0, 0, -1.5))]
    walls += _annexes(rng, width, depth, height)
    if rng.random() < 0.35:
        size = (width * 0.5, depth * 0.6, height * rng.uniform(0.4, 0.7) + 1.5)
        walls.append(box(size, (width * 0.3, -depth * 0.5, -1.5)))

    roof = _roof(rng, width, depth, height, flat)
    windows = _windows(rng, width, depth, height)

    return join(
        [
            part(walls, surface, Label.BUILDING),
            part([roof], Surface.ROOF_TILE, Label.BUILDING),
            part([windows], Surface.WINDOW, Label.BUILDING),
        ]
    )


def _windows(rng: np.random.Generator, width: float, depth: float, height: float) -> np.ndarray:
    """Return panes just in front of the four walls, a row for each storey: (T, 3, 3)."""
    pitch = rng.uniform(2.0, 3.5)
    size = rng.uniform(0.8, 1.4)

    # On the walls that face along y, and on those that face along x.
    front_pane = box((size, 0.04, 1.3))
    front_x = np.arange(-width / 2 + 1.2, width / 2 - 0.8, pitch)
    side_pane = box((0.04, size, 1.3))
    side_y = np.arange(-depth / 2 + 1.5, depth / 2 - 1.0, pitch * 1.3)

    panes = [np.zeros((0, 3, 3))]
    for sill in np.arange(0.9, height - 1.4, 2.8):
        for side in (-1, 1):
            panes.append(copies(front_pane, x=front_x, y=side * (depth / 2 + 0.01), z=sill))
            panes.append(copies(side_pane, x=side * (width / 2 + 0.01), y=side_y, z=sill))
    return np.concatenate(panes)


def _roof(
    rng: np.random.Generator, width: float, depth: float, height: float, flat: bool
) -> np.ndarray:
    """Return a flat roof, or a hipped or gabled one."""
    if flat:
        return box((width + 0.3, depth + 0.3, 0.5), (0, 0, height - 0.2))

    rise = depth * rng.uniform(0.25, 0.5)
    ridge = 1.0 if rng.random() < 0.6 else 0.55  # share of the width
    return box((width + 0.6, depth + 0.8, rise), (0, 0, height), top=(ridge, 0.02))


def _annexes(
    rng: np.random.Generator, width: float, depth: float, height: float
) -> list[np.ndarray]:
    """Return porches, balconies and down pipes on the walls that face along y, and a chimney."""
    annexes = []
    x = rng.uniform(-width * 0.35, width * 0.35)
    pipe_x = width / 2 - 0.3

    for side in (-1, 1):
        wall_y = side * depth / 2
        annex_y = wall_y + side * 0.6
        if rng.random() < 0.4:
            porch_size = (rng.uniform(1.5, 3), 1.2, rng.uniform(2.2, height))
            annexes.append(box(porch_size, (x, annex_y, 0)))
        if height > 5 and rng.random() < 0.4:
            annexes.append(box((2.5, 1.2, 1.0), (-x, annex_y, 2.7)))

        pipe_y = wall_y + side * 0.08
        annexes.append(tube((pipe_x, pipe_y, 0), (pipe_x, pipe_y, height), 0.06))

    chimney = box((0.7, 0.7, 1.4), (x * 0.5, 0.5, height + depth * 0.2))
    return [*annexes, chimney]


def shed(rng: np.random.Generator) -> Mesh:
    """Return a garage or a garden shed."""
    width = rng.uniform(2.5, 4)
    depth = rng.uniform(3, 6)
    height = rng.uniform(2.1, 2.8)

    walls = box((width, depth, height + 0.5), (0, 0, -0.5))
    roof = box((width + 0.3, depth + 0.3, 0.5), (0, 0, height), top=(0.4, 1.0))

    surface = Surface.WOOD if rng.random() < 0.5 else Surface.PLASTER
    return part([walls, roof], surface, Label.BUILDING)


def board_fence(length: float, height: float, gap: float) -> Mesh:
    """Return vertical boards on two rails; `gap` is the open share between the boards."""
    pitch = 0.16  # metres between the boards' middles
    board = box((pitch * (1 - gap), 0.03, height))
    boards = copies(board, x=np.arange(-length / 2, length / 2, pitch))

    rails = copies(box((length, 0.05, 0.09)), y=0.03, z=[height * 0.2, height * 0.75])
    post = box((0.1, 0.1, height + 0.5), (0, 0, -0.4))
    return part([boards, rails, post], Surface.WOOD, Label.FENCE)


def rail_fence(length: float, height: float) -> Mesh:
    """Return a metal railing or a wire fence: bars so thin that most lasers pass."""
    bars = copies(box((length, 0.03, 0.04)), z=height * np.array([0.1, 0.35, 0.6, 0.97]))
    posts = copies(box((0.03, 0.03, height)), x=np.arange(-length / 2, length / 2, 0.3))
    return part([bars, posts], Surface.METAL, Label.FENCE)


def wall(length: float, height: float) -> Mesh:
    """Return a garden wall, which SemanticKITTI counts as fence."""
    body = box((length, 0.28, height + 0.5), (0, 0, -0.5))
    coping = box((length, 0.36, 0.08), (0, 0, height))
    return part([body, coping], Surface.BRICK, Label.FENCE)


def guard_rail(length: float) -> Mesh:
    """Return a segment of the crash barrier along a fast road."""
    beam = box((length, 0.08, 0.31), (0, 0, 0.44))
    post = box((0.12, 0.12, 0.7), (0, 0.08, 0))
    return part([beam, post], Surface.METAL, Label.FENCE)


def barrier(length: float) -> Mesh:
    """Return a segment of the concrete barrier that closes off a work zone."""
    profile = [
        (-0.3, 0),
        (0.3, 0),
        (0.3, 0.08),
        (0.12, 0.35),
        (0.08, 0.8),
        (-0.08, 0.8),
        (-0.12, 0.35),
        (-0.3, 0.08),
    ]
    along_street = prism(profile, length)[..., [1, 0, 2]]  # the profile lies across the street

    return part([along_street], Surface.PLASTER, Label.BARRIER)


def traffic_cone(rng: np.random.Generator) -> Mesh:
    """Return a traffic cone."""
    height = rng.uniform(0.5, 0.9)
    foot = box((0.36, 0.36, 0.04))
    cone = tube((0, 0, 0.04), (0, 0, height), 0.15, 0.03)
    return part([foot, cone], Surface.SIGN_FACE, Label.TRAFFIC_CONE)


def _foliage(hulls: list[np.ndarray], depth: float) -> Mesh:
    """Return clumps of leaves that pulses enter by `depth` metres on average."""
    return part(hulls, Surface.LEAF, Label.VEGETATION, depth)


def hedge(rng: np.random.Generator, length: float, height: float) -> Mesh:
    """Return a clipped hedge."""
    radii = (length * 0.55, rng.uniform(0.25, 0.5), height * 0.55)
    clump = hull(rng, (0, 0, height * 0.5), radii, square=0.5)
    return _foliage([clump], rng.uniform(0.02, 0.06))


def bush(rng: np.random.Generator, radius: float) -> Mesh:
    """Return a bush, from knee-high to taller than a person."""
    height = radius * rng.uniform(0.7, 1.4)
    radii = (radius, radius * rng.uniform(0.7, 1.3), height)
    clump = hull(rng, (0, 0, height * 0.8), radii)
    return _foliage([clump], rng.uniform(0.03, 0.25))


def tall_grass(rng: np.random.Generator, length: float) -> Mesh:
    """Return a strip of weeds and tall grass, which is labelled vegetation."""
    radii = (length * 0.55, rng.uniform(0.3, 1.0), rng.uniform(0.2, 0.6))
    clump = hull(rng, (0, 0, 0), radii, square=0.7)
    return _foliage([clump], rng.uniform(0.05, 0.12))


def thicket(rng: np.random.Generator, length: float, height: float) -> Mesh:
    """Return a strip of wild, dense undergrowth: clumps of leaves that bulge out and up."""
    clumps = []
    for x in np.arange(-length / 2, length / 2, 1.3):
        half_height = height * rng.uniform(0.35, 0.6)
        half_depth = rng.uniform(0.7, 1.4)
        centre = (x + rng.normal(scale=0.3), rng.normal(scale=0.5), half_height * 0.85)
        clumps.append(hull(rng, centre, (1.1, half_depth, half_height)))

    return _foliage(clumps, rng.uniform(0.04, 0.3))


def tree(rng: np.random.Generator, height: float, fine: bool = True) -> Mesh:
    """Return a trunk with boughs and a crown of leafy clumps; `fine=False` is for distant rows."""
    fork_height = height * rng.uniform(0.2, 0.4)
    trunk_radius = 0.025 * height * rng.uniform(0.7, 1.3)
    spread = height * rng.uniform(0.18, 0.32)
    lean = rng.normal(scale=0.02 * height, size=2)
    fork = (lean[0], lean[1], fork_height)

    boughs = []
    crown = []
    clumps = int(rng.integers(3, 8)) if fine else 2
    for _ in range(clumps):
        x, y = lean + rng.normal(scale=spread * 0.45, size=2)
        z = rng.uniform(fork_height * 1.1 + spread * 0.4, height * 0.85)
        boughs.append(tube(fork, (x, y, z), trunk_radius * 0.6, 0.03, sides=5))

        radius = spread * rng.uniform(0.45, 0.75)
        crown.append(hull(rng, (x, y, z), (radius, radius, radius * 0.9), fine=fine))

    # In the benchmark, the class trunk ends where the boughs begin.
    trunk = tube((0, 0, -0.5), fork, trunk_radius, trunk_radius * 0.8)
    return join(
        [
            part([trunk], Surface.BARK, Label.TRUNK),
            part(boughs, Surface.BARK, Label.VEGETATION),
            _foliage(crown, rng.uniform(0.05, 0.7)),
        ]
    )


def conifer(rng: np.random.Generator, height: float) -> Mesh:
    """Return a fir, whose branches begin near the ground and narrow towards the top."""
    trunk = tube((0, 0, -0.5), (0, 0, height * 0.5), 0.018 * height, 0.03)
    radius = height * rng.uniform(0.13, 0.2)
    branches = hull(rng, (0, 0, height * 0.55), (radius, radius, height * 0.47), taper=0.75)
    foliage = _foliage([branches], rng.uniform(0.05, 0.25))
    return join([part([trunk], Surface.BARK, Label.TRUNK), foliage])


def copse(rng: np.random.Generator, length: float, height: float) -> Mesh:
    """Return the edge of a wood, to be seen from far away."""
    crowns = []
    for x in np.arange(-length / 2, length / 2, 4.5):
        centre = (x, rng.normal(scale=2), height * 0.45)
        radii = (3.5, 3.0, height * rng.uniform(0.4, 0.6))
        crowns.append(hull(rng, centre, radii, fine=False))
    return _foliage(crowns, rng.uniform(0.2, 0.6))


def lamp(rng: np.random.Generator) -> Mesh:
    """Return a street lamp with an arm over the road (towards +y)."""
    height = rng.uniform(4, 9)
    reach = rng.uniform(0.3, 2.0)

    mast = tube((0, 0, -0.3), (0, 0, height), rng.uniform(0.07, 0.13), 0.05)
    arm = tube((0, 0, height), (0, reach, height + 0.2), 0.04)
    head = box((0.3, 0.7, 0.15), (0, reach, height + 0.1))
    return part([mast, arm, head], Surface.METAL, Label.POLE)


def post(rng: np.random.Generator) -> Mesh:
    """Return a bollard or a thin post."""
    height = rng.uniform(0.8, 1.2)
    radius = rng.uniform(0.05, 0.1)
    return part([tube((0, 0, -0.2), (0, 0, height), radius)], Surface.METAL, Label.POLE)


def utility_pole(rng: np.random.Generator) -> Mesh:
    """Return a wooden pole that carries wires."""
    height = rng.uniform(7, 9)

    mast = tube((0, 0, -0.5), (0, 0, height), 0.15, 0.11)
    crossarm = box((0.12, 1.8, 0.12), (0, 0, height - 0.8))
    return part([mast, crossarm], Surface.WOOD, Label.POLE)


def sign(rng: np.random.Generator) -> Mesh:
    """Return a sign on a post, facing along x: round, triangular, rectangular or a wide board."""
    height = rng.uniform(1.9, 2.6)  # of the lower edge of a square sign
    mast = tube((0, 0, -0.3), (0, 0, height + 0.6), 0.035)

    shape = rng.random()
    if shape < 0.4:
        face = tube((-0.06, 0, height + 0.3), (-0.04, 0, height + 0.3), 0.33, sides=12)
    elif shape < 0.6:
        face = tube((-0.06, 0, height + 0.3), (-0.04, 0, height + 0.3), 0.42, sides=3)
    elif shape < 0.85:
        face = box((0.02, rng.uniform(0.4, 0.7), 0.6), (-0.05, 0, height))
    else:
        size = (0.03, rng.uniform(1.2, 2.5), rng.uniform(0.5, 1.2))
        face = box(size, (-0.05, 0, height - 0.5))

    return join(
        [
            part([mast], Surface.METAL, Label.POLE),
            part([face], Surface.SIGN_FACE, Label.TRAFFIC_SIGN),
        ]
    )


def traffic_light(rng: np.random.Generator) -> Mesh:
    """Return a traffic light, whose housing SemanticKITTI counts as traffic sign."""
    mast = tube((0, 0, -0.3), (0, 0, 3.4), 0.07)
    lamps = box((0.25, 0.3, 0.9), (0, 0.1, 2.4))
    backboard = box((0.02, 0.5, 1.1), (0.1, 0.1, 2.3))

    return join(
        [
            part([mast], Surface.METAL, Label.POLE),
            part([lamps, backboard], Surface.PLASTIC, Label.TRAFFIC_SIGN),
        ]
    )


def clutter(rng: np.random.Generator) -> Mesh:
    """Return a bin, a cabinet or a bench: objects that the benchmark ignores."""
    kind = rng.random()
    if kind < 0.5:
        solids = [box((0.6, 0.7, 1.05), top=(1.1, 1.1))]
    elif kind < 0.8:
        solids = [box((rng.uniform(0.6, 1.4), 0.4, rng.uniform(0.9, 1.4)))]
    else:
        seat = box((1.7, 0.45, 0.08), (0, 0, 0.42))
        back = box((1.7, 0.08, 0.4), (0, 0.2, 0.5))
        foot = box((0.1, 0.4, 0.4))
        solids = [seat, back, foot]

    return part(solids, Surface.PLASTIC, Label.OTHER_OBJECT)


def shelter(rng: np.random.Generator) -> Mesh:
    """Return the shelter of a bus stop, open towards -y."""
    length = rng.uniform(2.5, 4.5)
    posts = copies(box((0.1, 0.1, 2.3)), x=[[-length / 2], [length / 2]], y=[-0.6, 0.6])
    roof = box((length + 0.3, 1.6, 0.12), (0, 0, 2.3))
    bench = box((length, 0.4, 0.1), (0, 0.4, 0.5))
    pane = box((length, 0.03, 1.9), (0, 0.6, 0.3))

    return join(
        [
            part([posts, roof, bench], Surface.METAL, Label.OTHER_STRUCTURE),
            part([pane], Surface.GLASS, Label.OTHER_STRUCTURE),
        ]
    )


def steps(rng: np.random.Generator) -> Mesh:
    """Return the steps before a door, or a low ramp."""
    count = int(rng.integers(2, 6))
    slabs = []
    for step in range(count):
        treads = count - step  # that this slab lies under, its own included
        slabs.append(box((1.6, 0.3 * treads, 0.17), (0, -0.15 * treads, 0.17 * step)))
    return part(slabs, Surface.PAVING, Label.OTHER_STRUCTURE)


def gable_barn(rng: np.random.Generator, width: float, depth: float, height: float) -> Mesh:
    """Return a long hall whose gable faces along y."""
    half = width / 2
    ridge = height + width * rng.uniform(0.15, 0.3)
    profile = [(-half, -1.5), (half, -1.5), (half, height), (0, ridge), (-half, height)]
    return part([prism(profile, depth)], Surface.PLASTER, Label.BUILDING)
