"""Cars, trucks, buses, two-wheelers and people as triangle meshes; x is forward."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from amvnet.simulation.materials import Label, Surface
from amvnet.simulation.mesh import Mesh, Vector, box, hoop, join, part, prism, tube


@dataclass(frozen=True)
class CarShape:
    """The proportions of one kind of car; lengths in metres, shares of the car's length."""

    length: float
    width: float
    height: float
    # Height of the lower edge of the side windows.
    belt: float
    # Share of the length that the bonnet takes.
    bonnet: float
    # Share of the length that the boot (or the bed) takes.
    boot: float
    # Length of the roof as a share of the cabin's.
    roof: float


CAR_SHAPES = (
    CarShape(4.0, 1.70, 1.47, 0.92, 0.22, 0.02, 0.72),  # hatchback
    CarShape(4.6, 1.78, 1.43, 0.90, 0.25, 0.17, 0.58),  # saloon
    CarShape(4.6, 1.80, 1.47, 0.92, 0.24, 0.02, 0.78),  # estate
    CarShape(4.5, 1.85, 1.70, 1.05, 0.23, 0.02, 0.82),  # sport utility
    CarShape(4.8, 1.90, 1.95, 1.10, 0.16, 0.01, 0.88),  # van
    CarShape(5.2, 1.88, 1.80, 1.05, 0.22, 0.33, 0.70),  # pickup
    CarShape(3.6, 1.65, 1.50, 0.92, 0.18, 0.02, 0.75),  # city car
)
_SHAPE_SHARES = np.array([0.27, 0.20, 0.18, 0.14, 0.10, 0.03, 0.08])


def _wheels(
    label: Label, length: float, width: float, radius: float, axles: tuple[float, ...]
) -> list[Mesh]:
    bars = [
        tube(
            (x * length, side * (width / 2 - 0.2), radius),
            (x * length, side * (width / 2 + 0.01), radius),
            radius,
        )
        for x in axles
        for side in (-1, 1)
    ]
    return [part(np.concatenate(bars), Surface.RUBBER, label)]


def _lower_body(shape: CarShape, half: float) -> list[tuple[float, float]]:
    """Side view of what is below the windows."""
    bonnet = half - shape.length * shape.bonnet
    return [
        (-half + 0.05, 0.25),
        (half - 0.05, 0.22),
        (half, 0.55),
        (half - 0.12, shape.belt - 0.2),
        (bonnet, shape.belt),
        (-half + 0.03, shape.belt - 0.02),
        (-half, 0.55),
    ]


def car(rng: np.random.Generator) -> Mesh:
    """A car of a random shape, size and paint."""
    shape = CAR_SHAPES[rng.choice(len(CAR_SHAPES), p=_SHAPE_SHARES)]
    half = shape.length / 2
    cabin = shape.length * (1 - shape.bonnet - shape.boot)
    rear = -half + shape.length * shape.boot
    paint = Surface.LIGHT_PAINT if rng.random() < 0.45 else Surface.DARK_PAINT
    pane = shape.height - shape.belt - 0.06
    lean = cabin * (1 - shape.roof) * rng.uniform(-0.35, 0.0)
    window = box(
        (cabin, shape.width * 0.94, pane),
        (rear + cabin / 2, 0, shape.belt),
        (shape.roof, 0.84),
        lean,
    )
    roof_size = (cabin * shape.roof, shape.width * 0.80, 0.07)
    roof = box(roof_size, (rear + cabin / 2 + lean, 0, shape.belt + pane), (0.9, 0.9))
    pillars = [
        tube(
            (rear + cabin * x, side * shape.width * 0.46, shape.belt),
            _pillar_top(rear, cabin, x, shape, side),
            0.05,
        )
        for x in (0.03, 0.5, 0.97)
        for side in (-1, 1)
    ]
    plates = [box((0.04, 0.5, 0.11), (end * (half + 0.01), 0, 0.5)) for end in (-1, 1)]
    painted = np.concatenate(
        [prism(_lower_body(shape, half), shape.width, shape.width * 0.95), roof, *pillars]
    )
    pieces = [part(painted, paint, Label.CAR), part(window, Surface.GLASS, Label.CAR)]
    pieces += [part(np.concatenate(plates), Surface.PLATE, Label.CAR)]
    pieces += _wheels(Label.CAR, shape.length, shape.width, 0.32, (-0.31, 0.31))
    return _scaled(join(pieces), rng.uniform(0.94, 1.06))


