"""The kinds of streets and the typical numbers of each."""

from dataclasses import dataclass
from pathlib import Path

from lidarstreets.tables import read_table


@dataclass(frozen=True)
class Surroundings:
    """The numbers of what lies along a street and moves in it; lengths are in metres."""

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
    # Side roads per 100 m.
    junctions: float


@dataclass(frozen=True)
class Kind(Surroundings):
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
    # Chance of a bus bay or a lane for turning on a side without parking lane.
    bus_bays: float
    # Chances of the arrangements of strips on each side; their names are those in
    # `_draw_strips` of `styles`.
    sides: dict[str, float]
    # Largest height of the banks.
    relief: float
    # Chance that lane markings are painted.
    painted: float
    # Chance that all lanes have one direction.
    one_way: float = 0.0


_TABLE = read_table(Path(__file__).with_suffix(".toml"))
KINDS = {name: Kind(**row) for name, row in _TABLE.items()}
