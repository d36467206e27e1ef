"""Define the regions where LiDARs have driven; regions.toml has the numbers of each."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

from lidarstreets.tables import read_table


@dataclass(frozen=True)
class Region:
    """How the streets of a region differ from kinds.toml and traffic.toml, in factors."""

    # Factors on the shares of the kinds of streets.
    kinds: Mapping[str, float] = field(default_factory=dict)
    # Factors on the chances of the arrangements of strips along a road.
    sides: Mapping[str, float] = field(default_factory=dict)
    # Factors on the shares of the kinds of vehicles.
    vehicles: Mapping[str, float] = field(default_factory=dict)
    # Factor on the number of driving vehicles.
    traffic: float = 1.0
    # Factor on the number of work zones.
    work_zones: float = 1.0
    # Factor on the heights of houses.
    storeys: float = 1.0
    # Factor on the widths of lanes.
    lanes: float = 1.0
    # Factor on the chance of a parking lane.
    parking: float = 1.0
    # Factor on the slopes of streets.
    slopes: float = 1.0
    # Factor on the distances of houses from the front of their plots.
    setback: float = 1.0
    # Factor on the chance that utility poles stand along a street instead of lamps.
    wires: float = 1.0
    # Share of the trees along streets and in gardens that are palms.
    palms: float = 0.0


_TABLE = read_table(Path(__file__).with_suffix(".toml"))
REGIONS = {name: Region(**row) for name, row in _TABLE.items()}
