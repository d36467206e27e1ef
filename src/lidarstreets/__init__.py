"""Simulate LiDAR scans of procedural streets. Every label is correct.

    lidarstreets.simulate("city", sequences=10, scans=4)

`python -m lidarstreets` does the same.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from lidarstreets.course import Drive as Drive
    from lidarstreets.drive import drive_street as drive_street
    from lidarstreets.errors import SimulationError as SimulationError
    from lidarstreets.layouts import SimulatedScan as SimulatedScan
    from lidarstreets.sensing.sensors import ANY as ANY
    from lidarstreets.sensing.sensors import LIDAR_MODELS as LIDAR_MODELS
    from lidarstreets.sensing.sensors import LidarModel as LidarModel
    from lidarstreets.sensing.sensors import evenly_spaced as evenly_spaced
    from lidarstreets.writing import simulate as simulate

# The modules of the names, which are imported when they are first used: a program that reads the
# table of LiDARs needs nothing of the simulator.
_MODULES = {
    "ANY": "lidarstreets.sensing.sensors",
    "LIDAR_MODELS": "lidarstreets.sensing.sensors",
    "Drive": "lidarstreets.course",
    "LidarModel": "lidarstreets.sensing.sensors",
    "SimulatedScan": "lidarstreets.layouts",
    "SimulationError": "lidarstreets.errors",
    "drive_street": "lidarstreets.drive",
    "evenly_spaced": "lidarstreets.sensing.sensors",
    "simulate": "lidarstreets.writing",
}
__all__ = list(_MODULES)

# Hide this function from type checkers, which would otherwise accept any name of the package.
if not TYPE_CHECKING:

    def __getattr__(name: str) -> Any:
        if name not in _MODULES:
            raise AttributeError(f"module 'lidarstreets' has no attribute {name!r}")
        return getattr(import_module(_MODULES[name]), name)
