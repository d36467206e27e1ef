"""Make meshes of people who stand, walk, run, sit, crouch or ride."""

from dataclasses import dataclass

import numpy as np

from lidarstreets.materials import Label, Surface
from lidarstreets.mesh import Mesh, join, part, place, rolled, scaled
from lidarstreets.solids import Vector, box, copies, hoop, tube

# Lengths of the thigh, and of the shin with the shoe, of a person who is 1.75 m tall, metres.
THIGH = 0.44
SHIN = 0.46


@dataclass(frozen=True)
class Posture:
    """Where the joints of a person are who is 1.75 m tall. Lengths are in metres.

    Attributes:
        hip: x and z of the hip.
        lean: how far the shoulders are in front of the hip.
        feet: places of the right and of the left foot.
        hands: places of the right and of the left hand.
        torso: length from hip to shoulders.
    """

    hip: tuple[float, float]
    lean: float
    feet: tuple[Vector, Vector]
    hands: tuple[Vector, Vector]
    torso: float = 0.52


def figure(rng: np.random.Generator, label: Label, posture: Posture) -> Mesh:
    """Return a human body of a random build in a posture."""
    girth = rng.uniform(0.85, 1.35)
    hip_x, hip_z = posture.hip
    shoulder_x = hip_x + posture.lean
    shoulder_z = hip_z + np.sqrt(max(posture.torso**2 - posture.lean**2, 0.04))

    hip: Vector = (hip_x, 0.0, hip_z - 0.08)
    neck: Vector = (shoulder_x, 0.0, shoulder_z)
    head_top: Vector = (shoulder_x + 0.06, 0.0, shoulder_z + 0.31)
    clothed = [tube(hip, neck, 0.15 * girth, 0.19 * girth, sides=7)]
    skin = [tube((shoulder_x + 0.02, 0, shoulder_z + 0.02), head_top, 0.10, 0.09, sides=6)]

    for side, foot, hand in zip((-1, 1), posture.feet, posture.hands, strict=True):
        socket: Vector = (hip_x, 0.09 * side, hip_z)
        knee = _joint(socket, foot, THIGH + SHIN, 1.0)
        clothed.append(tube(socket, knee, 0.085 * girth, 0.065 * girth, sides=6))
        clothed.append(tube(knee, foot, 0.06 * girth, 0.045, sides=6))
        clothed.append(box((0.26, 0.1, 0.08), (foot[0] + 0.06, foot[1], foot[2])))

        shoulder: Vector = (shoulder_x, 0.2 * girth * side, shoulder_z - 0.05)
        elbow = _joint(shoulder, hand, 0.58, -1.0)
        clothed.append(tube(shoulder, elbow, 0.055 * girth, 0.045, sides=5))
        clothed.append(tube(elbow, hand, 0.045, 0.04, sides=5))

    return join(part(clothed, Surface.CLOTH, label), part(skin, Surface.SKIN, label))


def _joint(start: Vector, end: Vector, reach: float, forward: float) -> Vector:
    """Return the knee or the elbow of a limb that is `reach` metres long.

    The limb goes from `start` to `end`. The joint is in front if `forward` is 1, behind if it
    is -1.
    """
    a = np.array(start)
    b = np.array(end)
    slack = max(reach**2 - float(((b - a) ** 2).sum()), 0.0)
    middle = (a + b) / 2

    # A unit vector at a right angle to the limb, in the x-z plane.
    across = np.array([a[2] - b[2], 0.0, b[0] - a[0]])
    across /= max(float(np.linalg.norm(across)), 1e-6)
    x, y, z = middle + forward * 0.5 * np.sqrt(slack) * across
    return float(x), float(y), float(z)


def _draw_hands(rng: np.random.Generator, hip_z: float, lean: float) -> tuple[Vector, Vector]:
    """Draw hands that hang, swing, hold something in front or are raised."""
    hands = []
    swing = rng.uniform(0, 0.25)
    pose = rng.random()
    for side in (-1, 1):
        hand: Vector = (lean / 2 + side * swing, 0.27 * side, hip_z - 0.05)
        if pose < 0.2:
            hand = (lean + 0.3, 0.12 * side, hip_z + rng.uniform(0.05, 0.4))
        elif pose < 0.28 and side > 0:
            hand = (lean + rng.uniform(0.0, 0.3), 0.3, hip_z + rng.uniform(0.5, 1.0))
        hands.append(hand)
    return hands[0], hands[1]


