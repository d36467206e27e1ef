"""Make meshes of trucks: a chassis, a cab, and what the truck carries."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from lidarstreets.bodies.vehicles.parts import draw_paint, glass, plates_and_lamps, wheels
from lidarstreets.chance import weighted_choice
from lidarstreets.materials import Label, Surface
from lidarstreets.mesh import Mesh, join, part, with_labels
from lidarstreets.solids import box, copies, prism, tube

SEMI_TRAILER_SHARE = 0.2  # share of the trucks that have a semi-trailer


def truck(rng: np.random.Generator) -> Mesh:
    """Return a truck of any size, from a small box truck to a semi-trailer."""
    if rng.random() < SEMI_TRAILER_SHARE:
        return _semi_trailer(rng)

    length = rng.uniform(5.2, 7.0) if rng.random() < 0.45 else rng.uniform(7.0, 11.0)
    is_light = length < 7.0
    width = rng.uniform(1.95, 2.3) if is_light else rng.uniform(2.3, 2.55)
    cab_length = rng.uniform(1.5, 2.3)
    cab_height = rng.uniform(2.1, 2.6) if is_light else rng.uniform(2.5, 3.3)
    half = length / 2

    load = Load(
        rear=-half,
        front=half - cab_length - rng.uniform(0.1, 0.6),
        width=width,
        floor=rng.uniform(0.8, 1.2),
        top=rng.uniform(2.3, 3.0) if is_light else rng.uniform(2.8, 3.9),
    )
    radius = 0.38 if is_light else rng.uniform(0.45, 0.53)

    return join(
        cab(rng, half, cab_length, width * rng.uniform(0.92, 1.0), cab_height),
        _chassis(rng, length, width, load.floor, radius),
        *weighted_choice(rng, LOAD_SHARES)(rng, load),
    )


def cab(rng: np.random.Generator, nose: float, length: float, width: float, height: float) -> Mesh:
    """Return the cab of a truck whose front end is at x = `nose`; lengths are in metres."""
    floor = rng.uniform(0.35, 0.7)
    sill = floor + (height - floor) * rng.uniform(0.42, 0.55)
    rear = nose - length
    slant = rng.uniform(0.02, 0.3)

    bonnet = rng.uniform(0.3, 0.9) if rng.random() < 0.2 else 0.0
    front = nose - bonnet
    lower = [
        (rear, floor), (nose, floor), (nose, sill - 0.05), (nose - bonnet - 0.02, sill),
        (rear, sill),
    ]  # fmt: skip

    # The upper part is a box of glass between a roof, a back and two posts on each side.
    window = box(
        (front - rear - 0.04, width * 0.96, height - sill - 0.3),
        ((front + rear) / 2, 0, sill + 0.01),
        top=(1 - slant / length, 0.95),
        shift=-slant / 2,
    )
    roof_length = front - rear - slant
    roof = box(
        (roof_length, width * 0.95, 0.3), (rear + roof_length / 2, 0, height - 0.3), top=(0.9, 0.9)
    )
    back = box((0.08, width * 0.95, height - sill - 0.1), (rear + 0.04, 0, sill))
    posts = copies(
        box((0.12, 0.1, height - sill - 0.2), shift=-slant / 2),
        x=[[front - 0.1], [front - 1.0]],
        y=[-width * 0.46, width * 0.46],
        z=sill,
    )

    mirrors = copies(
        box((0.1, 0.22, 0.5)), x=front - 0.1, y=[-width / 2 - 0.18, width / 2 + 0.18], z=sill
    )
    bumper = box((0.12, width, 0.3), (nose, 0, floor - 0.08))

    seats = box((0.3, width * 0.7, 0.9), (rear + 0.4, 0, sill - 0.4))
    headlamps = copies(
        box((0.04, 0.35, 0.18)), x=nose + 0.06, y=[-width * 0.38, width * 0.38], z=floor + 0.2
    )

    # A spoiler on the roof, and two warning lights.
    painted = [prism(lower, width), roof, back, posts]
    if rng.random() < 0.25:
        size = (0.9, width * 0.85, rng.uniform(0.3, 0.7))
        painted.append(box(size, (rear + 0.5, 0, height - 0.05), top=(0.3, 0.9), shift=-0.2))
    if rng.random() < 0.15:
        painted.append(copies(box((0.2, 0.3, 0.14)), x=front - 0.6, y=[-0.5, 0.5], z=height))

    return join(
        part(painted, draw_paint(rng, 0.7), Label.TRUCK),
        glass([window], Label.TRUCK, bool(rng.random() < 0.5)),
        part([seats], Surface.CLOTH, Label.TRUCK),
        part([mirrors, bumper], Surface.PLASTIC, Label.TRUCK),
        part([headlamps], Surface.SIGN_FACE, Label.TRUCK),
    )


def _chassis(
    rng: np.random.Generator, length: float, width: float, floor: float, radius: float
) -> Mesh:
    """Return the frame, wheels, tanks and guards of a truck; pulses pass between them."""
    half = length / 2
    rails = copies(box((length - 0.3, 0.12, 0.25), (-0.1, 0, floor - 0.27)), y=[-0.4, 0.4])
    axles = [half - rng.uniform(1.0, 1.5), -half + rng.uniform(1.2, 2.0)]
    if length > 8 and rng.random() < 0.6:
        axles.append(axles[1] + 2.4 * radius + 0.1)

    metal = [rails]
    tank_x = rng.uniform(-0.5, half * 0.3)
    if rng.random() < 0.7:
        tank = box((rng.uniform(0.6, 1.3), 0.5, 0.5), (tank_x, 0, 0.42))
        metal.append(copies(tank, y=[-(width / 2 - 0.3), width / 2 - 0.3]))
    if rng.random() < 0.4:
        guard = box((length * 0.35, 0.04, 0.1), (0, 0, 0))
        metal.append(copies(guard, y=[[-width / 2], [width / 2]], z=[0.45, 0.75]))
    tail_bar = box((0.1, width * 0.9, 0.14), (-half + 0.1, 0, 0.5))
    metal.append(tail_bar)

    return join(
        part(metal, Surface.METAL, Label.TRUCK),
        wheels(Label.TRUCK, axles, width, radius, 0.3),
        plates_and_lamps(Label.TRUCK, half, width, 0.62, floor - 0.25),
    )


def _semi_trailer(rng: np.random.Generator) -> Mesh:
    """Return a tractor unit with a trailer of 10 to 13.6 m."""
    length = rng.uniform(12.0, 16.5)
    width = 2.5
    half = length / 2
    load = Load(-half, half - 2.9, width, rng.uniform(1.1, 1.3), rng.uniform(3.5, 4.0))
    maker = weighted_choice(rng, {_box_load: 0.65, _flatbed: 0.12, _tanker: 0.13, _tipper: 0.10})

    rails = copies(
        box((load.length, 0.14, 0.3), (load.middle, 0, load.floor - 0.32)), y=[-0.5, 0.5]
    )
    legs = copies(box((0.12, 0.12, 0.6)), x=half - 5.5, y=[-0.7, 0.7], z=0.45)
    unit = box((5.6, 0.9, 0.3), (half - 2.9, 0, 0.65))
    axles = [half - 1.4, half - 4.9, -half + 1.6, -half + 2.9, -half + 4.2]

    trailer = join(
        part([rails, legs], Surface.METAL, Label.TRUCK),
        wheels(Label.TRUCK, axles[2:], width, 0.5, 0.35),
        *maker(rng, load),
    )
    return join(
        cab(rng, half, rng.uniform(1.9, 2.4), width * 0.98, rng.uniform(3.0, 3.8)),
        part([unit], Surface.METAL, Label.TRUCK),
        wheels(Label.TRUCK, axles[:2], width, 0.5, 0.35),
        plates_and_lamps(Label.TRUCK, half, width, 0.6, 0.8),
        with_labels(trailer, {Label.TRUCK: Label.SEMI_TRAILER}),
    )


@dataclass(frozen=True)
class Load:
    """The space behind the cab: x of its rear and front, its width, and z of its floor and top.

    All are in metres.
    """

    rear: float
    front: float
    width: float
    floor: float
    top: float

    @property
    def length(self) -> float:
        """Length along x, metres."""
        return self.front - self.rear

    @property
    def middle(self) -> float:
        """Position of the middle along x, metres."""
        return (self.front + self.rear) / 2

    @property
    def height(self) -> float:
        """Height from the floor to the top, metres."""
        return self.top - self.floor


def _panels(load: Load, pitch: float, rib: float) -> np.ndarray:
    """Return a box with upright ribs on its sides, `pitch` metres apart."""
    shell = box((load.length, load.width, load.height), (load.middle, 0, load.floor))
    rib_x = np.arange(load.rear + 0.05, load.front, pitch)
    ribs = copies(box((0.08, load.width + 2 * rib, load.height)), x=rib_x, z=load.floor)
    return np.concatenate([shell, ribs])


def _box_load(rng: np.random.Generator, load: Load) -> list[Mesh]:
    """Return a closed box, a container or a tarpaulin over bows, perhaps with a tail lift."""
    pitch = rng.uniform(0.4, 1.6)
    surface = Surface.PLASTIC if rng.random() < 0.6 else Surface.COATING
    pieces = [part([_panels(load, pitch, rng.uniform(0.0, 0.05))], surface, Label.TRUCK)]

    details = [
        copies(box((0.05, 0.06, load.height)), x=load.rear - 0.03, y=[-0.4, 0.4], z=load.floor)
    ]
    if rng.random() < 0.3:
        details.append(box((0.1, load.width * 0.95, 1.5), (load.rear - 0.12, 0, load.floor - 0.2)))
    if rng.random() < 0.3:
        cooler = box((0.5, load.width * 0.7, 0.8), (load.front + 0.2, 0, load.top - 0.9))
        details.append(cooler)
    pieces.append(part(details, Surface.METAL, Label.TRUCK))
    return pieces


def _flatbed(rng: np.random.Generator, load: Load) -> list[Mesh]:
    """Return an open bed with low boards, empty or with crates, perhaps with a crane."""
    floor = box((load.length, load.width, 0.14), (load.middle, 0, load.floor - 0.14))
    board = rng.uniform(0.2, 0.7)
    boards = [
        floor,
        copies(
            box((load.length, 0.04, board), (load.middle, 0, load.floor)),
            y=[-load.width / 2, load.width / 2],
        ),
        box((0.06, load.width, rng.uniform(0.4, 1.3)), (load.front, 0, load.floor)),
    ]
    pieces = [part(boards, Surface.COATING, Label.TRUCK)]

    goods = []
    if rng.random() < 0.7:
        x = load.rear + 0.3
        while x < load.front - 0.8:
            length = rng.uniform(0.6, 2.5)
            size = (
                min(length, load.front - x),
                load.width * rng.uniform(0.4, 0.9),
                rng.uniform(0.3, 1.5),
            )
            goods.append(box(size, (x + size[0] / 2, 0, load.floor)))
            x += length + rng.uniform(0.1, 1.0)
        surface = Surface.WOOD if rng.random() < 0.5 else Surface.PLASTIC
        pieces.append(part(goods, surface, Label.TRUCK))
    if rng.random() < 0.25:
        elbow = (load.front - 1.2, 0.3, load.floor + 2.0)
        crane = [
            tube((load.front - 0.3, 0, load.floor), elbow, 0.15, sides=5),
            tube(elbow, (load.front - 0.6, 0.2, load.floor + 0.6), 0.12, sides=5),
        ]
        pieces.append(part(crane, Surface.LIGHT_PAINT, Label.TRUCK))
    return pieces


def _tipper(rng: np.random.Generator, load: Load) -> list[Mesh]:
    """Return the ribbed trough of a tipper, heaped with gravel."""
    height = rng.uniform(0.7, 1.6)
    trough = box(
        (load.length * 0.92, load.width * 0.8, height),
        (load.middle, 0, load.floor),
        top=(1.06, 1.2),
    )
    rib_x = np.arange(load.rear + 0.4, load.front - 0.2, 0.9)
    ribs = copies(box((0.1, load.width * 0.88, height), top=(1, 1.17)), x=rib_x, z=load.floor)
    heap = box(
        (load.length * 0.85, load.width * 0.85, rng.uniform(0.1, 0.6)),
        (load.middle, 0, load.floor + height),
        top=(0.5, 0.3),
    )

    return [
        part([trough, ribs], Surface.COATING, Label.TRUCK),
        part([heap], Surface.GRAVEL, Label.TRUCK),
    ]


def _tanker(rng: np.random.Generator, load: Load) -> list[Mesh]:
    """Return a tank that lies along the truck, with hatches and a ladder."""
    radius = min(load.width / 2, 0.55 * load.height + 0.2)
    z = load.floor + radius * 0.95
    tank = tube((load.rear + 0.2, 0, z), (load.front, 0, z), radius, sides=12)
    hatches = copies(
        tube((0, 0, 0), (0, 0, 0.2), 0.25, sides=6),
        x=np.linspace(load.rear + 0.8, load.front - 0.8, 3),
        z=z + radius,
    )
    ladder = box((0.06, 0.4, 2 * radius), (load.rear + 0.1, 0, load.floor))
    saddle = box((load.length * 0.9, 0.9, 0.3), (load.middle, 0, load.floor - 0.15))

    return [
        part([tank], Surface.METAL if rng.random() < 0.4 else Surface.COATING, Label.TRUCK),
        part([hatches, ladder, saddle], Surface.METAL, Label.TRUCK),
    ]


def _mixer(rng: np.random.Generator, load: Load) -> list[Mesh]:
    """Return the drum of a cement mixer with its hopper and chute."""
    radius = load.width * 0.46
    low = (load.front - 0.5, 0, load.floor + radius * 0.9)
    belly = (load.middle, 0, load.floor + radius)
    mouth = (load.rear + 0.4, 0, load.floor + radius * 1.7)
    drum = [
        tube(low, belly, radius * 0.6, radius, sides=10),
        tube(belly, mouth, radius, radius * 0.45, sides=10),
    ]
    frame = [
        box((0.5, 1.0, radius * 1.2), (load.rear + 0.5, 0, load.floor)),
        tube(
            (load.rear + 0.3, 0, load.floor + radius),
            (load.rear - 0.3, 0.3, load.floor),
            0.2,
            sides=5,
        ),
        box((load.length, 0.9, 0.2), (load.middle, 0, load.floor - 0.1)),
    ]

    return [
        part(drum, Surface.COATING, Label.TRUCK),
        part(frame, Surface.METAL, Label.TRUCK),
    ]


def _refuse(rng: np.random.Generator, load: Load) -> list[Mesh]:
    """Return the body of a refuse truck with a rounded tail and a hopper."""
    top = min(load.top, 3.4)
    profile = [
        (load.rear + 0.9, load.floor), (load.front, load.floor), (load.front, top - 0.1),
        (load.front - 0.5, top), (load.rear + 0.9, top),
    ]  # fmt: skip
    tail = [
        (load.rear, load.floor - 0.3), (load.rear + 0.9, load.floor - 0.3), (load.rear + 0.9, top),
        (load.rear + 0.2, top - 0.3), (load.rear - 0.1, load.floor + 0.9),
    ]  # fmt: skip
    ribs = copies(
        box((0.1, load.width + 0.08, top - load.floor)),
        x=np.arange(load.rear + 1.4, load.front, 1.1),
        z=load.floor,
    )

    return [
        part([prism(profile, load.width), ribs], Surface.COATING, Label.TRUCK),
        part([prism(tail, load.width * 0.96)], Surface.COATING, Label.TRUCK),
    ]


def _fire_engine(rng: np.random.Generator, load: Load) -> list[Mesh]:
    """Return a body with roller shutters and a ladder on the roof."""
    body = box((load.length, load.width, min(load.height, 2.2)), (load.middle, 0, load.floor - 0.3))
    shutter = box((0.9, load.width + 0.04, 1.3))
    shutters = copies(shutter, x=np.arange(load.rear + 0.7, load.front - 0.4, 1.15), z=load.floor)
    top = load.floor - 0.3 + min(load.height, 2.2)
    rails = copies(
        box((load.length * 1.1, 0.08, 0.12), (load.middle, 0, top + 0.15)), y=[-0.3, 0.3]
    )
    rungs = copies(box((0.05, 0.6, 0.05)), x=np.arange(load.rear, load.front, 0.5), z=top + 0.15)

    return [
        part([body], Surface.COATING, Label.TRUCK),
        part([shutters, rails, rungs], Surface.METAL, Label.TRUCK),
    ]


# Functions that make what trucks carry, with their shares.
LOAD_SHARES: dict[Callable[[np.random.Generator, Load], list[Mesh]], float] = {
    _box_load: 0.52,
    _flatbed: 0.15,
    _tipper: 0.10,
    _tanker: 0.05,
    _mixer: 0.05,
    _refuse: 0.08,
    _fire_engine: 0.05,
}
