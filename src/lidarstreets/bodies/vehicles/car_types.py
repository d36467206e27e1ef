"""The proportions of cars of all types."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

Range = tuple[float, float]


@dataclass(frozen=True)
class CarType:
    """The proportions that the cars of one type lie between; lengths are in metres."""

    # Share of all cars.
    share: float
    length: Range
    width: Range
    height: Range
    # Height of the lower edge of the side windows, as a share of the height.
    belt: Range
    # Shares of the length that are the bonnet, and the boot or the bed of a pickup.
    bonnet: Range
    boot: Range
    # Slants of windscreen and tail: metres backwards or forwards per metre of height.
    windscreen: Range
    tail: Range


CAR_TYPES = {
    "hatchback": CarType(
        share=0.24,
        length=(3.6, 4.4),
        width=(1.62, 1.82),
        height=(1.38, 1.56),
        belt=(0.60, 0.66),
        bonnet=(0.19, 0.27),
        boot=(0.0, 0.04),
        windscreen=(0.9, 1.7),
        tail=(0.2, 0.8),
    ),
    "saloon": CarType(
        share=0.17,
        length=(4.2, 5.1),
        width=(1.68, 1.92),
        height=(1.36, 1.50),
        belt=(0.60, 0.66),
        bonnet=(0.22, 0.29),
        boot=(0.11, 0.19),
        windscreen=(1.1, 1.9),
        tail=(0.8, 2.0),
    ),
    "estate": CarType(
        share=0.15,
        length=(4.3, 5.0),
        width=(1.70, 1.90),
        height=(1.40, 1.55),
        belt=(0.60, 0.66),
        bonnet=(0.21, 0.28),
        boot=(0.0, 0.03),
        windscreen=(1.0, 1.8),
        tail=(0.2, 0.7),
    ),
    "sport utility": CarType(
        share=0.13,
        length=(4.0, 5.0),
        width=(1.75, 2.00),
        height=(1.58, 1.90),
        belt=(0.58, 0.66),
        bonnet=(0.19, 0.27),
        boot=(0.0, 0.03),
        windscreen=(0.6, 1.3),
        tail=(0.1, 0.5),
    ),
    "people carrier": CarType(
        share=0.11,
        length=(4.0, 5.0),
        width=(1.70, 1.95),
        height=(1.60, 1.98),
        belt=(0.52, 0.62),
        bonnet=(0.12, 0.20),
        boot=(0.0, 0.02),
        windscreen=(0.8, 1.5),
        tail=(0.05, 0.4),
    ),
    "city car": CarType(
        share=0.08,
        length=(2.6, 3.6),
        width=(1.50, 1.70),
        height=(1.42, 1.60),
        belt=(0.56, 0.64),
        bonnet=(0.12, 0.20),
        boot=(0.0, 0.03),
        windscreen=(0.7, 1.3),
        tail=(0.1, 0.5),
    ),
    "coupe": CarType(
        share=0.05,
        length=(3.9, 4.8),
        width=(1.68, 1.95),
        height=(1.20, 1.38),
        belt=(0.62, 0.70),
        bonnet=(0.25, 0.34),
        boot=(0.05, 0.15),
        windscreen=(1.5, 2.2),
        tail=(1.2, 2.6),
    ),
    "pickup": CarType(
        share=0.02,
        length=(4.8, 5.5),
        width=(1.75, 2.00),
        height=(1.65, 1.95),
        belt=(0.56, 0.62),
        bonnet=(0.19, 0.25),
        boot=(0.28, 0.36),
        windscreen=(0.7, 1.3),
        tail=(0.05, 0.2),
    ),
}


@dataclass(frozen=True)
class CarShape:
    """The proportions of one car, as in `CarType`; all lengths are in metres."""

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
        return self.length / 2

    @property
    def front(self) -> float:
        """x of the foot of the windscreen."""
        return self.half - self.bonnet

    @property
    def rear(self) -> float:
        """x of the foot of the rear window."""
        return -self.half + self.boot + 0.04

    @property
    def roof(self) -> Range:
        """x of the rear and of the front end of the roof."""
        rise = self.height - self.belt
        front = self.front - rise * self.windscreen
        rear = self.rear + rise * self.tail

        shortest = 0.25 * (self.front - self.rear)
        if front - rear < shortest:
            middle = (front + rear) / 2
            return middle - shortest / 2, middle + shortest / 2
        return rear, front


def draw_shape(rng: np.random.Generator, kind: CarType) -> CarShape:
    """Draw a car between the proportions of a type; one in five lies a little outside."""

    def draw(limits: Range) -> float:
        low, high = limits
        margin = 0.15 * (high - low) if rng.random() < 0.2 else 0.0
        return float(max(rng.uniform(low - margin, high + margin), 0.0))

    length = draw(kind.length)
    height = draw(kind.height)

    return CarShape(
        length=length,
        width=draw(kind.width),
        height=height,
        belt=height * draw(kind.belt),
        bonnet=length * draw(kind.bonnet),
        boot=length * draw(kind.boot),
        windscreen=draw(kind.windscreen),
        tail=draw(kind.tail),
    )
