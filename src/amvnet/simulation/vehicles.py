"""Meshes of cars, trucks, buses, two-wheelers and people; x is forward."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from amvnet.simulation.materials import Label, Surface
from amvnet.simulation.mesh import Mesh, Vector, box, copies, hoop, join, part, prism, tube


@dataclass(frozen=True)
class CarShape:
    """The proportions of one type of car; lengths are in metres."""

    length: float
    width: float
    height: float
    # Height of the lower edge of the side windows.
    belt: float
    # Share of the length that is the bonnet.
    bonnet: float
    # Share of the length that is the boot, or the bed of a pickup.
    boot: float
    # Length of the roof as a share of the cabin's length.
    roof: float


# The types of cars and their shares.
CAR_SHAPES = (
    CarShape(4.0, 1.70, 1.47, belt=0.92, bonnet=0.22, boot=0.02, roof=0.72),  # hatchback
    CarShape(4.6, 1.78, 1.43, belt=0.90, bonnet=0.25, boot=0.17, roof=0.58),  # saloon
    CarShape(4.6, 1.80, 1.47, belt=0.92, bonnet=0.24, boot=0.02, roof=0.78),  # estate
    CarShape(4.5, 1.85, 1.70, belt=1.05, bonnet=0.23, boot=0.02, roof=0.82),  # sport utility
    CarShape(4.8, 1.90, 1.95, belt=1.10, bonnet=0.16, boot=0.01, roof=0.88),  # van
    CarShape(5.2, 1.88, 1.80, belt=1.05, bonnet=0.22, boot=0.33, roof=0.70),  # pickup
    CarShape(3.6, 1.65, 1.50, belt=0.92, bonnet=0.18, boot=0.02, roof=0.75),  # city car
)
_SHAPE_SHARES = np.array([0.27, 0.20, 0.18, 0.14, 0.10, 0.03, 0.08])


def car(rng: np.random.Generator) -> Mesh:
    """Return a car of a random shape, size and paint."""
    shape = CAR_SHAPES[rng.choice(len(CAR_SHAPES), p=_SHAPE_SHARES)]
    half = shape.length / 2
    cabin = shape.length * (1 - shape.bonnet - shape.boot)
    rear = -half + shape.length * shape.boot  # x of the cabin's rear end
    paint = Surface.LIGHT_PAINT if rng.random() < 0.45 else Surface.DARK_PAINT

    # The cabin: windows on all sides, narrower towards the roof, which lies further back.
    window_height = shape.height - shape.belt - 0.06
    shift = cabin * (1 - shape.roof) * rng.uniform(-0.35, 0.0)
    window_size = (cabin, shape.width * 0.94, window_height)
    window_base = (rear + cabin / 2, 0, shape.belt)
    windows = box(window_size, window_base, top=(shape.roof, 0.84), shift=shift)
    roof_size = (cabin * shape.roof, shape.width * 0.80, 0.07)
    roof_base = (rear + cabin / 2 + shift, 0, shape.belt + window_height)
    roof = box(roof_size, roof_base, top=(0.9, 0.9))

    body = prism(_lower_body(shape), shape.width, shape.width * 0.95)
    pillars = _pillars(shape, rear, cabin)
    plates = copies(box((0.04, 0.5, 0.11)), x=[-(half + 0.01), half + 0.01], z=0.5)

    mesh = join(
        [
            part([body, roof, *pillars], paint, Label.CAR),
            part([windows], Surface.GLASS, Label.CAR),
            part([plates], Surface.PLATE, Label.CAR),
            _wheels(Label.CAR, shape.length, shape.width, 0.32, (-0.31, 0.31)),
        ]
    )
    return _scaled(mesh, rng.uniform(0.94, 1.06))


def _lower_body(shape: CarShape) -> list[tuple[float, float]]:
    """Return the side view of a car below the windows."""
    half = shape.length / 2
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


def _pillars(shape: CarShape, rear: float, cabin: float) -> list[np.ndarray]:
    """Return the pillars of a cabin: three on each side, leaning towards its middle."""
    pillars = []
    for share in (0.03, 0.5, 0.97):
        bottom_x = rear + cabin * share
        top_x = rear + cabin * (0.5 + (share - 0.5) * shape.roof)
        for side in (-1, 1):
            bottom = (bottom_x, side * shape.width * 0.46, shape.belt)
            top = (top_x, side * shape.width * 0.39, shape.height - 0.06)
            pillars.append(tube(bottom, top, 0.05))

    return pillars


def _wheels(
    label: Label, length: float, width: float, radius: float, axles: tuple[float, ...]
) -> Mesh:
    """Return two wheels per axle; `axles` are their x as shares of the length."""
    wheels = []
    for axle in axles:
        for side in (-1, 1):
            inside = (axle * length, side * (width / 2 - 0.2), radius)
            outside = (axle * length, side * (width / 2 + 0.01), radius)
            wheels.append(tube(inside, outside, radius))

    return part(wheels, Surface.RUBBER, label)


def _scaled(mesh: Mesh, factor: float) -> Mesh:
    return replace(mesh, triangles=mesh.triangles * np.float32(factor))


def truck(rng: np.random.Generator) -> Mesh:
    """Return a truck: a cab, then a box or an open bed."""
    length = rng.uniform(6, 11)
    width = rng.uniform(2.2, 2.5)
    height = rng.uniform(2.7, 3.7)
    nose = length / 2

    cab = box((2.0, width, 1.7), (nose - 1.0, 0, 0.6), top=(0.9, 0.95), shift=-0.1)
    windscreen = box((0.05, width * 0.85, 0.8), (nose - 0.05, 0, 1.4))
    load_height = height - 1.0 if rng.random() < 0.75 else rng.uniform(0.5, 1.0)
    load = box((length - 2.3, width, load_height), (-1.15, 0, 1.0))
    frame = box((length - 0.5, width * 0.5, 0.4), (-0.2, 0, 0.6))

    paint = Surface.LIGHT_PAINT if rng.random() < 0.7 else Surface.DARK_PAINT
    return join(
        [
            part([cab, frame], paint, Label.TRUCK),
            part([load], Surface.PLASTIC, Label.TRUCK),
            part([windscreen], Surface.GLASS, Label.TRUCK),
            _wheels(Label.TRUCK, length, width, 0.48, (-0.36, -0.22, 0.36)),
        ]
    )


def bus(rng: np.random.Generator) -> Mesh:
    """Return a city bus with a band of windows."""
    length = rng.uniform(9, 13)
    width = 2.5

    lower = box((length, width, 1.0), (0, 0, 0.3))
    upper = box((length, width, 0.6), (0, 0, 2.4))
    post_x = np.linspace(-length / 2 + 0.2, length / 2 - 0.2, 7)
    posts = copies(box((0.25, width, 1.1)), x=post_x, z=1.3)
    windows = box((length * 0.98, width * 0.98, 1.1), (0, 0, 1.3))

    return join(
        [
            part([lower, upper, posts], Surface.LIGHT_PAINT, Label.BUS),
            part([windows], Surface.GLASS, Label.BUS),
            _wheels(Label.BUS, length, width, 0.48, (-0.28, 0.33)),
        ]
    )


def trailer(rng: np.random.Generator) -> Mesh:
    """Return a caravan or a flat trailer, which SemanticKITTI counts as another vehicle."""
    length = rng.uniform(2.5, 5.5)
    height = rng.choice([0.6, 1.9])

    body = box((length, 2.0, height), (0, 0, 0.5), top=(0.95, 0.97))
    drawbar = tube((length / 2, 0, 0.5), (length / 2 + 1.0, 0, 0.45), 0.06)
    return join(
        [
            part([body, drawbar], Surface.LIGHT_PAINT, Label.TRAILER),
            _wheels(Label.TRAILER, length, 2.0, 0.33, (-0.05,)),
        ]
    )


def excavator(rng: np.random.Generator) -> Mesh:
    """Return an excavator on tracks, its arm raised or lowered."""
    slope = rng.uniform(-0.6, 0.6)  # of the arm, y per x
    reach = rng.uniform(2.5, 4.0)
    elbow = (1.2 + reach * 0.5, slope * reach * 0.5, rng.uniform(2.8, 4.0))
    hand_x = 1.2 + reach
    hand_y = slope * reach
    hand = (hand_x, hand_y, rng.uniform(0.3, 1.5))

    tracks = copies(box((3.4, 0.5, 0.8)), y=[-1.1, 1.1])
    body = box((2.8, 2.3, 1.0), (-0.5, 0, 0.9))
    upper_arm = tube((0.9, 0.3, 1.4), elbow, 0.22)
    lower_arm = tube(elbow, hand, 0.16)
    bucket = box((0.7, 0.9, 0.5), (hand_x, hand_y, 0.2))
    cab = box((1.4, 1.0, 1.5), (0.3, 0.6, 1.5), top=(0.9, 0.9))

    painted = [tracks, body, upper_arm, lower_arm, bucket]
    return join(
        [
            part(painted, Surface.LIGHT_PAINT, Label.CONSTRUCTION_VEHICLE),
            part([cab], Surface.GLASS, Label.CONSTRUCTION_VEHICLE),
        ]
    )


def _human(
    rng: np.random.Generator, label: Label, hip: Vector, feet: tuple[Vector, Vector], lean: float
) -> Mesh:
    """Return a human with hip and feet at given places; `lean` moves the shoulders forward."""
    hip_x, _, hip_z = hip
    shoulder_x = hip_x + lean
    shoulder_z = hip_z + 0.55
    hand_x = hip_x + (rng.uniform(-0.1, 0.3) + lean)

    torso = tube((hip_x, 0, hip_z - 0.05), (shoulder_x, 0.0, shoulder_z), 0.17, 0.21)
    head = tube((shoulder_x, 0, shoulder_z), (shoulder_x + 0.05, 0, shoulder_z + 0.32), 0.10, 0.09)

    legs = []
    arms = []
    for side, foot in zip((-1, 1), feet, strict=True):
        legs.append(tube((hip_x, 0.09 * side, hip_z), foot, 0.09, 0.06))
        shoulder = (shoulder_x, 0.23 * side, shoulder_z - 0.05)
        hand = (hand_x, 0.28 * side, hip_z + 0.05)
        arms.append(tube(shoulder, hand, 0.055))

    clothed = part([torso, *legs, *arms], Surface.CLOTH, label)
    return join([clothed, part([head], Surface.SKIN, label)])


def person(rng: np.random.Generator) -> Mesh:
    """Return an adult or a child who stands or walks."""
    stride = rng.uniform(0, 0.35)
    feet = ((stride, -0.1, 0.0), (-stride, 0.1, 0.0))
    human = _human(rng, Label.PERSON, (0, 0, 0.88), feet, rng.uniform(-0.02, 0.08))

    is_adult = rng.random() < 0.88
    scale = rng.uniform(0.95, 1.1) if is_adult else rng.uniform(0.6, 0.9)
    return _scaled(human, scale)


def _two_wheeler(label: Label, radius: float, rim: float, wheelbase: float) -> list[Mesh]:
    """Return wheels, frame and handlebar; `rim` is the thickness of the wheels."""
    front = wheelbase / 2
    rear = -wheelbase / 2

    tyres = []
    for x in (front, rear):
        for y in (-0.02, 0.02):
            tyres.append(hoop(radius, rim, (x, y, radius)))

    frame = [
        tube((rear, 0, radius), (-0.1, 0, 0.85), 0.03, sides=5),
        tube((-0.1, 0, 0.85), (front - 0.12, 0, 0.82), 0.03, sides=5),
        tube((0, 0, 0.35), (front - 0.12, 0, 0.80), 0.03, sides=5),
        tube((front, 0, radius), (front - 0.15, 0, 1.02), 0.03, sides=5),
        tube((front - 0.15, -0.28, 1.02), (front - 0.15, 0.28, 1.02), 0.025, sides=5),
        box((0.25, 0.14, 0.07), (-0.15, 0, 0.88)),
    ]
    return [part(tyres, Surface.RUBBER, label), part(frame, Surface.METAL, label)]


def bicycle(rng: np.random.Generator, label: Label = Label.BICYCLE) -> Mesh:
    """Return a bicycle, sometimes with a basket."""
    pieces = _two_wheeler(label, radius=0.34, rim=0.06, wheelbase=1.05)

    if rng.random() < 0.4:
        basket = box((0.3, 0.3, 0.25), (0.55, 0, 0.8))
        pieces.append(part([basket], Surface.METAL, label))
    return join(pieces)


def motorcycle(rng: np.random.Generator, label: Label = Label.MOTORCYCLE) -> Mesh:
    """Return a motorcycle or a scooter."""
    tank = box((0.6, 0.32, 0.4), (0.1, 0, 0.5), top=(0.8, 0.7))
    tail = box((rng.uniform(0.6, 0.8), 0.26, 0.22), (-0.4, 0, 0.62))
    shield = box((0.08, 0.4, 0.45), (0.55, 0, 0.8), top=(1, 0.7), shift=-0.1)

    pieces = _two_wheeler(label, radius=0.31, rim=0.16, wheelbase=1.35)
    pieces.append(part([tank, tail, shield], Surface.LIGHT_PAINT, label))
    return join(pieces)


def bicyclist(rng: np.random.Generator) -> Mesh:
    """Return a bicycle and its rider, both of one class."""
    feet = ((0.1, -0.12, 0.2), (0.05, 0.12, 0.5))
    rider = _human(rng, Label.BICYCLIST, (-0.15, 0, 0.98), feet, rng.uniform(0.1, 0.4))
    return join([bicycle(rng, Label.BICYCLIST), rider])


def motorcyclist(rng: np.random.Generator) -> Mesh:
    """Return a motorcycle and its rider, both of one class."""
    feet = ((0.15, -0.2, 0.3), (0.15, 0.2, 0.3))
    rider = _human(rng, Label.MOTORCYCLIST, (-0.25, 0, 0.85), feet, rng.uniform(0.15, 0.35))
    return join([motorcycle(rng, Label.MOTORCYCLIST), rider])
