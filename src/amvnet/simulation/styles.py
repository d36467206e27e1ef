"""What sets one street apart from another: the kinds of streets, and one street drawn from them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Style:
    """What sets one street apart from another; lengths in metres, pairs are (right, left) of the road."""

    # One of residential, urban, rural, fast.
    kind: str
    # Width of the carriageway.
    road: float
    # Width of the lane of parked cars on either side; 0 is none.
    parking: tuple[float, float]
    # Width of the strip of grass between kerb and sidewalk.
    verge: tuple[float, float]
    # Width of the sidewalk; 0 is none.
    sidewalk: tuple[float, float]
    # Height of the kerb.
    kerb: float
    # Rise of the ground beside the street per metre, from the sidewalk outwards.
    bank: tuple[float, float]
    # Chances, per plot, of house, contiguous houses, wood, open field, car park.
    plots: tuple[float, float, float, float, float]
    # Smallest and largest distance of a house from its plot's front.
    setback: tuple[float, float]
    # Smallest and largest height of walls.
    storeys: tuple[float, float]
    # Chance that a place in the parking lane is taken.
    parked: float
    # Distance between trees along the street; infinite is none.
    trees: float
    # Chance of a hedge, wall or fence before a plot.
    fenced: float
    # Driving cars per 100 m of lane.
    traffic: float
    # People and cyclists per 100 m of street.
    people: float
    # Scale of plants in gardens.
    green: float
    # Distance between lamps or utility poles.
    lamps: float
    # True where lanes are painted.
    painted: bool


@dataclass(frozen=True)
class Kind:
    """What the streets of one kind have in common; `draw_style` shakes it."""

    # Share of all streets.
    share: float
    # Smallest and largest width of the carriageway.
    road: tuple[float, float]
    # Chances, on either side, of a parking lane, a verge, a sidewalk.
    parking: float
    verge: float
    sidewalk: float
    # The others are as in `Style`.
    plots: tuple[float, float, float, float, float]
    setback: tuple[float, float]
    storeys: tuple[float, float]
    parked: float
    trees: float
    fenced: float
    traffic: float
    people: float
    green: float
    # Chance that lanes are painted.
    painted: float


KINDS = {
    "residential": Kind(
        share=0.46,
        road=(5.5, 8.5),
        parking=0.30,
        verge=0.35,
        sidewalk=0.95,
        plots=(0.54, 0.20, 0.15, 0.09, 0.02),
        setback=(2, 9),
        storeys=(3.0, 7.0),
        parked=0.45,
        trees=17.0,
        fenced=0.9,
        traffic=0.5,
        people=1.6,
        green=1.5,
        painted=0.3,
    ),
    "urban": Kind(
        share=0.24,
        road=(7.0, 11.0),
        parking=0.42,
        verge=0.15,
        sidewalk=1.0,
        plots=(0.2, 0.60, 0.11, 0.06, 0.03),
        setback=(0, 3),
        storeys=(6.0, 16.0),
        parked=0.6,
        trees=17.0,
        fenced=0.45,
        traffic=0.9,
        people=4.0,
        green=1.0,
        painted=0.8,
    ),
    "rural": Kind(
        share=0.20,
        road=(5.5, 8.0),
        parking=0.0,
        verge=0.7,
        sidewalk=0.3,
        plots=(0.14, 0.0, 0.54, 0.31, 0.01),
        setback=(5, 15),
        storeys=(3.0, 6.0),
        parked=0.0,
        trees=24.0,
        fenced=0.45,
        traffic=0.5,
        people=0.5,
        green=1.6,
        painted=0.6,
    ),
    "fast": Kind(
        share=0.10,
        road=(9.0, 15.0),
        parking=0.0,
        verge=1.0,
        sidewalk=0.12,
        plots=(0.02, 0.0, 0.60, 0.37, 0.01),
        setback=(15, 30),
        storeys=(4.0, 9.0),
        parked=0.0,
        trees=28.0,
        fenced=0.6,
        traffic=0.9,
        people=0.1,
        green=1.5,
        painted=1.0,
    ),
}


def _pair(rng: np.random.Generator, low: float, high: float, chance: float) -> tuple[float, float]:
    """A value for each side of the road, 0 where the chance fails."""
    right, left = (
        float(rng.uniform(low, high)) if rng.random() < chance else 0.0 for _ in range(2)
    )
    return right, left


def draw_style(rng: np.random.Generator) -> Style:
    """A street of a random kind, each of its numbers shaken."""
    name = str(rng.choice(list(KINDS), p=[kind.share for kind in KINDS.values()]))
    kind = KINDS[name]
    house, row, wood, field, lot = rng.dirichlet(np.array(kind.plots) * 8 + 1e-3).tolist()
    return Style(
        kind=name,
        road=float(rng.uniform(*kind.road)),
        parking=_pair(rng, 2.0, 2.5, kind.parking),
        verge=_pair(rng, 0.8, 3.5, kind.verge),
        sidewalk=_pair(rng, 1.4, 4.0, kind.sidewalk),
        kerb=float(rng.uniform(0.04, 0.16)),
        bank=(float(rng.normal(0.02, 0.06)), float(rng.normal(0.02, 0.06))),
        plots=(house, row, wood, field, lot),
        setback=kind.setback,
        storeys=kind.storeys,
        parked=kind.parked * rng.uniform(0.3, 1.5),
        trees=kind.trees * rng.uniform(0.6, 2.0) if rng.random() < 0.6 else np.inf,
        fenced=kind.fenced * rng.uniform(0.5, 1.3),
        traffic=kind.traffic * rng.uniform(0.3, 1.7),
        people=kind.people * rng.uniform(0.2, 2.0),
        green=kind.green * rng.uniform(0.5, 1.6),
        lamps=float(rng.uniform(24, 55)),
        painted=bool(rng.random() < kind.painted),
    )
