"""Make meshes of trailers, caravans, motor homes and machines.

SemanticKITTI labels all of them other-vehicle.
"""

import numpy as np

from lidarstreets.bodies.vehicles.parts import glass, lamps, plates_and_lamps, wheels
from lidarstreets.chance import weighted_choice
from lidarstreets.materials import Label, Surface
from lidarstreets.mesh import Mesh, join, part, scaled
from lidarstreets.solids import box, copies, prism, tube, turned

_MACHINE = Label.CONSTRUCTION_VEHICLE


def trailer(rng: np.random.Generator) -> Mesh:
    """Return a trailer for a car, with or without a cover, a boat trailer or a caravan."""
    kind = rng.random()
    if kind < 0.35:
        return caravan(rng)
    if kind < 0.48:
        return _boat_trailer(rng)

    length = rng.uniform(1.8, 4.5)
    width = rng.uniform(1.2, 2.1)
    floor = rng.uniform(0.4, 0.65)
    board = rng.uniform(0.3, 0.6)

    tub = [
        box((length, width, 0.08), (0, 0, floor)),
        copies(box((length, 0.05, board), (0, 0, floor)), y=[-width / 2, width / 2]),
        copies(box((0.05, width, board), (0, 0, floor)), x=[-length / 2, length / 2]),
    ]
    pieces = [part([*tub, *_drawbar(length, floor)], Surface.COATING, Label.TRAILER)]

    cover = rng.random()
    if cover < 0.35:
        height = rng.uniform(0.6, 1.6)
        tarpaulin = box((length, width, height), (0, 0, floor + board), top=(0.97, 0.9))
        pieces.append(part([tarpaulin], Surface.PLASTIC, Label.TRAILER))
    elif cover < 0.6:
        lid = box((length, width, rng.uniform(0.05, 0.3)), (0, 0, floor + board), top=(0.9, 0.9))
        pieces.append(part([lid], Surface.PLASTIC, Label.TRAILER))
    elif cover < 0.75:
        size = (length * 0.7, width * 0.7, rng.uniform(0.3, 1.0))
        pieces.append(part([box(size, (0, 0, floor))], Surface.WOOD, Label.TRAILER))
    pieces.append(wheels(Label.TRAILER, _axles(rng, length), width + 0.1, 0.3, 0.18))
    pieces.append(lamps(length / 2, width, floor + 0.05, Label.TRAILER))
    return join(*pieces)


def caravan(rng: np.random.Generator) -> Mesh:
    """Return a caravan."""
    length = rng.uniform(3.5, 7.0)
    width = rng.uniform(1.9, 2.5)
    height = rng.uniform(2.1, 2.6)
    floor = rng.uniform(0.3, 0.45)
    half = length / 2

    slope = rng.uniform(0.1, 0.6)
    profile = [
        (-half + 0.1, floor), (half - 0.1, floor), (half, floor + 0.8),
        (half - slope, height - 0.05), (0, height), (-half + slope * 0.6, height - 0.05),
        (-half, floor + 0.9),
    ]  # fmt: skip
    pane = box((rng.uniform(0.6, 1.2), width + 0.04, 0.55))
    panes = copies(pane, x=[-half * 0.55, half * 0.35], z=1.3)
    door = box((0.65, 0.05, 1.75), (0, -width / 2, floor + 0.1))

    return join(
        part([prism(profile, width)], Surface.LIGHT_PAINT, Label.TRAILER),
        part([panes], Surface.GLASS, Label.TRAILER),
        part([door, *_drawbar(length, floor + 0.1)], Surface.PLASTIC, Label.TRAILER),
        wheels(Label.TRAILER, _axles(rng, length), width, 0.33, 0.2),
        lamps(half, width, floor + 0.3, Label.TRAILER),
    )


