"""Make meshes of cars and vans."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from lidarstreets.bodies.vehicles.parts import draw_paint, glass, plates_and_lamps, wheels
from lidarstreets.chance import weighted_choice
from lidarstreets.materials import Label, Surface
from lidarstreets.mesh import Mesh, join, part
from lidarstreets.solids import box, copies, prism, tube, turned
from lidarstreets.tables import read_table

Range = tuple[float, float]

VAN_SHARE = 0.09  # share of vans among all cars
CONVERTIBLE_SHARE = 0.09  # share of convertibles among the cars of the `OPEN_TYPES`
OPEN_TYPES = ("coupe", "city car", "saloon")  # types of cars that may be convertibles

CAR_TYPES = read_table(Path(__file__).with_suffix(".toml"))
TYPE_SHARES = {name: limits["share"] for name, limits in CAR_TYPES.items()}


@dataclass(frozen=True)
class CarShape:
    """The proportions of one car, in metres. `windscreen` and `tail` are slants, as in cars.toml.

    `belt` is the height of the lower edge of the side windows; `bonnet` and `boot` are lengths.
    """

    length: float
    width: float
    height: float
    belt: float
    bonnet: float
    boot: float
    windscreen: float
    tail: float

    @property
    def half(self) -> float:
        """Half of the length, metres."""
        return self.length / 2

    @property
    def front(self) -> float:
        """Position of the foot of the windscreen along x, metres."""
        return self.half - self.bonnet

    @property
    def rear(self) -> float:
        """Position of the foot of the rear window along x, metres."""
        return -self.half + self.boot + 0.04

    @property
    def roof(self) -> tuple[float, float]:
        """Positions of the rear and the front end of the roof along x, metres."""
        rise = self.height - self.belt
        front = self.front - rise * self.windscreen
        rear = self.rear + rise * self.tail

        shortest = 0.25 * (self.front - self.rear)
        if front - rear < shortest:
            middle = (front + rear) / 2
            return middle - shortest / 2, middle + shortest / 2
        return rear, front


def draw_shape(rng: np.random.Generator, limits: dict[str, Range]) -> CarShape:
    """Draw the proportions of a car of one type.

    Each proportion lies between the type's `limits`, or in one of five draws a little outside.
    """

    def draw(proportion: str) -> float:
        low, high = limits[proportion]
        margin = 0.15 * (high - low) if rng.random() < 0.2 else 0.0
        return float(max(rng.uniform(low - margin, high + margin), 0.0))

    length = draw("length")
    height = draw("height")

    return CarShape(
        length=length,
        width=draw("width"),
        height=height,
        belt=height * draw("belt"),
        bonnet=length * draw("bonnet"),
        boot=length * draw("boot"),
        windscreen=draw("windscreen"),
        tail=draw("tail"),
    )


def car(rng: np.random.Generator) -> Mesh:
    """Return a car or a van of a random shape, size and paint."""
    if rng.random() < VAN_SHARE:
        return van(rng)

    name = weighted_choice(rng, TYPE_SHARES)
    shape = draw_shape(rng, CAR_TYPES[name])
    paint = draw_paint(rng, 0.45)
    is_open = name in OPEN_TYPES and rng.random() < CONVERTIBLE_SHARE

    painted = [_lower_body(rng, shape), *_mirrors(shape)]
    pieces = _seats(rng, shape)
    if is_open:
        screen_foot = (shape.front - 0.2, 0, shape.belt)
        screen = box((0.05, shape.width * 0.8, 0.4), screen_foot, shift=-0.3)
        pieces.append(glass([screen], Label.CAR, clear=True))
    else:
        is_clear = bool(rng.random() < 0.55)
        pieces.append(glass([_cabin(shape)], Label.CAR, is_clear))
        painted += [_roof(rng, shape), *_pillars(shape)]
        pieces += _roof_load(rng, shape)

    plate_z = rng.uniform(0.35, 0.75)
    lamp_z = shape.belt - rng.uniform(0.15, 0.3)
    radius = rng.uniform(0.28, 0.37) * min(shape.height / 1.45, 1.15)
    axles = (
        -shape.half + shape.length * rng.uniform(0.15, 0.22),
        shape.half * rng.uniform(0.6, 0.7),
    )
    pieces += [
        part(painted, paint, Label.CAR),
        plates_and_lamps(Label.CAR, shape.half, shape.width, plate_z, lamp_z),
        wheels(Label.CAR, axles, shape.width, radius),
    ]
    return join(*pieces)


def _lower_body(rng: np.random.Generator, shape: CarShape) -> np.ndarray:
    """Return the triangles of a car's body below its windows."""
    half = shape.half
    nose = shape.belt - rng.uniform(0.12, 0.32)
    floor = rng.uniform(0.17, 0.30)
    overhang = rng.uniform(0.03, 0.15)

    profile = [
        (-half + overhang, floor + 0.05), (half - overhang, floor), (half, 0.5),
        (half - rng.uniform(0.05, 0.2), nose), (shape.front, shape.belt),
        (shape.rear - 0.02, shape.belt),
        (-half + rng.uniform(0.0, 0.12), shape.belt - rng.uniform(0.0, 0.08)), (-half, 0.55),
    ]  # fmt: skip
    return prism(profile, shape.width, shape.width * rng.uniform(0.88, 0.97))


