"""Make meshes of bicycles, scooters and motorcycles, with and without riders."""

import numpy as np

from lidarstreets.bodies.vehicles.parts import draw_paint
from lidarstreets.bodies.vehicles.people import rider
from lidarstreets.materials import Label, Surface
from lidarstreets.mesh import Mesh, join, part, place, rolled, scaled
from lidarstreets.solids import Vector, box, copies, hoop, tube

STAND_LEAN = 0.2  # largest angle in radians at which a parked two-wheeler leans over


def bicycle(rng: np.random.Generator, label: Label = Label.BICYCLE) -> Mesh:
    """Return a bicycle of any size; some have mudguards, a basket, bags or a child seat."""
    radius = rng.uniform(0.32, 0.36) if rng.random() < 0.88 else rng.uniform(0.2, 0.32)
    wheelbase = rng.uniform(1.0, 1.18)
    saddle = rng.uniform(0.78, 1.02)
    bar = saddle + rng.uniform(-0.02, 0.2)
    has_low_frame = rng.random() < 0.5

    pieces = [_wheels(label, radius, rng.uniform(0.04, 0.07), wheelbase)]
    pieces.append(_frame(label, radius, wheelbase, (saddle, bar), has_low_frame))
    pieces += _bicycle_load(rng, label, radius, wheelbase)
    mesh = join(*pieces)
    if label == Label.BICYCLE:
        return rolled(mesh, float(rng.uniform(-STAND_LEAN, STAND_LEAN)))

    return mesh


def _wheels(label: Label, radius: float, rim: float, wheelbase: float) -> Mesh:
    """Return two wheels with a hub and a few spokes; `rim` is the thickness of the tyres."""
    solids = []
    for x in (-wheelbase / 2, wheelbase / 2):
        solids.append(hoop(radius, rim, (x, -0.02, radius)))
        solids.append(hoop(radius, rim, (x, 0.02, radius)))
        for angle in (0.3, 1.35, 2.4):
            dx = (radius - rim) * np.cos(angle)
            dz = (radius - rim) * np.sin(angle)
            start = (x - dx, 0.0, radius - dz)
            solids.append(tube(start, (x + dx, 0.0, radius + dz), 0.006, sides=3))
    return part(solids, Surface.CYCLE, label)


def _frame(
    label: Label, radius: float, wheelbase: float, heights: tuple[float, float], is_low: bool
) -> Mesh:
    """Return the frame, the saddle, the pedals and the handlebar of a bicycle.

    `heights` are the heights of the saddle and of the handlebar, metres.
    """
    saddle, bar = heights
    front = wheelbase / 2
    rear = -wheelbase / 2
    crank: Vector = (-0.05, 0.0, 0.28)
    seat: Vector = (-0.2, 0.0, saddle - 0.12)
    head: Vector = (front - 0.13, 0.0, saddle - 0.1)
    lower: Vector = (front - 0.1, 0.0, 0.55)

    bars = [
        (crank, seat), (crank, lower), (crank, (rear, 0.0, radius)), (seat, (rear, 0.0, radius)),
        ((front, 0.0, radius), head), (head, (front - 0.2, 0.0, bar)),
    ]  # fmt: skip
    bars.append((crank, head) if is_low else (seat, head))
    tubes = [tube(start, end, 0.024, sides=4) for start, end in bars]
    solids = [
        *tubes,
        tube((front - 0.22, -0.29, bar), (front - 0.22, 0.29, bar), 0.02, sides=4),
        box((0.26, 0.15, 0.07), (-0.22, 0, saddle - 0.07)),
        box((0.1, 0.3, 0.05), (-0.05, 0, 0.25)),
    ]
    return part(solids, Surface.CYCLE, label)