def _pillar_top(rear: float, cabin: float, x: float, shape: CarShape, side: int) -> Vector:
    """Where a pillar meets the roof: towards the middle of the cabin."""
    return (
        rear + cabin * (0.5 + (x - 0.5) * shape.roof),
        side * shape.width * 0.39,
        shape.height - 0.06,
    )


def _scaled(mesh: Mesh, factor: float) -> Mesh:
    return replace(mesh, triangles=mesh.triangles * np.float32(factor))


def truck(rng: np.random.Generator) -> Mesh:
    """A lorry: cab, then a box or an open bed."""
    length, width, height = rng.uniform(6, 11), rng.uniform(2.2, 2.5), rng.uniform(2.7, 3.7)
    nose = length / 2
    cab = box((2.0, width, 1.7), (nose - 1.0, 0, 0.6), (0.9, 0.95), -0.1)
    screen = box((0.05, width * 0.85, 0.8), (nose - 0.05, 0, 1.4))
    load = height - 1.0 if rng.random() < 0.75 else rng.uniform(0.5, 1.0)
    freight = box((length - 2.3, width, load), (-1.15, 0, 1.0))
    frame = box((length - 0.5, width * 0.5, 0.4), (-0.2, 0, 0.6))
    hull = Surface.LIGHT_PAINT if rng.random() < 0.7 else Surface.DARK_PAINT
    pieces = [
        part(np.concatenate([cab, frame]), hull, Label.TRUCK),
        part(freight, Surface.PLASTIC, Label.TRUCK),
        part(screen, Surface.GLASS, Label.TRUCK),
    ]
    return join(pieces + _wheels(Label.TRUCK, length, width, 0.48, (-0.36, -0.22, 0.36)))


def bus(rng: np.random.Generator) -> Mesh:
    """A city bus with a band of windows."""
    length, width = rng.uniform(9, 13), 2.5
    hull = np.concatenate(
        [box((length, width, 1.0), (0, 0, 0.3)), box((length, width, 0.6), (0, 0, 2.4))]
    )
    posts = [
        box((0.25, width, 1.1), (x, 0, 1.3))
        for x in np.linspace(-length / 2 + 0.2, length / 2 - 0.2, 7)
    ]
    panes = box((length * 0.98, width * 0.98, 1.1), (0, 0, 1.3))
    pieces = [
        part(np.concatenate([hull, *posts]), Surface.LIGHT_PAINT, Label.BUS),
        part(panes, Surface.GLASS, Label.BUS),
    ]
    return join(pieces + _wheels(Label.BUS, length, width, 0.48, (-0.28, 0.33)))


def trailer(rng: np.random.Generator) -> Mesh:
    """A caravan or a flat trailer, which SemanticKITTI counts as another vehicle."""
    length, height = rng.uniform(2.5, 5.5), rng.choice([0.6, 1.9])
    hull = box((length, 2.0, height), (0, 0, 0.5), (0.95, 0.97))
    bar = tube((length / 2, 0, 0.5), (length / 2 + 1.0, 0, 0.45), 0.06)
    pieces = [part(np.concatenate([hull, bar]), Surface.LIGHT_PAINT, Label.TRAILER)]
    return join(pieces + _wheels(Label.TRAILER, length, 2.0, 0.33, (-0.05,)))


def excavator(rng: np.random.Generator) -> Mesh:
    """A digger on tracks, its arm raised or lowered."""
    turn, reach = rng.uniform(-0.6, 0.6), rng.uniform(2.5, 4.0)
    tracks = [box((3.4, 0.5, 0.8), (0, side * 1.1, 0)) for side in (-1, 1)]
    elbow = (1.2 + reach * 0.5, turn * reach * 0.5, rng.uniform(2.8, 4.0))
    hand = (1.2 + reach, turn * reach, rng.uniform(0.3, 1.5))
    arm = [
        tube((0.9, 0.3, 1.4), elbow, 0.22),
        tube(elbow, hand, 0.16),
        box((0.7, 0.9, 0.5), (hand[0], hand[1], 0.2)),
    ]
    solid = np.concatenate([*tracks, box((2.8, 2.3, 1.0), (-0.5, 0, 0.9)), *arm])
    cab = box((1.4, 1.0, 1.5), (0.3, 0.6, 1.5), (0.9, 0.9))
    pieces = [(solid, Surface.LIGHT_PAINT), (cab, Surface.GLASS)]
    return join(
        [part(triangles, surface, Label.CONSTRUCTION_VEHICLE) for triangles, surface in pieces]
    )