def camper(rng: np.random.Generator) -> Mesh:
    """Return a motor home: a living box behind the cab of a van, often with an alcove over it."""
    length = rng.uniform(5.4, 7.5)
    width = rng.uniform(2.0, 2.35)
    height = rng.uniform(2.6, 3.2)
    half = length / 2
    door = half - rng.uniform(1.5, 2.0)
    belt = 1.2

    nose = [(door, 0.3), (half, 0.3), (half, 0.8), (half - 0.7, belt), (door, belt)]
    screen = [(door, belt + 0.01), (half - 0.7, belt + 0.01), (door + 0.3, 2.05), (door, 2.05)]
    living = box(
        (door + half, width, height - 0.35), ((door - half) / 2, 0, 0.35), top=(0.99, 0.97)
    )
    white = [prism(nose, width * 0.92), living]
    if rng.random() < 0.5:
        alcove = [(door, 2.05), (door + 0.4, 2.05), (door + 1.1, 2.35), (door, height)]
        white.append(prism(alcove, width))
    panes = copies(box((0.9, width + 0.03, 0.5)), x=[-half * 0.5, half * 0.15], z=1.4)
    awning = box((length * 0.5, 0.12, 0.12), (-0.3, -width / 2, height - 0.3))

    return join(
        part([*white, awning], Surface.LIGHT_PAINT, Label.CAMPER),
        glass([prism(screen, width * 0.88)], Label.CAMPER, bool(rng.random() < 0.5)),
        part([panes], Surface.GLASS, Label.CAMPER),
        wheels(Label.CAMPER, (-half * 0.5, half * 0.7), width, 0.34),
        plates_and_lamps(Label.CAMPER, half, width, 0.55, 0.7),
    )


def _boat_trailer(rng: np.random.Generator) -> Mesh:
    length = rng.uniform(3.5, 6.5)
    width = rng.uniform(1.3, 2.1)
    half = length / 2

    profile = [
        (-half, 0.6), (half * 0.5, 0.55), (half, 1.3), (half * 0.3, 1.45), (-half, 1.35),
    ]  # fmt: skip
    hull = prism(profile, width * 0.5, width)
    frame = copies(box((length, 0.08, 0.1), (0, 0, 0.4)), y=[-0.5, 0.5])
    surface = Surface.PLASTIC if rng.random() < 0.5 else Surface.LIGHT_PAINT

    return join(
        part([hull], surface, Label.TRAILER),
        part([frame, *_drawbar(length, 0.4)], Surface.METAL, Label.TRAILER),
        wheels(Label.TRAILER, _axles(rng, length), width, 0.3, 0.18),
    )


def _drawbar(length: float, z: float) -> list[np.ndarray]:
    """Return the bar of a trailer and the small wheel on which it rests, at the height z."""
    tip = length / 2 + 1.1
    return [
        tube((length / 2 - 0.3, -0.4, z), (tip, 0, z), 0.05, sides=4),
        tube((length / 2 - 0.3, 0.4, z), (tip, 0, z), 0.05, sides=4),
        tube((tip - 0.2, 0, 0.02), (tip - 0.2, 0, z + 0.3), 0.04, sides=4),
    ]


def _axles(rng: np.random.Generator, length: float) -> list[float]:
    x = -length * rng.uniform(0.0, 0.1)
    if length > 4 and rng.random() < 0.5:
        return [x - 0.38, x + 0.38]
    return [x]


def machine(rng: np.random.Generator) -> Mesh:
    """Return an excavator, a wheel loader or a tractor."""
    makers = {excavator: 0.40, _tractor: 0.35, _wheel_loader: 0.25}
    return weighted_choice(rng, makers)(rng)


