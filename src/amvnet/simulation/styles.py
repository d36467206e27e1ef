"""The kinds of streets, and the random numbers that make each street of a kind different."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from amvnet.simulation.chance import weighted_choice


@dataclass(frozen=True)
class Style:
    """The numbers that describe one street.

    Lengths are in metres. Pairs with one number per side of the road are (right, left).
    """

    # One of residential, urban, rural, fast.
    kind: str
    # Width of the carriageway.
    road: float
    # Width of the parking lane on each side; 0 if there is none.
    parking: tuple[float, float]
    # Width of the strip of grass between kerb and sidewalk on each side; 0 if there is none.
    verge: tuple[float, float]
    # Width of the sidewalk on each side; 0 if there is none.
    sidewalk: tuple[float, float]
    # Height of the kerb.
    kerb: float
    # Slope (rise over run) of the ground on each side, from the sidewalk outwards.
    bank: tuple[float, float]
    # Chances that a plot has a house, a row of houses, a wood, an open field, a car park.
    plots: tuple[float, float, float, float, float]
    # Smallest and largest distance of a house from the front of its plot.
    setback: tuple[float, float]
    # Smallest and largest height of the walls of a house.
    storeys: tuple[float, float]
    # Chance that a place in the parking lane is taken.
    parked: float
    # Distance between trees along the street; infinite if there are none.
    trees: float
    # Chance of a hedge, wall or fence along the front of a plot.
    fenced: float
    # Driving cars per 100 m of lane.
    traffic: float
    # People and cyclists per 100 m of street.
    people: float
    # Factor on the number of plants in gardens.
    green: float
    # Distance between lamps or utility poles.
    lamps: float
    # True if lane markings are painted.
    painted: bool


@dataclass(frozen=True)
class Kind:
    """The typical numbers of one kind of street; `draw_style` varies them for each street."""

    # Share of all streets.
    share: float
    # Smallest and largest width of the carriageway.
    road: tuple[float, float]
    # Chances of a parking lane, a verge and a sidewalk on each side.
    parking: float
    verge: float
    sidewalk: float
    # As in `Style`; `parked` and those after it are multiplied by random factors.
    plots: tuple[float, float, float, float, float]
    setback: tuple[float, float]
    storeys: tuple[float, float]
    parked: float
    trees: float
    fenced: float
    traffic: float
    people: float
    green: float
    # Chance that lane markings are painted.
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


def draw_style(rng: np.random.Generator) -> Style:
    """Draw a street of a random kind and vary the numbers of that kind."""
    shares = {name: kind.share for name, kind in KINDS.items()}
    name = weighted_choice(rng, shares)
    kind = KINDS[name]

    # The chances vary around those of the kind; a larger factor than 8 would make them vary less.
    # A Dirichlet distribution does not allow 0, hence the small number.
    house, row, wood, field, lot = rng.dirichlet(np.array(kind.plots) * 8 + 1e-3).tolist()

    # The order of the draws decides the street of each seed: keep it.
    return Style(
        kind=name,
        road=float(rng.uniform(*kind.road)),
        parking=_draw_widths(rng, 2.0, 2.5, kind.parking),
        verge=_draw_widths(rng, 0.8, 3.5, kind.verge),
        sidewalk=_draw_widths(rng, 1.4, 4.0, kind.sidewalk),
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


def _draw_widths(
    rng: np.random.Generator, low: float, high: float, chance: float
) -> tuple[float, float]:
    """Draw the widths of a strip (right, left), each in low..high with the chance, else 0."""
    right = _draw_width(rng, low, high, chance)
    left = _draw_width(rng, low, high, chance)
    return right, left


def _draw_width(rng: np.random.Generator, low: float, high: float, chance: float) -> float:
    if rng.random() < chance:
        return float(rng.uniform(low, high))
    return 0.0