def _cabin(shape: CarShape) -> np.ndarray:
    roof_rear, roof_front = shape.roof
    foot = shape.belt + 0.01
    top = shape.height - 0.07
    profile = [(shape.rear, foot), (shape.front, foot), (roof_front, top), (roof_rear, top)]
    return prism(profile, shape.width * 0.92, shape.width * 0.76)


def _roof(rng: np.random.Generator, shape: CarShape) -> np.ndarray:
    rear, front = shape.roof
    low = shape.height - 0.06
    middle = rear + (front - rear) * rng.uniform(0.4, 0.7)
    profile = [(rear, low - 0.02), (front, low - 0.02), (middle, shape.height), (rear + 0.05, low)]
    return prism(profile, shape.width * 0.78, shape.width * 0.68)


def _pillars(shape: CarShape) -> list[np.ndarray]:
    roof_rear, roof_front = shape.roof
    pillars = []
    for share in (0.03, 0.5, 0.97):
        bottom_x = shape.rear + (shape.front - shape.rear) * share
        top_x = roof_rear + (roof_front - roof_rear) * share
        for side in (-1, 1):
            bottom = (bottom_x, side * shape.width * 0.46, shape.belt)
            top = (top_x, side * shape.width * 0.38, shape.height - 0.05)
            pillars.append(tube(bottom, top, 0.05, sides=4))
    return pillars


def _mirrors(shape: CarShape) -> list[np.ndarray]:
    mirror = box((0.12, 0.18, 0.14))
    side = shape.width / 2 + 0.06
    return [copies(mirror, x=shape.front - 0.35, y=[-side, side], z=shape.belt - 0.02)]


def _seats(rng: np.random.Generator, shape: CarShape) -> list[Mesh]:
    x = shape.rear + (shape.front - shape.rear) * np.array([[0.12], [0.48]])
    side = shape.width * 0.22
    backs = copies(box((0.16, 0.48, 0.5), shift=-0.1), x=x, y=[-side, side], z=shape.belt - 0.25)
    seats = [part([backs], Surface.CLOTH, Label.CAR)]

    if rng.random() < 0.3:
        head = tube((0, 0, 0), (0.02, 0, 0.26), 0.1, sides=5)
        head_x = shape.rear + (shape.front - shape.rear) * 0.5 + 0.1
        seats.append(part([copies(head, x=head_x, y=side, z=shape.belt)], Surface.SKIN, Label.CAR))
    return seats


