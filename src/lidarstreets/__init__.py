"""Simulated LiDAR scans of procedural streets, labelled without a mistake.

    lidarstreets.simulate("city", sequences=10, scans=4)

`python -m lidarstreets` does the same.
"""

from lidarstreets.course import Drive
from lidarstreets.drive import drive_street
from lidarstreets.errors import SimulationError
from lidarstreets.layouts import SimulatedScan
from lidarstreets.sensing.sensors import SENSORS, LidarModel
from lidarstreets.writing import simulate

__all__ = [
    "SENSORS",
    "Drive",
    "LidarModel",
    "SimulatedScan",
    "SimulationError",
    "drive_street",
    "simulate",
]
