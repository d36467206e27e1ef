"""Make meshes of poles, lamps, signs and what closes off a work zone.

Signs face -x: a driver who goes towards +x sees their fronts. The arms of lamps reach towards +y.
"""

from collections.abc import Sequence

import numpy as np

from lidarstreets.materials import Label, Surface
from lidarstreets.mesh import Mesh, join, part, place
from lidarstreets.solids import box, copies, leaning, prism, tube

BELOW_GROUND = 0.4  # depth of poles below the ground, metres


def _pole(
    rng: np.random.Generator, height: float, radius: float, top_radius: float | None = None
) -> np.ndarray:
    """Return the (T, 3, 3) triangles of a pole, which may slant a little."""
    mast = tube((0, 0, -BELOW_GROUND), (0, 0, height), radius, top_radius, closed=False)
    slant_x, slant_y = rng.normal(scale=0.008 if rng.random() < 0.8 else 0.04, size=2)
    return leaning(mast, slant_x, slant_y)


def lamp(rng: np.random.Generator) -> Mesh:
    """Return a street lamp that has an arm over the road, towards +y, or a head on its mast."""
    height = rng.uniform(3, 10)
    radius = rng.uniform(0.03, 0.08)
    solids = [_pole(rng, height, radius, radius * rng.uniform(0.4, 1.0))]

    kind = rng.random()
    if kind < 0.6:
        reach = rng.uniform(0.3, 2.5)
        solids.append(tube((0, 0, height), (0, reach, height + 0.2), 0.04, sides=5, closed=False))
        solids.append(box((0.3, 0.7, 0.15), (0, reach, height + 0.1)))
    elif kind < 0.8:
        solids.append(tube((0, 0, height), (0, 0, height + 0.5), 0.15, 0.3))
    else:
        solids.append(box((0.5, 0.5, 0.6), (0, 0, height), top=(1.3, 1.3)))

    # A thicker foot, with the door of the fuse box.
    if rng.random() < 0.5:
        foot_height = rng.uniform(0.5, 1.4)
        solids.append(tube((0, 0, 0), (0, 0, foot_height), radius * 1.4, closed=False))
    surface = Surface.MAST if rng.random() < 0.8 else Surface.PLASTER
    return join(part(solids, surface, Label.POLE), *_carried(rng))


def _carried(rng: np.random.Generator) -> list[Mesh]:
    """Return what some poles carry: a small sign, a bin or a box."""
    kind = rng.random()
    if kind < 0.10:
        return [_face(rng, rng.uniform(1.9, 2.8))]
    if kind < 0.15:
        bin_box = box((0.35, 0.3, 0.5), (0, -0.22, rng.uniform(0.6, 1.0)))
        return [part([bin_box], Surface.PLASTIC, Label.OTHER_OBJECT)]
    if kind < 0.20:
        case = box((0.35, 0.25, 0.5), (0, 0.15, rng.uniform(0.8, 2.5)))
        return [part([case], Surface.MAST, Label.POLE)]
    return []


def post(rng: np.random.Generator) -> Mesh:
    """Return a bollard, a thin post or a guide post."""
    if rng.random() < 0.25:
        return guide_post(rng)

    height = rng.uniform(0.5, 1.3)
    radius = rng.uniform(0.03, 0.08)
    surface = (Surface.MAST, Surface.PLASTER, Surface.WOOD)[rng.choice(3, p=[0.6, 0.2, 0.2])]
    body = tube((0, 0, -0.2), (0, 0, height), radius)
    return part([body], surface, Label.POLE)


def guide_post(rng: np.random.Generator) -> Mesh:
    """Return the white post with a reflector that stands along country roads."""
    body = box((0.1, 0.12, 1.25), (0, 0, -0.25), top=(0.9, 0.9))
    reflector = box((0.02, 0.06, 0.18), (-0.06, 0, 0.7))
    return join(
        part([body], Surface.PLASTIC, Label.POLE, tint=1.0),
        part([reflector], Surface.PLATE, Label.POLE),
    )


