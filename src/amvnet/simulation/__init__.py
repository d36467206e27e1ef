"""Simulated LiDAR scans of procedural streets, labelled without a mistake."""

from amvnet.simulation.course import Drive
from amvnet.simulation.drive import drive_street
from amvnet.simulation.layouts import SimulatedScan
from amvnet.simulation.sensing.sensors import SENSORS, LidarModel
from amvnet.simulation.writing import simulate, simulate_scan

__all__ = [
    "SENSORS",
    "Drive",
    "LidarModel",
    "SimulatedScan",
    "drive_street",
    "simulate",
    "simulate_scan",
]
