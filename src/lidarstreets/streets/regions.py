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


_TABLE = read_table(Path(__file__).with_suffix(".toml"))
REGIONS = {name: Region(**row) for name, row in _TABLE.items()}