def utility_pole(rng: np.random.Generator) -> Mesh:
    """Return a pole of wood or concrete that carries wires; some stand in pairs."""
    height = rng.uniform(6, 10)
    radius = rng.uniform(0.07, 0.12)

    solids = [_pole(rng, height, radius, radius * 0.7)]
    if rng.random() < 0.12:
        stay = tube(
            (rng.uniform(1, 2), 0, -BELOW_GROUND), (0, 0, height * 0.8), radius, closed=False
        )
        solids.append(stay)
    if rng.random() < 0.5:
        solids.append(box((0.12, rng.uniform(0.8, 2.2), 0.12), (0, 0, height - 0.8)))
    surface = Surface.WOOD if rng.random() < 0.75 else Surface.PLASTER
    return join(part(solids, surface, Label.POLE), *_carried(rng))


def flag_pole(rng: np.random.Generator) -> Mesh:
    """Return a tall mast with a flag."""
    height = rng.uniform(6, 9)
    flag = box((0.03, 1.1, rng.uniform(1.5, 3.5)), (0, 0.6, height - 3.8))
    return join(
        part([_pole(rng, height, 0.05, 0.03)], Surface.MAST, Label.POLE),
        part([flag], Surface.CLOTH, Label.OTHER_OBJECT),
    )


# Number of sides and radius in metres of the faces of signs: discs (which are twice as likely),
# triangles, octagons, diamonds.
_OUTLINES = ((12, 0.33), (12, 0.33), (3, 0.46), (8, 0.42), (4, 0.42))


def _face(rng: np.random.Generator, height: float, x: float = -0.06) -> Mesh:
    """Return the face of a sign, bright in front and dull behind; its lower edge is at `height`."""
    kind = rng.random()
    scale = rng.uniform(0.7, 1.3)
    if kind < 0.6:
        sides, radius = _OUTLINES[rng.integers(len(_OUTLINES))]
        middle = height + radius * scale
        disc = tube((x, 0, middle), (x + 0.02, 0, middle), radius * scale, sides=sides)
        dull = disc + np.array([0.021, 0, 0])
    else:
        size = (0.02, rng.uniform(0.25, 0.8), rng.uniform(0.2, 0.9))
        disc = box(size, (x, 0, height))
        dull = box(size, (x + 0.021, 0, height))
    return _two_sided(rng, disc, dull)


def _two_sided(rng: np.random.Generator, front: np.ndarray, back: np.ndarray) -> Mesh:
    return join(
        part([front], Surface.SIGN_FACE, Label.TRAFFIC_SIGN, tint=rng.normal(scale=0.8)),
        part([back], Surface.METAL, Label.TRAFFIC_SIGN, tint=rng.normal(0.5, 0.5)),
    )


def sign(rng: np.random.Generator) -> Mesh:
    """Return one or two signs on a post, a board on two posts, or a chevron, facing -x."""
    kind = rng.random()
    if kind < 0.06:
        mesh = _large_board(rng)
    elif kind < 0.10:
        mesh = _chevron(rng)
    else:
        # The lower edge of the upper sign; some are as low as a person.
        height = rng.uniform(1.6, 2.8) if rng.random() < 0.75 else rng.uniform(0.4, 1.4)
        mast = part([_pole(rng, height + 0.5, rng.uniform(0.025, 0.05))], Surface.MAST, Label.POLE)
        parts = [mast, _face(rng, height)]
        if rng.random() < 0.3:
            parts.append(_face(rng, height - rng.uniform(0.4, 0.9)))
        mesh = join(*parts)

    # Most face the traffic; the others show their backs, or face a side road.
    turn = rng.normal(scale=0.15) + rng.choice([0.0, np.pi, np.pi / 2], p=[0.7, 0.15, 0.15])
    return place(mesh, 0, 0, 0, turn)


def _large_board(rng: np.random.Generator) -> Mesh:
    """Return a direction sign, a town sign or a notice board on two posts."""
    width = rng.uniform(0.8, 3.2)
    return _board(rng, width, rng.uniform(0.5, 1.0) * min(width, 2.5), rng.uniform(0.6, 2.4), 2)


def direction_board(rng: np.random.Generator) -> Mesh:
    """Return the large board of a main road on two to four posts, facing -x or +x."""
    width = rng.uniform(1.5, 4.5)
    posts = int(rng.integers(2, 5)) if width > 2.5 else 2
    board = _board(rng, width, rng.uniform(0.5, 1.1) * width, rng.uniform(1.0, 3.2), posts)
    return place(board, 0, 0, 0, rng.normal(scale=0.15) + (np.pi if rng.random() < 0.4 else 0.0))