def _roof_load(rng: np.random.Generator, shape: CarShape) -> list[Mesh]:
    rear, front = shape.roof
    length = front - rear
    load = rng.random()
    if load < 0.15:
        side = shape.width * 0.32
        rail = box((length * 0.9, 0.04, 0.05), ((rear + front) / 2, 0, shape.height))
        return [part([copies(rail, y=[-side, side])], Surface.METAL, Label.CAR)]
    if load < 0.19:
        size = (min(length * 1.1, 2.1), 0.75, 0.36)
        roof_box = box(size, ((rear + front) / 2, 0, shape.height + 0.05), top=(0.85, 0.85))
        return [part([roof_box], Surface.PLASTIC, Label.CAR)]

    return []


def van(rng: np.random.Generator) -> Mesh:
    """Return a delivery van or a minibus of up to 3.5 t, which counts as a car."""
    length = rng.uniform(4.3, 6.2)
    width = rng.uniform(1.75, 2.1)
    height = rng.uniform(1.8, 2.2) if rng.random() < 0.65 else rng.uniform(2.2, 2.75)
    belt = rng.uniform(1.0, 1.25)
    half = length / 2
    front = half - rng.uniform(0.5, 0.95)
    roof_front = front - (height - belt) * rng.uniform(0.4, 0.9)
    door = roof_front - 0.9

    lower = [
        (-half, 0.3), (half - 0.1, 0.25), (half, 0.6), (half - 0.1, belt - 0.25), (front, belt),
        (-half, belt),
    ]  # fmt: skip
    cab = [
        (door, belt + 0.01), (front, belt + 0.01), (roof_front, height - 0.08),
        (door, height - 0.08),
    ]  # fmt: skip
    roof = box((roof_front + half, width * 0.9, 0.09), ((roof_front - half) / 2, 0, height - 0.08))
    mirror_y = [-width / 2 - 0.1, width / 2 + 0.1]
    mirrors = copies(box((0.14, 0.22, 0.3)), x=front - 0.3, y=mirror_y, z=belt)
    painted = [prism(lower, width), roof, mirrors]

    # Behind the doors, a van has windows or metal.
    rest = box(
        (door + half, width * 0.97, height - belt - 0.08),
        ((door - half) / 2, 0, belt),
        top=(1, 0.92),
    )
    seats = box((0.2, width * 0.8, 0.8), (door + 0.1, 0, belt - 0.1))
    has_windows = rng.random() < 0.4
    pieces = [
        glass([prism(cab, width * 0.95, width * 0.86)], Label.CAR, bool(rng.random() < 0.6)),
        part([seats], Surface.CLOTH, Label.CAR),
    ]
    if has_windows:
        posts = np.linspace(-half + 0.1, door, 4)
        painted.append(
            copies(box((0.16, width * 0.97, height - belt), top=(1, 0.92)), x=posts, z=belt)
        )
        pieces.append(glass([rest], Label.CAR, bool(rng.random() < 0.4)))
    else:
        painted.append(rest)

    if rng.random() < 0.12:
        rack = box((length * 0.5, 0.35, 0.05), (-0.3, 0.2, height + 0.12))
        pieces.append(part([rack], Surface.METAL, Label.CAR))

    pieces += [
        part(painted, draw_paint(rng, 0.7), Label.CAR),
        plates_and_lamps(Label.CAR, half, width, rng.uniform(0.4, 0.8), belt - 0.3),
        wheels(Label.CAR, (-half * 0.62, half * 0.64), width, rng.uniform(0.31, 0.37)),
    ]
    return join(*pieces)


def open_door(rng: np.random.Generator) -> Mesh:
    """Return the open front door on the left of a car whose middle is at x = 0."""
    leaf = turned(box((1.05, 0.08, 0.62), (-0.52, 0, 0.35)), -rng.uniform(0.5, 1.2))
    return part([leaf + np.array([0.85, 0.86, 0.0])], draw_paint(rng, 0.5), Label.CAR)
