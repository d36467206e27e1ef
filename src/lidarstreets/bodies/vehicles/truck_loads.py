"""Meshes of what trucks carry."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from lidarstreets.bodies.vehicles.parts import draw_paint
from lidarstreets.materials import Label, Surface
from lidarstreets.mesh import Mesh, part
from lidarstreets.solids import box, copies, prism, tube


@dataclass(frozen=True)
class Load:
    """The space behind the cab, in metres: x of its ends, width, and z of floor and top."""

    rear: float
    front: float
    width: float
    floor: float
    top: float

    @property
    def length(self) -> float:
        return self.front - self.rear

    @property
    def middle(self) -> float:
        return (self.front + self.rear) / 2

    @property
    def height(self) -> float:
        return self.top - self.floor


def _panels(load: Load, pitch: float, rib: float) -> np.ndarray:
    """Return a box with upright ribs on its sides, `pitch` metres apart."""
    shell = box((load.length, load.width, load.height), (load.middle, 0, load.floor))
    rib_x = np.arange(load.rear + 0.05, load.front, pitch)
    ribs = copies(box((0.08, load.width + 2 * rib, load.height)), x=rib_x, z=load.floor)
    return np.concatenate([shell, ribs])


def box_load(rng: np.random.Generator, load: Load) -> list[Mesh]:
    """Return a closed box, a container or a tarpaulin over bows, perhaps with a tail lift."""
    pitch = rng.uniform(0.4, 1.6)
    surface = Surface.PLASTIC if rng.random() < 0.6 else draw_paint(rng, 0.8)
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


def flatbed(rng: np.random.Generator, load: Load) -> list[Mesh]:
    """Return an open bed with low boards, empty or with timber, pipes, crates or a machine."""
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
    pieces = [part(boards, draw_paint(rng, 0.6), Label.TRUCK)]

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


def tipper(rng: np.random.Generator, load: Load) -> list[Mesh]:
    """Return a tipper's trough with ribs, heaped with gravel or empty."""
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
        part([trough, ribs], draw_paint(rng, 0.6), Label.TRUCK),
        part([heap], Surface.GRAVEL, Label.TRUCK),
    ]


def tanker(rng: np.random.Generator, load: Load) -> list[Mesh]:
    """Return a tank lying along the truck, with a catwalk and hatches."""
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
        part([tank], Surface.METAL if rng.random() < 0.4 else Surface.LIGHT_PAINT, Label.TRUCK),
        part([hatches, ladder, saddle], Surface.METAL, Label.TRUCK),
    ]


def mixer(rng: np.random.Generator, load: Load) -> list[Mesh]:
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
        part(drum, draw_paint(rng, 0.8), Label.TRUCK),
        part(frame, Surface.METAL, Label.TRUCK),
    ]


def refuse(rng: np.random.Generator, load: Load) -> list[Mesh]:
    """Return a refuse body with a rounded tail and a hopper."""
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
        part([prism(profile, load.width), ribs], draw_paint(rng, 0.85), Label.TRUCK),
        part([prism(tail, load.width * 0.96)], draw_paint(rng, 0.6), Label.TRUCK),
    ]


def fire_engine(rng: np.random.Generator, load: Load) -> list[Mesh]:
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
        part([body], draw_paint(rng, 0.7), Label.TRUCK),
        part([shutters, rails, rungs], Surface.METAL, Label.TRUCK),
    ]


# What trucks carry, and their shares.
LOADS: dict[Callable[[np.random.Generator, Load], list[Mesh]], float] = {
    box_load: 0.52,
    flatbed: 0.15,
    tipper: 0.10,
    tanker: 0.05,
    mixer: 0.05,
    refuse: 0.08,
    fire_engine: 0.05,
}
