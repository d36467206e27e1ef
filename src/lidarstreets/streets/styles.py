"""Draw the numbers that describe one street."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from lidarstreets.chance import scaled, weighted_choice
from lidarstreets.materials import Label
from lidarstreets.streets.kinds import STREET_KINDS, Kind, Surroundings
from lidarstreets.streets.regions import Region


@dataclass(frozen=True)
class Strip:
    """A strip of ground along a road.

    Attributes:
        width: width, metres.
        label: class of the ground.
        raised: True if it is as high as the kerb, False if it is level with the road.
    """

    width: float
    label: Label
    raised: bool = True


def width_of(strips: Sequence[Strip]) -> float:
    """Return the total width of strips, metres."""
    return sum(strip.width for strip in strips)


@dataclass(frozen=True)
class Bank:
    """The shape of the land on one side of a street; lengths are in metres.

    Attributes:
        slope: slope from the pavement outwards, rise over run.
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
class Style(Surroundings):
    """The numbers that describe one street.

    Lengths are in metres. Pairs with one entry for each side of the road are (right, left).
    """

    # Kind of street, a key of `STREET_KINDS`.
    kind: str
    # The region of the street.
    region: Region
    # Width of the carriageway, with the median.
    road: float
    # Width of the median, the middle of the road that no lane uses; 0 if there is none.
    median: float
    # Class of the islands in the middle of the road.
    median_label: Label
    # Whether these islands form one long island.
    has_long_median: bool
    # t across the street of each lane, and its direction: 1 along +x, -1 against it.
    lanes: tuple[tuple[float, int], ...]
    # Width of the parking lane on each side; 0 if there is none.
    parking: tuple[float, float]
    # Whether the parking lane is a bus bay or a turning lane, where nobody parks.
    is_bus_bay: tuple[bool, bool]
    # Angle in radians between parked cars and the street on each side.
    parking_angle: tuple[float, float]
    # Distance between the islands that interrupt the parking lanes; infinite if there are none.
    parking_period: float
    # Strips between the kerb and the plots on each side, from the road outwards.
    strips: tuple[tuple[Strip, ...], tuple[Strip, ...]]
    # Height of the kerb.
    kerb: float
    # Shape of the land on each side.
    bank: tuple[Bank, Bank]
    # Distance between lamps or utility poles.
    lamps: float
    # Whether lane markings are painted.
    painted: bool


def draw_style(rng: np.random.Generator, region: Region) -> Style:
    """Draw a kind of street of a region, and vary its typical numbers."""
    shares = {name: kind.share for name, kind in STREET_KINDS.items()}
    name = weighted_choice(rng, scaled(shares, region.kinds))
    kind = STREET_KINDS[name]
    sides = scaled(kind.sides, region.sides)
    lowest, highest = kind.storeys

    # The chances vary around the chances of the kind. A factor above 8 would make them vary less.
    # The small number is there because a Dirichlet distribution does not allow 0.
    house, row, wood, field, lot = rng.dirichlet(np.array(kind.plots) * 8 + 1e-3).tolist()

    middle = rng.random()
    has_long_median = bool(middle < kind.median)
    has_islands = bool(kind.median <= middle < kind.median + kind.islands)
    median = _draw_median(rng, has_long_median, has_islands)
    lanes, road = _draw_lanes(rng, kind, median, region.lanes)
    parking, angles, is_bus_bay = _draw_parking(rng, kind, kind.parking * region.parking)
    is_flush = name == "living" or rng.random() < 0.06

    return Style(
        kind=name,
        region=region,
        road=road,
        median=median,
        median_label=_draw_median_label(rng, has_long_median),
        has_long_median=has_long_median,
        lanes=lanes,
        parking=parking,
        is_bus_bay=is_bus_bay,
        parking_angle=angles,
        parking_period=float(rng.uniform(9, 40)) if rng.random() < 0.4 else np.inf,
        strips=(_draw_strips(rng, sides), _draw_strips(rng, sides)),
        kerb=float(rng.uniform(0.0, 0.03) if is_flush else rng.uniform(0.03, 0.18)),
        bank=(_draw_bank(rng, kind.relief), _draw_bank(rng, kind.relief)),
        plots=(house, row, wood, field, lot),
        setback=(kind.setback[0] * region.setback, kind.setback[1] * region.setback),
        storeys=(lowest * region.storeys, highest * region.storeys),
        parked=kind.parked * rng.uniform(0.3, 1.5),
        trees=kind.trees * rng.uniform(0.6, 2.0) if rng.random() < 0.6 else np.inf,
        fenced=kind.fenced * rng.uniform(0.5, 1.3),
        traffic=region.traffic * kind.traffic * rng.uniform(0.3, 1.7),
        speed=kind.speed * rng.uniform(0.8, 1.2),
        people=kind.people * rng.uniform(0.2, 2.0),
        green=kind.green * rng.uniform(0.5, 1.6),
        lamps=float(rng.uniform(24, 55)),
        painted=bool(rng.random() < kind.painted),
        junctions=kind.junctions,
    )


def _draw_median(rng: np.random.Generator, is_long: bool, has_islands: bool) -> float:
    """Draw the width of the median, metres; 0 if there is none."""
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
    rng: np.random.Generator, kind: Kind, median: float, factor: float
) -> tuple[tuple[tuple[float, int], ...], float]:
    """Draw the lanes of a street as in `Style`, and the width of the carriageway in metres.

    The width of a lane is `factor` times the width that is usual for the kind of street.
    """
    width = rng.uniform(*kind.lane) * factor
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
    rng: np.random.Generator, kind: Kind, chance: float
) -> tuple[tuple[float, float], tuple[float, float], tuple[bool, bool]]:
    """Draw `parking`, `parking_angle` and `is_bus_bay` of a `Style`.

    `chance` is the chance of a parking lane on each side.
    """
    widths = []
    angles = []
    bays = []
    for _ in range(2):
        angle = 0.0
        width = rng.uniform(1.6, 2.6)
        if rng.random() < 0.2:
            angle = np.pi / 2 if rng.random() < 0.6 else rng.uniform(0.6, 1.2)
            width = rng.uniform(4.2, 5.4)
        has_parking = rng.random() < chance
        is_bay = not has_parking and rng.random() < kind.bus_bays
        if is_bay:
            width = rng.uniform(2.6, 3.8)
        widths.append(float(width) if has_parking or is_bay else 0.0)
        angles.append(float(angle))
        bays.append(bool(is_bay))

    return (widths[0], widths[1]), (angles[0], angles[1]), (bays[0], bays[1])


def _draw_strips(rng: np.random.Generator, sides: dict[str, float]) -> tuple[Strip, ...]:
    """Draw the strips between the kerb and the plots on one side, from the road outwards."""
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