def _board(rng: np.random.Generator, width: float, rise: float, height: float, posts: int) -> Mesh:
    """Return a board on posts; it is `rise` metres high, and its lower edge is at `height`."""
    post_y = np.linspace(-0.4, 0.4, posts) * width
    radius = rng.uniform(0.03, 0.08)
    post_solid = tube((0, 0, -BELOW_GROUND), (0, 0, height + rise), radius, closed=False)
    masts = part([copies(post_solid, y=post_y)], Surface.MAST, Label.POLE)
    front = box((0.03, width, rise), (-0.12, 0, height))
    return join(masts, _two_sided(rng, front, front + np.array([0.031, 0, 0])))


def _chevron(rng: np.random.Generator) -> Mesh:
    """Return the low board that marks a bend or an obstacle."""
    size = (0.03, rng.uniform(0.25, 1.5), rng.uniform(0.5, 1.0))
    height = rng.uniform(0.2, 0.7)
    front = box(size, (-0.05, 0, height))
    posts = part([_pole(rng, height + size[2], 0.03)], Surface.MAST, Label.POLE)
    return join(posts, _two_sided(rng, front, front + np.array([0.031, 0, 0])))


def traffic_light(rng: np.random.Generator) -> Mesh:
    """Return a traffic light; SemanticKITTI counts its housing as traffic sign."""
    mast = _pole(rng, 3.4, rng.uniform(0.05, 0.1))
    lamps = [box((0.25, 0.3, 0.9), (0, 0.1, 2.4))]
    backboard = [box((0.02, 0.5, 1.1), (0.1, 0.1, 2.3))]

    solids = [mast]
    if rng.random() < 0.4:
        reach = rng.uniform(2.5, 6)
        solids.append(tube((0, 0, 0), (0, 0, 5.6), 0.12, 0.08, closed=False))
        solids.append(tube((0, 0, 5.5), (0, reach, 5.7), 0.07, 0.05, closed=False))
        lamps.append(box((0.25, 0.3, 0.9), (0, reach, 5.0)))
        backboard.append(box((0.02, 0.5, 1.1), (0.1, reach, 4.9)))

    return join(
        part(solids, Surface.MAST, Label.POLE),
        part(lamps + backboard, Surface.PLASTIC, Label.TRAFFIC_SIGN),
    )


def gantry(rng: np.random.Generator, width: float) -> Mesh:
    """Return a portal with direction signs, which spans `width` metres along y."""
    height = rng.uniform(5.2, 6.2)
    masts = copies(
        tube((0, 0, -BELOW_GROUND), (0, 0, height + 1), 0.18, closed=False),
        y=[-width / 2, width / 2],
    )
    beams = copies(box((0.3, width, 0.3)), z=[height, height + 1.2])
    board = box((0.05, width * 0.3, 2.0), (-0.25, -width * 0.2, height))

    return join(
        part([masts], Surface.MAST, Label.POLE),
        part([beams], Surface.METAL, Label.OTHER_STRUCTURE),
        _two_sided(rng, board, board + np.array([0.06, 0, 0])),
    )


def railway_mast(rng: np.random.Generator) -> Mesh:
    """Return the mast of an overhead line, with an arm towards +y."""
    mast = box((0.3, 0.3, 7.5 + BELOW_GROUND), (0, 0, -BELOW_GROUND), top=(0.6, 0.6))
    arm = tube((0, 0, 6.5), (0, 3, 6.0), 0.05, sides=5)
    surface = Surface.METAL if rng.random() < 0.6 else Surface.PLASTER
    return part([mast, arm], surface, Label.POLE)


def barrier(length: float) -> Mesh:
    """Return a segment of a concrete barrier, `length` metres along x."""
    profile: Sequence[tuple[float, float]] = [
        (-0.3, 0), (0.3, 0), (0.3, 0.08), (0.12, 0.35), (0.08, 0.8), (-0.08, 0.8), (-0.12, 0.35),
        (-0.3, 0.08),
    ]  # fmt: skip
    along_street = prism(profile, length)[..., [1, 0, 2]]  # the profile lies across the street

    return part([along_street], Surface.BRICK, Label.BARRIER)


def traffic_cone(rng: np.random.Generator) -> Mesh:
    """Return a traffic cone."""
    height = rng.uniform(0.5, 0.9)
    foot = box((0.36, 0.36, 0.04))
    cone = tube((0, 0, 0.04), (0, 0, height), 0.15, 0.03)
    return part([foot, cone], Surface.PLASTIC, Label.TRAFFIC_CONE)
