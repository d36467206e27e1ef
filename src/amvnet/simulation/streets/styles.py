"""The kinds of streets, and the random numbers that make each street of a kind different."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from amvnet.simulation.chance import weighted_choice
from amvnet.simulation.materials import Label


@dataclass(frozen=True)
class Strip:
    """A strip of ground along a road.

    Attributes:
        width: metres.
        label: class of the ground.
        raised: True if it is as high as the kerb, False if it is level with the road.
    """

    width: float
    label: Label
    raised: bool = True


@dataclass(frozen=True)
class Bank:
    """The shape of the land on one side of a street; lengths are in metres.

    Attributes:
        slope: rise over run, from the pavement outwards.
        start: distance from the pavement at which the bank begins.
        width: distance over which it rises.
        rise: height of its top over its foot; negative if the land falls.
        ditch: depth of the ditch along the pavement.
    """

    slope: float
    start: float
    width: float
    rise: float
    ditch: float


@dataclass(frozen=True)
class Style:
    """The numbers that describe one street.

    Lengths are in metres. Pairs with one entry per side of the road are (right, left).
    """

    # A key of `KINDS`.
    kind: str
    # Width of the carriageway, the middle included.
    road: float
    # Width in the middle of the road that no lane uses; 0 if there is none.
    median: float
    # Class of the islands in the middle of the road, and whether they form one long island.
    median_label: Label
    has_long_median: bool
    # (t, direction) of each lane: its place across the street, and 1 along +x or -1 against it.
    lanes: tuple[tuple[float, int], ...]
    # Width of the lane for parking on each side; 0 if there is none.
    parking: tuple[float, float]
    # Angle in radians between parked cars and the street on each side.
    parking_angle: tuple[float, float]
    # Distance between the islands that interrupt the lanes for parking; infinite if there are none.
    parking_period: float
    # What lies between the kerb and the plots on each side, from the road outwards.
    strips: tuple[tuple[Strip, ...], tuple[Strip, ...]]
    # Height of the kerb.
    kerb: float
    # The land on each side.
    bank: tuple[Bank, Bank]
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
    # Factor on the speed of the traffic and of the sensor.
    speed: float
    # People and cyclists per 100 m of street.
    people: float
    # Factor on the number of plants in gardens.
    green: float
    # Distance between lamps or utility poles.
    lamps: float
    # True if lane markings are painted.
    painted: bool
    # Side roads per 100 m.
    junctions: float


@dataclass(frozen=True)
class Kind:
    """The typical numbers of one kind of street; `draw_style` varies them for each street."""

    # Share of all streets.
    share: float
    # Smallest and largest width of a lane, and chances of 1, 2, 3 lanes in each direction.
    lane: tuple[float, float]
    lanes: tuple[float, float, float]
    # Chances of a long median and of islands in the middle of the road.
    median: float
    islands: float
    # Chance of a parking lane on each side.
    parking: float
    # Chances of the arrangements of strips on each side; see `_draw_strips`.
    sides: dict[str, float]
    # Largest height of the banks.
    relief: float
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
    speed: float = 1.0
    junctions: float = 1.0
    one_way: float = 0.0


KINDS = {
    "residential": Kind(
        share=0.40,
        lane=(2.4, 3.9),
        lanes=(1.0, 0.0, 0.0),
        median=0.0,
        islands=0.05,
        parking=0.21,
        sides={"sidewalk": 0.74, "verge": 0.15, "cycle path": 0.04, "gravel": 0.03, "none": 0.04},
        relief=1.6,
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
        junctions=1.3,
        one_way=0.12,
    ),
    "living": Kind(
        share=0.08,
        lane=(1.9, 3.0),
        lanes=(1.0, 0.0, 0.0),
        median=0.0,
        islands=0.0,
        parking=0.3,
        sides={"sidewalk": 0.30, "verge": 0.05, "gravel": 0.20, "none": 0.45},
        relief=1.2,
        plots=(0.50, 0.30, 0.10, 0.08, 0.02),
        setback=(1, 6),
        storeys=(3.0, 8.0),
        parked=0.5,
        trees=20.0,
        fenced=0.9,
        traffic=0.2,
        people=2.5,
        green=1.4,
        painted=0.0,
        speed=0.5,
        junctions=1.2,
        one_way=0.3,
    ),
    "urban": Kind(
        share=0.20,
        lane=(3.0, 4.2),
        lanes=(0.8, 0.2, 0.0),
        median=0.05,
        islands=0.2,
        parking=0.33,
        sides={
            "sidewalk": 0.60,
            "verge": 0.15,
            "cycle path": 0.15,
            "paved verge": 0.07,
            "service road": 0.03,
        },
        relief=1.2,
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
        junctions=1.2,
        one_way=0.15,
    ),
    "avenue": Kind(
        share=0.09,
        lane=(3.0, 3.7),
        lanes=(0.4, 0.5, 0.1),
        median=0.75,
        islands=0.25,
        parking=0.28,
        sides={
            "sidewalk": 0.45,
            "verge": 0.15,
            "cycle path": 0.20,
            "paved verge": 0.05,
            "service road": 0.15,
        },
        relief=1.2,
        plots=(0.1, 0.45, 0.25, 0.15, 0.05),
        setback=(0, 8),
        storeys=(6.0, 20.0),
        parked=0.6,
        trees=15.0,
        fenced=0.5,
        traffic=1.3,
        people=2.5,
        green=1.0,
        painted=0.9,
        speed=1.3,
        junctions=0.9,
    ),
    "rural": Kind(
        share=0.13,
        lane=(2.3, 3.7),
        lanes=(1.0, 0.0, 0.0),
        median=0.0,
        islands=0.03,
        parking=0.0,
        sides={
            "soft verge": 0.40,
            "sidewalk": 0.25,
            "cycle path": 0.17,
            "gravel": 0.08,
            "none": 0.10,
        },
        relief=4.0,
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
        speed=1.5,
        junctions=0.7,
    ),
    "fast": Kind(
        share=0.04,
        lane=(3.2, 3.8),
        lanes=(0.5, 0.5, 0.0),
        median=0.3,
        islands=0.15,
        parking=0.0,
        sides={"soft verge": 0.45, "shoulder": 0.25, "cycle path": 0.15, "gravel": 0.15},
        relief=5.0,
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
        speed=2.0,
        junctions=0.4,
    ),
    "motorway": Kind(
        share=0.06,
        lane=(3.5, 3.9),
        lanes=(0.0, 0.6, 0.4),
        median=1.0,
        islands=0.0,
        parking=0.0,
        sides={"shoulder": 0.85, "soft verge": 0.15},
        relief=5.0,
        plots=(0.01, 0.0, 0.60, 0.38, 0.01),
        setback=(20, 30),
        storeys=(4.0, 9.0),
        parked=0.0,
        trees=40.0,
        fenced=0.5,
        traffic=1.4,
        people=0.0,
        green=1.5,
        painted=1.0,
        speed=2.8,
        junctions=0.35,
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

    middle = rng.random()
    has_long_median = bool(middle < kind.median)
    has_islands = bool(kind.median <= middle < kind.median + kind.islands)
    median = _draw_median(rng, has_long_median, has_islands)
    lanes, road = _draw_lanes(rng, kind, median)
    parking, angles = _draw_parking(rng, kind)
    is_flush = name == "living" or rng.random() < 0.06

    return Style(
        kind=name,
        road=road,
        median=median,
        median_label=_draw_median_label(rng, has_long_median),
        has_long_median=has_long_median,
        lanes=lanes,
        parking=parking,
        parking_angle=angles,
        parking_period=float(rng.uniform(9, 40)) if rng.random() < 0.4 else np.inf,
        strips=(_draw_strips(rng, kind.sides), _draw_strips(rng, kind.sides)),
        kerb=float(rng.uniform(0.0, 0.03) if is_flush else rng.uniform(0.03, 0.18)),
        bank=(_draw_bank(rng, kind.relief), _draw_bank(rng, kind.relief)),
        plots=(house, row, wood, field, lot),
        setback=kind.setback,
        storeys=kind.storeys,
        parked=kind.parked * rng.uniform(0.3, 1.5),
        trees=kind.trees * rng.uniform(0.6, 2.0) if rng.random() < 0.6 else np.inf,
        fenced=kind.fenced * rng.uniform(0.5, 1.3),
        traffic=kind.traffic * rng.uniform(0.3, 1.7),
        speed=kind.speed * rng.uniform(0.8, 1.2),
        people=kind.people * rng.uniform(0.2, 2.0),
        green=kind.green * rng.uniform(0.5, 1.6),
        lamps=float(rng.uniform(24, 55)),
        painted=bool(rng.random() < kind.painted),
        junctions=kind.junctions,
    )


def _draw_median(rng: np.random.Generator, is_long: bool, has_islands: bool) -> float:
    """Draw the width in the middle of the road that no lane uses."""
    if is_long:
        return float(rng.uniform(1.2, 5.0) if rng.random() < 0.8 else rng.uniform(5.0, 12.0))
    if has_islands:
        return float(rng.uniform(1.6, 3.0))

    return 0.0


def _draw_median_label(rng: np.random.Generator, is_long: bool) -> Label:
    chances = {Label.TERRAIN: 0.55, Label.OTHER_GROUND: 0.20, Label.SIDEWALK: 0.25}
    if not is_long:
        chances = {Label.TERRAIN: 0.15, Label.OTHER_GROUND: 0.55, Label.SIDEWALK: 0.30}
    return weighted_choice(rng, chances)


def _draw_lanes(
    rng: np.random.Generator, kind: Kind, median: float
) -> tuple[tuple[tuple[float, int], ...], float]:
    """Draw the lanes of a street; return them and the width of the carriageway."""
    width = rng.uniform(*kind.lane)
    count = 1 + int(rng.choice(3, p=kind.lanes))
    margin = rng.uniform(0.0, 0.6)
    half = median / 2 + count * width + margin

    is_one_way = median == 0 and rng.random() < kind.one_way
    lanes = []
    for index in range(count):
        t = median / 2 + (index + 0.5) * width
        lanes.append((-t, 1))
        lanes.append((t, 1 if is_one_way else -1))
    return tuple(lanes), float(2 * half)


def _draw_parking(
    rng: np.random.Generator, kind: Kind
) -> tuple[tuple[float, float], tuple[float, float]]:
    """Draw widths of the lanes for parking and angles of the cars on them, (right, left) each."""
    widths = []
    angles = []
    for _ in range(2):
        angle = 0.0
        width = rng.uniform(1.6, 2.6)
        if rng.random() < 0.2:
            angle = np.pi / 2 if rng.random() < 0.6 else rng.uniform(0.6, 1.2)
            width = rng.uniform(4.2, 5.4)
        has_parking = rng.random() < kind.parking
        widths.append(float(width) if has_parking else 0.0)
        angles.append(float(angle))

    return (widths[0], widths[1]), (angles[0], angles[1])


def _draw_strips(rng: np.random.Generator, sides: dict[str, float]) -> tuple[Strip, ...]:
    """Draw what lies between the kerb and the plots on one side, from the road outwards."""
    name = weighted_choice(rng, sides)
    walk = float(rng.uniform(1.4, 3.2) if rng.random() < 0.55 else rng.uniform(3.2, 6.0))
    verge = float(rng.uniform(0.5, 2.6))
    cycle_path = Strip(float(rng.uniform(1.4, 2.4)), Label.SIDEWALK)
    sidewalk = Strip(walk, Label.SIDEWALK)

    if name == "sidewalk":
        return (sidewalk,)
    if name == "verge":
        return (Strip(verge, Label.TERRAIN), sidewalk)
    if name == "paved verge":
        return (Strip(verge, Label.OTHER_GROUND), sidewalk)
    if name == "cycle path":
        between = Strip(float(rng.uniform(0.3, 2.0)), Label.TERRAIN)
        if rng.random() < 0.5:
            return (Strip(verge, Label.TERRAIN), cycle_path)
        return (Strip(verge, Label.TERRAIN), cycle_path, between, sidewalk)
    if name == "service road":
        service_road = Strip(float(rng.uniform(3.0, 5.0)), Label.ROAD, raised=False)
        return (Strip(verge + 1, Label.TERRAIN), service_road, sidewalk)
    if name == "gravel":
        return (Strip(float(rng.uniform(0.5, 2.2)), Label.OTHER_GROUND, raised=False),)
    if name == "shoulder":
        hard = Strip(float(rng.uniform(1.5, 3.2)), Label.ROAD, raised=False)
        return (hard, Strip(float(rng.uniform(0.8, 2.5)), Label.TERRAIN, raised=False))
    if name == "soft verge":
        return (Strip(verge, Label.TERRAIN, raised=False),)

    return ()


def _draw_bank(rng: np.random.Generator, relief: float) -> Bank:
    """Draw the shape of the land on one side; `relief` is the largest height of a bank."""
    rise = 0.0
    if rng.random() < 0.5:
        rise = rng.uniform(-1, 1) * relief
    # About one bank in ten is a terrace behind a low wall.
    is_terrace = rng.random() < 0.1 and abs(rise) < 1.5
    has_ditch = relief > 2 and rng.random() < 0.35

    return Bank(
        slope=float(np.clip(rng.normal(0.01, 0.05), -0.12, 0.15)),
        start=float(rng.uniform(0.2, 6.0)),
        width=0.3 if is_terrace else float(rng.uniform(2, 15)),
        rise=float(rise),
        ditch=float(rng.uniform(0.2, 1.0)) if has_ditch else 0.0,
    )