def person(rng: np.random.Generator) -> Mesh:
    """Return an adult or a child who stands, walks, runs, bends, crouches or uses a wheelchair.

    They are between 0.9 and 2.0 m tall. Some carry, push or lead something.
    """
    size = rng.normal(1.0, 0.06) if rng.random() < 0.85 else rng.uniform(0.55, 0.9)
    size = float(np.clip(size, 0.55, 1.13))
    way = rng.random()
    if way < 0.04:
        return scaled(_wheelchair_user(rng), size)
    if way < 0.09:
        return scaled(_crouching(rng), size)

    stride = rng.uniform(0.0, 0.16) if way < 0.45 else rng.uniform(0.15, 0.38)
    lean = rng.uniform(-0.04, 0.1)
    lift = 0.0
    if way > 0.94:  # runs
        stride = rng.uniform(0.3, 0.5)
        lean = rng.uniform(0.08, 0.2)
        lift = rng.uniform(0.1, 0.4)
    hip_z = float(np.sqrt(0.9**2 - stride**2))

    feet: tuple[Vector, Vector] = ((stride, -0.1, 0.0), (-stride, 0.1, lift))
    posture = Posture((0.0, hip_z), lean, feet, _draw_hands(rng, hip_z, lean))
    mesh = join(figure(rng, Label.PERSON, posture), *_clothes(rng, hip_z), *_things(rng, hip_z))
    return scaled(mesh, size)


def _clothes(rng: np.random.Generator, hip_z: float) -> list[Mesh]:
    solids = []
    choice = rng.random()
    if choice < 0.25:
        hem = rng.uniform(0.3, 0.75)
        solids.append(tube((0, 0, hem), (0, 0, hip_z + 0.5), rng.uniform(0.2, 0.33), 0.2, sides=7))
    if rng.random() < 0.2:
        depth = rng.uniform(0.15, 0.3)
        solids.append(box((depth, 0.32, 0.45), (-0.16 - depth / 2, 0, hip_z + 0.05)))
    if rng.random() < 0.12:
        solids.append(tube((0.05, 0, hip_z + 0.78), (0.05, 0, hip_z + 0.84), 0.17, sides=7))

    return [part(solids, Surface.CLOTH, Label.PERSON)]


def _things(rng: np.random.Generator, hip_z: float) -> list[Mesh]:
    """Return what a person carries, pushes or leads; most people have nothing."""
    choice = rng.random()
    if choice < 0.10:
        bag = box((rng.uniform(0.2, 0.45), 0.15, rng.uniform(0.25, 0.45)), (0.05, 0.32, 0.35))
        return [part([bag], Surface.CLOTH, Label.PERSON)]
    if choice < 0.16:  # a pram
        bed = box((0.75, 0.45, 0.35), (0.75, 0, 0.55), top=(1.1, 1.1))
        hood = tube((0.95, 0, 0.85), (1.15, 0, 1.1), 0.26, 0.1, sides=6)
        grip = tube((0.35, 0, 1.0), (0.6, 0, 0.6), 0.03, sides=4)
        tyre = hoop(0.14, 0.05, (0, 0, 0.14), sides=8)
        tyres = copies(tyre, x=[[0.5], [1.05]], y=[-0.25, 0.25])
        return [
            part([bed, hood], Surface.CLOTH, Label.PERSON),
            part([grip, tyres], Surface.METAL, Label.PERSON),
        ]
    if choice < 0.20:  # an umbrella
        dome = tube((0.15, 0.1, hip_z + 0.85), (0.15, 0.1, hip_z + 1.15), 0.55, 0.04, sides=8)
        stick = tube((0.15, 0.1, hip_z + 0.2), (0.15, 0.1, hip_z + 0.9), 0.012, sides=4)
        return [part([dome, stick], Surface.CLOTH, Label.PERSON)]
    if choice < 0.25:  # a suitcase or a shopping trolley
        case = box((0.25, 0.38, rng.uniform(0.5, 0.75)), (-0.6, 0.2, 0.03), shift=0.1)
        return [part([case], Surface.PLASTIC, Label.PERSON)]
    if choice < 0.28:  # a rollator
        frame = copies(box((0.04, 0.04, 0.85)), x=[[0.35], [0.75]], y=[-0.28, 0.28])
        seat = box((0.3, 0.5, 0.06), (0.55, 0, 0.55))
        return [part([frame, seat], Surface.METAL, Label.PERSON)]
    if choice < 0.34:
        return [place(_dog(rng), x=rng.uniform(-0.5, 1.2), y=rng.choice([-0.7, 0.7]))]
    if choice < 0.36:  # a box
        return [part([box((0.4, 0.5, 0.35), (0.42, 0, hip_z + 0.1))], Surface.WOOD, Label.PERSON)]

    return []