def _bicycle_load(
    rng: np.random.Generator, label: Label, radius: float, wheelbase: float
) -> list[Mesh]:
    """Return what a bicycle carries: mudguards, a rack, a basket, bags, a child seat or nothing."""
    rear = -wheelbase / 2
    metal = []
    plastic = []
    if rng.random() < 0.6:
        for x in (rear, -rear):
            metal.append(box((0.5, 0.05, 0.02), (x, 0, 2 * radius + 0.02), top=(0.5, 1)))
    if rng.random() < 0.6:
        metal.append(box((0.4, 0.14, 0.02), (rear + 0.05, 0, 2 * radius + 0.08)))
    if rng.random() < 0.3:
        metal.append(box((0.28, 0.34, 0.24), (-rear - 0.05, 0, 0.82)))
    if rng.random() < 0.15:
        bags = box((0.32, 0.13, 0.32), (rear, 0, 0.35))
        plastic.append(copies(bags, y=[-0.16, 0.16]))
    if rng.random() < 0.1:
        plastic += [
            box((0.3, 0.32, 0.1), (rear + 0.05, 0, 2 * radius + 0.1)),
            box((0.06, 0.32, 0.5), (rear - 0.12, 0, 2 * radius + 0.1)),
        ]

    return [part(metal, Surface.METAL, label), part(plastic, Surface.PLASTIC, label)]


def fallen_bicycle(rng: np.random.Generator) -> Mesh:
    """Return a bicycle that lies on its side."""
    mesh = rolled(bicycle(rng), float(np.pi / 2 - 0.1))
    lowest = float(mesh.triangles[..., 2].min())
    return place(mesh, z=-lowest)


def motorcycle(rng: np.random.Generator, label: Label = Label.MOTORCYCLE) -> Mesh:
    """Return a motorcycle, a scooter or a moped, sometimes under a cover."""
    make = _scooter if rng.random() < 0.45 else _motorbike
    mesh = make(rng, label)
    if label == Label.MOTORCYCLE:
        if rng.random() < 0.1:
            mesh = _covered(rng)
        return rolled(mesh, float(rng.uniform(-0.17, 0.17)))

    return mesh


def _motorbike(rng: np.random.Generator, label: Label) -> Mesh:
    wheelbase = rng.uniform(1.25, 1.6)
    radius = rng.uniform(0.28, 0.34)
    front = wheelbase / 2
    rear = -front
    seat = rng.uniform(0.7, 0.88)

    tank = box((0.55, 0.34, 0.32), (0.12, 0, seat - 0.08), top=(0.8, 0.6))
    tail = box((rng.uniform(0.6, 0.85), 0.28, 0.18), (-0.42, 0, seat - 0.12), top=(0.9, 0.8))
    engine = box((0.55, 0.42, 0.4), (0.05, 0, 0.25))
    painted = [tank, tail]
    if rng.random() < 0.5:
        fairing = box((0.35, 0.5, 0.6), (front - 0.3, 0, 0.55), top=(0.5, 0.6), shift=-0.15)
        painted.append(fairing)
    boxes = []
    if rng.random() < 0.35:
        boxes.append(box((0.4, 0.45, 0.35), (rear - 0.05, 0, seat + 0.08), top=(0.9, 0.9)))
    if rng.random() < 0.2:
        boxes.append(copies(box((0.5, 0.22, 0.38), (rear, 0, 0.5)), y=[-0.32, 0.32]))

    metal = [
        engine,
        tube((front, -0.09, radius), (front - 0.3, -0.09, 1.0), 0.035, sides=4),
        tube((front, 0.09, radius), (front - 0.3, 0.09, 1.0), 0.035, sides=4),
        tube((front - 0.35, -0.38, 1.03), (front - 0.35, 0.38, 1.03), 0.025, sides=4),
        tube((rear, -0.18, 0.35), (0, -0.2, 0.3), 0.06, sides=5),
        tube((rear, 0, radius), (0, 0, 0.4), 0.05, sides=4),
        copies(box((0.03, 0.14, 0.1)), x=front - 0.38, y=[-0.36, 0.36], z=1.12),
    ]
    pieces = [
        _thick_wheels(label, radius, wheelbase),
        part(painted, draw_paint(rng, 0.5), label),
        part(metal, Surface.METAL, label),
        part([box((0.03, 0.2, 0.14), (rear - 0.3, 0, 0.5))], Surface.PLATE, label),
    ]
    return join(*pieces, part(boxes, Surface.PLASTIC, label))


