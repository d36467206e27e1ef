"""Simulate LiDAR scans of procedural streets. Every label is correct.

    lidarstreets.simulate("city", sequences=10, scans=4)

`python -m lidarstreets` does the same.
"""

from lidarstreets.course import Drive
from lidarstreets.drive import drive_street
from lidarstreets.errors import SimulationError
from lidarstreets.layouts import SimulatedScan
from lidarstreets.sensing.sensors import LIDAR_MODELS, LidarModel
from lidarstreets.writing import simulate

__all__ = [
    "LIDAR_MODELS",
    "Drive",
    "LidarModel",
    "SimulatedScan",
    "SimulationError",
    "drive_street",
    "simulate",
]
