"""The kinds of streets and the typical numbers of each."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from lidarstreets.tables import read_table


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
    # Chances of the arrangements of strips on each side; their names are those in
    # `_draw_strips` of `styles`.
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


_TABLE = read_table(Path(__file__).with_suffix(".toml"))
KINDS = {name: Kind(**row) for name, row in _TABLE.items()}
