"""Simulated LiDAR scans of procedural streets, labelled without a mistake."""

from amvnet.simulation.drive import Drive, SimulatedScan, drive_street, simulate, simulate_scan
from amvnet.simulation.lidar import SENSORS, Sensor

__all__ = ["SENSORS", "Drive", "Sensor", "SimulatedScan", "drive_street", "simulate", "simulate_scan"]