def _dog(rng: np.random.Generator) -> Mesh:
    """Return a dog, which the benchmarks ignore."""
    size = rng.uniform(0.5, 1.2)
    legs = copies(box((0.07, 0.07, 0.32)), x=[[-0.25], [0.22]], y=[-0.08, 0.08])
    body = tube((-0.3, 0, 0.42), (0.3, 0, 0.45), 0.13, sides=6)
    head = tube((0.3, 0, 0.52), (0.52, 0, 0.58), 0.1, 0.06, sides=5)
    return scaled(part([legs, body, head], Surface.CLOTH, Label.OTHER_OBJECT), size)


def sitter(rng: np.random.Generator, seat: float = 0.45) -> Mesh:
    """Return a person who sits at x = 0 on a seat that is `seat` metres high."""
    stretch = rng.uniform(0.0, 0.3)
    feet: tuple[Vector, Vector] = (
        (0.42 + stretch, -0.12, 0.0),
        (0.42 + stretch * rng.uniform(0, 1), 0.12, 0.0),
    )
    hands: tuple[Vector, Vector] = ((0.3, -0.15, seat + 0.2), (0.3, 0.15, seat + 0.25))
    posture = Posture((0.0, seat + 0.08), rng.uniform(-0.15, 0.2), feet, hands)
    return scaled(figure(rng, Label.PERSON, posture), rng.uniform(0.9, 1.08))


def _crouching(rng: np.random.Generator) -> Mesh:
    hip_z = rng.uniform(0.3, 0.75)
    feet: tuple[Vector, Vector] = ((0.1, -0.15, 0.0), (-0.2, 0.15, 0.0))
    hands: tuple[Vector, Vector] = ((0.5, -0.15, 0.25), (0.5, 0.15, 0.3))
    posture = Posture((-0.1, hip_z), rng.uniform(0.15, 0.42), feet, hands)
    return figure(rng, Label.PERSON, posture)


def _wheelchair_user(rng: np.random.Generator) -> Mesh:
    tyres = copies(hoop(0.31, 0.05, (0, 0, 0.31)), y=[-0.3, 0.3])
    casters = copies(box((0.14, 0.05, 0.14)), x=0.5, y=[-0.25, 0.25])
    chair = [box((0.45, 0.46, 0.06), (0.1, 0, 0.45)), box((0.05, 0.46, 0.5), (-0.14, 0, 0.48))]
    return join(
        place(sitter(rng, 0.5), x=0.02),
        part([tyres, casters], Surface.RUBBER, Label.PERSON),
        part(chair, Surface.CLOTH, Label.PERSON),
    )


def people_group(rng: np.random.Generator) -> list[Mesh]:
    """Return two to six people who stand or walk close together around the origin."""
    count = int(rng.integers(2, 7)) if rng.random() < 0.4 else 2
    spread = rng.uniform(0.35, 0.7) * np.sqrt(count)
    walk_together = rng.random() < 0.5

    people = []
    for index in range(count):
        angle = 2 * np.pi * index / count + rng.normal(scale=0.2)
        yaw = rng.normal(scale=0.15) if walk_together else angle + np.pi + rng.normal(scale=0.5)
        x = spread * np.cos(angle)
        y = spread * np.sin(angle)
        people.append(place(person(rng), float(x), float(y), yaw=float(yaw)))
    return people


def rider(
    rng: np.random.Generator,
    label: Label,
    seat: tuple[float, float],
    grip: tuple[float, float],
    feet: tuple[Vector, Vector],
) -> Mesh:
    """Return the rider of a two-wheeler.

    Args:
        rng: draws the rider, a backpack and a helmet.
        label: class of the rider.
        seat: x and z of the saddle, metres.
        grip: x and z of the handlebar, metres.
        feet: places of the right and of the left foot, metres.
    """
    hands: tuple[Vector, Vector] = ((grip[0], -0.28, grip[1]), (grip[0], 0.28, grip[1]))
    lean = float(np.clip(rng.uniform(0.05, 0.42), 0.0, 0.45))
    posture = Posture((seat[0], seat[1] + 0.06), lean, feet, hands)
    pieces = [figure(rng, label, posture)]

    if rng.random() < 0.3:
        pack = box((0.22, 0.32, 0.42), (seat[0] + lean * 0.5 - 0.28, 0, seat[1] + 0.12))
        pieces.append(part([pack], Surface.CLOTH, label))
    if rng.random() < 0.4 or label == Label.MOTORCYCLIST:
        x = seat[0] + lean + 0.05
        z = seat[1] + 0.06 + np.sqrt(0.27 - lean**2)
        helmet = tube((x, 0, z + 0.06), (x + 0.02, 0, z + 0.36), 0.14, 0.11, sides=6)
        pieces.append(part([helmet], Surface.PLASTIC, label))
    return rolled(join(*pieces), float(rng.normal(scale=0.03)))