def excavator(rng: np.random.Generator) -> Mesh:
    """Return an excavator on tracks. Its arm is raised or lowered, and its body is turned."""
    size = rng.uniform(0.45, 1.1)
    reach = rng.uniform(2.5, 4.5)
    elbow = (1.2 + reach * 0.5, 0.0, rng.uniform(2.6, 4.2))
    hand_x = 1.2 + reach
    hand = (hand_x, 0.0, rng.uniform(0.3, 1.8))

    tracks = copies(box((3.4, 0.5, 0.8)), y=[-1.1, 1.1])
    body = box((2.8, 2.3, 1.0), (-0.5, 0, 0.9))
    engine = box((1.2, 2.2, 0.5), (-1.3, 0, 1.9), top=(0.9, 0.9))
    upper_arm = tube((0.9, 0.0, 1.4), elbow, 0.22, sides=5)
    lower_arm = tube(elbow, hand, 0.16, sides=5)
    bucket = box((0.7, 0.9, 0.6), (hand_x, 0.0, hand[2] - 0.3), top=(1.0, 0.9), shift=-0.2)
    cabin = box((1.4, 1.0, 1.5), (0.3, 0.6, 1.5), top=(0.9, 0.9))

    angle = rng.uniform(-np.pi, np.pi)
    painted = [turned(solid, angle) for solid in (body, engine, upper_arm, lower_arm, bucket)]
    scale = np.float32(size)

    return join(
        part([tracks * scale], Surface.RUBBER, _MACHINE),
        part([np.concatenate(painted) * scale], Surface.COATING, _MACHINE),
        glass([turned(cabin, angle) * scale], _MACHINE, clear=False),
    )


def _tractor(rng: np.random.Generator) -> Mesh:
    size = rng.uniform(0.75, 1.15)
    bonnet = [(0.1, 0.7), (2.0, 0.75), (2.05, 1.3), (1.7, 1.5), (0.1, 1.6)]
    cabin = box((1.4, 1.4, 1.2), (-0.7, 0, 1.55), top=(0.85, 0.85))
    roof = box((1.3, 1.35, 0.16), (-0.7, 0, 2.75))
    fenders = copies(box((1.3, 0.4, 0.12), (-1.0, 0, 1.6)), y=[-0.85, 0.85])
    hull = box((2.8, 0.7, 0.6), (0.0, 0, 0.55))
    exhaust = tube((1.4, 0.3, 1.4), (1.4, 0.3, 2.5), 0.05, sides=5)

    paint = Surface.COATING
    pieces = [
        part([prism(bonnet, 0.75), roof, fenders, hull], paint, _MACHINE),
        glass([cabin], _MACHINE, bool(rng.random() < 0.6)),
        part([exhaust], Surface.METAL, _MACHINE),
        wheels(_MACHINE, (-1.0,), 2.1, 0.85, 0.5),
        wheels(_MACHINE, (1.5,), 1.8, 0.55, 0.35),
    ]
    if rng.random() < 0.4:
        implement = box((0.6, rng.uniform(1.5, 2.8), 0.7), (-2.3, 0, rng.uniform(0.1, 0.6)))
        pieces.append(part([implement], Surface.METAL, _MACHINE))
    mesh = join(*pieces)
    return scaled(mesh, size)


def _wheel_loader(rng: np.random.Generator) -> Mesh:
    lift = rng.uniform(0.1, 1.5)
    radius = rng.uniform(0.5, 0.75)

    body = [(-2.4, 0.8), (0.2, 0.8), (0.2, 1.5), (-2.4, 1.9)]
    cabin = box((1.3, 1.4, 1.5), (-0.4, 0, 1.5), top=(0.9, 0.9))
    frame = box((2.0, 1.0, 0.6), (1.1, 0, 0.7))
    arms = [
        tube((0.4, side, 1.5), (2.6, side, lift + 0.4), 0.13, sides=5) for side in (-0.45, 0.45)
    ]
    bucket = [(2.5, lift), (3.5, lift), (2.8, lift + 1.0), (2.45, lift + 0.9)]
    solids = [prism(body, 1.6), frame, *arms]
    mesh = join(
        part(solids, Surface.COATING, _MACHINE),
        part([prism(bucket, 2.4)], Surface.METAL, _MACHINE),
        glass([cabin], _MACHINE, bool(rng.random() < 0.5)),
        wheels(_MACHINE, (-1.4, 1.4), 2.3, radius, 0.5),
    )
    return scaled(mesh, rng.uniform(0.6, 1.1))