def _scooter(rng: np.random.Generator, label: Label) -> Mesh:
    """Return a scooter: small wheels, a shield in front of the legs and a closed tail."""
    size = rng.uniform(0.9, 1.12)
    shield = box((0.1, 0.42, 0.6), (0.45, 0, 0.35), top=(0.8, 0.8), shift=-0.12)
    floor = box((0.5, 0.3, 0.12), (0.15, 0, 0.25))
    tail = box((0.75, 0.36, 0.5), (-0.45, 0, 0.28), top=(0.95, 0.75))
    seat = box((0.7, 0.28, 0.12), (-0.4, 0, 0.76))
    fender = box((0.4, 0.18, 0.15), (0.6, 0, 0.42), top=(0.6, 0.8))
    metal = [
        tube((0.62, 0, 0.22), (0.35, 0, 1.0), 0.04, sides=4),
        tube((0.33, -0.33, 1.02), (0.33, 0.33, 1.02), 0.025, sides=4),
        copies(box((0.03, 0.13, 0.09)), x=0.33, y=[-0.34, 0.34], z=1.12),
    ]
    pieces = [
        _thick_wheels(label, 0.22, 1.25),
        part([shield, floor, tail, fender], draw_paint(rng, 0.55), label),
        part([seat], Surface.RUBBER, label),
        part(metal, Surface.METAL, label),
    ]
    if rng.random() < 0.25:
        top_case = box((0.4, 0.42, 0.34), (-0.85, 0, 0.85), top=(0.9, 0.9))
        pieces.append(part([top_case], Surface.PLASTIC, label))
    if rng.random() < 0.2:
        screen = box((0.03, 0.4, 0.45), (0.42, 0, 0.98), top=(1, 0.8), shift=-0.12)
        pieces.append(part([screen], Surface.GLASS, label))
    return scaled(join(*pieces), size)


def _covered(rng: np.random.Generator) -> Mesh:
    """Return a motorcycle under a cover; only its wheels can be seen."""
    length = rng.uniform(1.6, 2.2)
    cover = box(
        (length, rng.uniform(0.6, 0.85), rng.uniform(0.8, 1.0)), (0, 0, 0.15), top=(0.6, 0.5)
    )
    pieces = [part([cover], Surface.CLOTH, Label.MOTORCYCLE)]
    pieces.append(_thick_wheels(Label.MOTORCYCLE, 0.3, length - 0.55))
    return join(*pieces)


def _thick_wheels(label: Label, radius: float, wheelbase: float) -> Mesh:
    tyres = []
    for x in (-wheelbase / 2, wheelbase / 2):
        tyres.append(tube((x, -0.07, radius), (x, 0.07, radius), radius, sides=10))
    return part(tyres, Surface.RUBBER, label)


def bicyclist(rng: np.random.Generator) -> Mesh:
    """Return a bicycle and its rider with the class bicyclist, perhaps with a child's trailer."""
    turn = rng.uniform(0, np.pi)
    high = 0.28 + 0.17 * float(np.sin(turn))
    low = 0.28 - 0.17 * float(np.sin(turn))
    shift = 0.17 * float(np.cos(turn))
    feet: tuple[Vector, Vector] = (
        (shift - 0.05, -0.13, high - 0.06),
        (-shift - 0.05, 0.13, low - 0.06),
    )
    body = rider(rng, Label.BICYCLIST, (-0.22, 0.93), (0.33, 1.02), feet)
    pieces = [bicycle(rng, Label.BICYCLIST), scaled(body, rng.uniform(0.93, 1.05))]

    if rng.random() < 0.06:
        tub = box((0.8, 0.75, 0.75), (-1.7, 0, 0.2), top=(0.6, 0.8))
        tyres = copies(hoop(0.25, 0.05, (-1.7, 0, 0.25)), y=[-0.42, 0.42])
        pieces.append(part([tub], Surface.CLOTH, Label.BICYCLIST))
        pieces.append(part([tyres], Surface.RUBBER, Label.BICYCLIST))
    return rolled(join(*pieces), float(rng.normal(scale=0.04)))


def motorcyclist(rng: np.random.Generator) -> Mesh:
    """Return a motorcycle and its rider with the class motorcyclist, perhaps with a passenger."""
    feet: tuple[Vector, Vector] = ((0.12, -0.24, 0.22), (0.12, 0.24, 0.22))
    grip = (0.32, 1.03)
    pieces = [motorcycle(rng, Label.MOTORCYCLIST)]
    pieces.append(rider(rng, Label.MOTORCYCLIST, (-0.28, 0.8), grip, feet))
    if rng.random() < 0.12:
        pieces.append(rider(rng, Label.MOTORCYCLIST, (-0.62, 0.84), (-0.3, 1.1), feet))
    return rolled(join(*pieces), float(rng.normal(scale=0.05)))
