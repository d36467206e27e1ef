"""Define the kinds of streets; kinds.toml has the typical numbers of each."""

from dataclasses import dataclass
from pathlib import Path

from lidarstreets.tables import read_table


@dataclass(frozen=True)
class Surroundings:
    """What lies along a street and moves in it, in numbers. Lengths are in metres."""

    # Chances that a plot has a house, a row of houses, a wood, open land or a paved yard.
    plots: tuple[float, float, float, float, float]
    # Smallest and largest distance of a house from the front of its plot.
    setback: tuple[float, float]
    # Smallest and largest height of the walls of a house.
    storeys: tuple[float, float]
    # Chance that a place in the parking lane is taken.
    parked: float
    # Distance between trees along the street; infinite if there are none.
    trees: float
    # Factor on the chances of hedges, walls and fences around a plot.
    fenced: float
    # Mean number of driving vehicles per 90 m of the free length of a lane.
    traffic: float
    # Factor on the speed of the traffic and of the sensor.
    speed: float
    # Mean number of people and cyclists per 100 m of street.
    people: float
    # Factor on the number of plants in gardens.
    green: float
    # Density of junctions: on average, there is one every 92 / `junctions` metres.
    junctions: float


@dataclass(frozen=True)
class Kind(Surroundings):
    """The typical numbers of one kind of street; `draw_style` varies them for each street."""

    # Share of this kind in all streets.
    share: float
    # Smallest and largest width of a lane.
    lane: tuple[float, float]
    # Chances of 1, 2 and 3 lanes in each direction.
    lanes: tuple[float, float, float]
    # Chance of one long island in the middle of the road.
    median: float
    # Chance of short islands in the middle of the road.
    islands: float
    # Chance of a parking lane on each side.
    parking: float
    # Chance of a bus bay or a turning lane on a side without a parking lane.
    bus_bays: float
    # Chances of the arrangements of strips on each side, which `_draw_strips` in styles.py names.
    sides: dict[str, float]
    # Largest height of the banks.
    relief: float
    # Chance that lane markings are painted.
    painted: float
    # Chance that all lanes have one direction.
    one_way: float = 0.0


_TABLE = read_table(Path(__file__).with_suffix(".toml"))
STREET_KINDS = {name: Kind(**row) for name, row in _TABLE.items()}