def _figure(
    rng: np.random.Generator, label: Label, hip: Vector, feet: tuple[Vector, Vector], lean: float
) -> Mesh:
    """A human from hips and feet upwards; `lean` moves the shoulders forward."""
    shoulder = (hip[0] + lean, 0.0, hip[2] + 0.55)
    legs = [
        tube((hip[0], 0.09 * side, hip[2]), foot, 0.09, 0.06)
        for side, foot in zip((-1, 1), feet, strict=True)
    ]
    torso = tube((hip[0], 0, hip[2] - 0.05), shoulder, 0.17, 0.21)
    reach = rng.uniform(-0.1, 0.3) + lean
    arms = [
        tube(
            (shoulder[0], 0.23 * side, shoulder[2] - 0.05),
            (hip[0] + reach, 0.28 * side, hip[2] + 0.05),
            0.055,
        )
        for side in (-1, 1)
    ]
    head = tube(
        (shoulder[0], 0, shoulder[2]), (shoulder[0] + 0.05, 0, shoulder[2] + 0.32), 0.10, 0.09
    )
    return join(
        [
            part(np.concatenate([torso, *legs, *arms]), Surface.CLOTH, label),
            part(head, Surface.SKIN, label),
        ]
    )


def person(rng: np.random.Generator) -> Mesh:
    """Somebody who stands or walks, adult or child."""
    stride = rng.uniform(0, 0.35)
    feet = ((stride, -0.1, 0.0), (-stride, 0.1, 0.0))
    figure = _figure(rng, Label.PERSON, (0, 0, 0.88), feet, rng.uniform(-0.02, 0.08))
    return _scaled(figure, rng.uniform(0.95, 1.1) if rng.random() < 0.88 else rng.uniform(0.6, 0.9))


def _two_wheeler(label: Label, wheel: float, rim: float, base: float) -> list[Mesh]:
    """Wheels, frame and handlebar; `base` is the distance of the axles."""
    front, rear = base / 2, -base / 2
    tyres = [hoop(wheel, rim, (x, y, wheel)) for x in (front, rear) for y in (-0.02, 0.02)]
    bars = [
        tube((rear, 0, wheel), (-0.1, 0, 0.85), 0.03, sides=5),
        tube((-0.1, 0, 0.85), (front - 0.12, 0, 0.82), 0.03, sides=5),
        tube((0, 0, 0.35), (front - 0.12, 0, 0.80), 0.03, sides=5),
        tube((front, 0, wheel), (front - 0.15, 0, 1.02), 0.03, sides=5),
        tube((front - 0.15, -0.28, 1.02), (front - 0.15, 0.28, 1.02), 0.025, sides=5),
        box((0.25, 0.14, 0.07), (-0.15, 0, 0.88)),
    ]
    return [
        part(np.concatenate(tyres), Surface.RUBBER, label),
        part(np.concatenate(bars), Surface.METAL, label),
    ]


def bicycle(rng: np.random.Generator, label: Label = Label.BICYCLE) -> Mesh:
    """A bicycle, with a basket now and then."""
    pieces = _two_wheeler(label, 0.34, 0.06, 1.05)
    if rng.random() < 0.4:
        pieces.append(part(box((0.3, 0.3, 0.25), (0.55, 0, 0.8)), Surface.METAL, label))
    return join(pieces)


def motorcycle(rng: np.random.Generator, label: Label = Label.MOTORCYCLE) -> Mesh:
    """A motorcycle or a scooter."""
    tank = box((0.6, 0.32, 0.4), (0.1, 0, 0.5), (0.8, 0.7))
    tail = box((rng.uniform(0.6, 0.8), 0.26, 0.22), (-0.4, 0, 0.62))
    shield = box((0.08, 0.4, 0.45), (0.55, 0, 0.8), (1, 0.7), -0.1)
    pieces = _two_wheeler(label, 0.31, 0.16, 1.35)
    return join([*pieces, part(np.concatenate([tank, tail, shield]), Surface.LIGHT_PAINT, label)])


def bicyclist(rng: np.random.Generator) -> Mesh:
    """A bicycle and who rides it, one class together."""
    feet = ((0.1, -0.12, 0.2), (0.05, 0.12, 0.5))
    rider = _figure(rng, Label.BICYCLIST, (-0.15, 0, 0.98), feet, rng.uniform(0.1, 0.4))
    return join([bicycle(rng, Label.BICYCLIST), rider])


def motorcyclist(rng: np.random.Generator) -> Mesh:
    """A motorcycle and who rides it, one class together."""
    feet = ((0.15, -0.2, 0.3), (0.15, 0.2, 0.3))
    rider = _figure(rng, Label.MOTORCYCLIST, (-0.25, 0, 0.85), feet, rng.uniform(0.15, 0.35))
    return join([motorcycle(rng, Label.MOTORCYCLIST), rider])
