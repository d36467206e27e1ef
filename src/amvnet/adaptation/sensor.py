"""The LiDAR to simulate for some measured scans."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np

from amvnet.scan import Scan
from amvnet.sensors.lidars import SENSORS as DATA_SHEETS
from amvnet.sensors.measure import SensorGeometry
from amvnet.simulation import SENSORS, LidarModel

SAME_ANGLE = 2.0  # degrees: a sensor whose field of view differs by less is the known one
BINS = 72  # of the azimuth, in which directions without points are found
HIDDEN = 0.02  # of the points of a usual bin: emptier bins are hidden
RETURNED = 0.8  # share of a sensor's shots that come back in streets, about
STEPS = (300, 4000)  # shots of a laser per turn, fewest and most
HEIGHTS = (0.3, 4.5)  # metres: a sensor of another height was not measured well


def sensor_to_simulate(geometry: SensorGeometry, scans: Sequence[Scan], usual: str) -> LidarModel:
    """Return a simulated LiDAR with the lasers, field of view, height and density of some scans.

    What was not measured, and range, noise and intensity, are those of a known sensor. If the
    lasers are those of this sensor, it is simulated with its own elevations.

    Args:
        geometry: of the sensor, as measured.
        scans: some of its scans.
        usual: name of the known sensor, in `simulation.SENSORS`.
    """
    base = SENSORS[usual]
    height = geometry.height
    if height is not None and HEIGHTS[0] <= height <= HEIGHTS[1]:
        base = dataclasses.replace(base, height=height)
    if _is_known(geometry, usual):
        return base

    lasers = geometry.beams or len(base.elevations)
    up = geometry.fov_up if geometry.fov_up is not None else base.elevations[0]
    down = geometry.fov_down if geometry.fov_down is not None else base.elevations[-1]
    elevations = np.linspace(up, down, lasers)

    hidden = hidden_directions(scans)
    seen = 1 - sum(end - start for start, end, _, _ in hidden) / 360
    points = np.median([scan.valid.sum() for scan in scans])
    steps = points / lasers / max(seen, 0.1) / RETURNED
    return dataclasses.replace(
        base,
        elevations=tuple(elevations.tolist()),
        azimuth_steps=int(np.clip(steps, *STEPS)),
        keeps_lost_returns=False,
        shadow=hidden,
    )


def hidden_directions(scans: Sequence[Scan]) -> tuple[tuple[float, float, float, float], ...]:
    """Return the directions in which no scan has points, as `LidarModel.shadow`."""
    counts = np.zeros(BINS)
    for scan in scans:
        x, y = scan.points[scan.valid, :2].T
        azimuth = np.degrees(np.arctan2(y, x)) % 360
        counts += np.histogram(azimuth, BINS, (0, 360))[0]

    step = 360 / BINS
    usual = np.median(counts[counts > 0]) if counts.any() else 0
    areas = []
    for index in np.flatnonzero(counts < HIDDEN * usual):
        areas.append((index * step, (index + 1) * step, -90.0, 90.0))
    return tuple(areas)


def _is_known(geometry: SensorGeometry, usual: str) -> bool:
    """Return whether lasers are those of a known sensor, as far as they were measured."""
    sheet = DATA_SHEETS[usual]
    pairs = ((geometry.fov_up, sheet.fov_up), (geometry.fov_down, sheet.fov_down))
    for angle, usual_angle in pairs:
        if angle is not None and usual_angle is not None and abs(angle - usual_angle) > SAME_ANGLE:
            return False
    return geometry.beams is None or geometry.beams == sheet.beams
