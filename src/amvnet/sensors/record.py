"""Find out for which sensor weights were trained, from their training records or its name."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Iterator, Mapping
from typing import Any

import numpy as np

from amvnet.data.datasets.own import OwnScans
from amvnet.errors import InputError
from amvnet.scan import Scan
from amvnet.sensors.ground import MIN_DISTANCE
from amvnet.sensors.intensity import QUANTILES_KEY, network_records
from amvnet.sensors.lasers import MEASURES, SensorGeometry, elevations, measure
from amvnet.sensors.lidars import KNOWN_HEIGHTS, KNOWN_SENSORS, Sensor
from amvnet.sensors.normalise import Normaliser

SENSOR_KEY = "sensor"  # key of the sensor in a part's training record
AS_IS_KEY = "as_is"  # key in the sensor's record: whether the training's scans were not normalised
MAX_MEASURED_RECORDINGS = 20  # largest number of a user's recordings that are measured
MAX_MEASURE = 1e6  # limit of every measure of a sensor


def trained_sensor(training: Mapping[str, Any], name: str) -> Sensor:
    """Return the sensor that weights were trained for; unknown values are None.

    Args:
        training: the training records of the weights by part.
        name: the name of the sensor in the weights. Its data sheet gives the values that no record
            has.
    """
    known = dataclasses.replace(
        KNOWN_SENSORS.get(name, Sensor(name)), height=KNOWN_HEIGHTS.get(name)
    )
    for record in _sensor_records(training):
        known = _with_measures(known, record)
    return known


def is_trained_as_is(training: Mapping[str, Any]) -> bool:
    """Return whether a network was trained on scans that were not normalised."""
    return any(record.get(AS_IS_KEY) is True for record in _sensor_records(training))


def _sensor_records(training: Mapping[str, Any]) -> Iterator[Mapping[str, Any]]:
    """Yield what the networks' training records say about the sensor."""
    for _, record in network_records(training):
        if isinstance(record.get(SENSOR_KEY), Mapping):
            yield record[SENSOR_KEY]


def _with_measures(sensor: Sensor, record: Mapping[str, Any]) -> Sensor:
    """Return the sensor with the measures of a record, if these are possible."""
    measures: dict[str, Any] = {}
    for key in MEASURES:
        value = record.get(key)
        if not isinstance(value, int | float) or isinstance(value, bool):
            continue
        if abs(value) < MAX_MEASURE:  # also false for NaN
            measures[key] = round(value) if key == "beams" else float(value)

    measured = SensorGeometry(fov_up=measures.get("fov_up"), fov_down=measures.get("fov_down"))
    sheet = SensorGeometry(fov_up=sensor.fov_up, fov_down=sensor.fov_down)
    if measures and not measured.has_ends_of(sheet):
        measures.setdefault("beams", None)  # it is not the sensor of the data sheet

    try:
        return dataclasses.replace(sensor, **measures)
    except InputError:  # a stranger's file may hold any numbers
        return sensor


def measure_sensor(scans: Iterable[Scan]) -> dict[str, float]:
    """Return the medians of the sensor's measures in some scans, which the weights will carry.

    If the scans have rings, the field of view ends at the highest and at the lowest laser.

    Returns:
        The known values of a `SensorGeometry` by name, in its units.
    """
    measured = []
    for scan in scans:
        points = scan.points[scan.valid, :3].astype(np.float64)
        ring = None if scan.ring is None else scan.ring[scan.valid]
        if len(points):
            measured.append(_with_laser_ends(measure(points, ring), points, ring))

    known = SensorGeometry.median(measured).known()
    return {key: round(value, 3) for key, value in known.items()}


def _with_laser_ends(
    geometry: SensorGeometry, points: np.ndarray, ring: np.ndarray | None
) -> SensorGeometry:
    """Return the geometry whose field of view ends at the highest and the lowest laser.

    A laser's elevation is the median over its points.
    """
    if ring is None or geometry.fov_up is None:
        return geometry
    # Sensors report lost returns as points near the origin, at any elevation.
    is_distant = np.hypot(points[:, 0], points[:, 1]) > MIN_DISTANCE
    elevation = elevations(points[is_distant])
    ring = ring[is_distant]

    ends = [float(np.median(elevation[ring == laser])) for laser in (ring.min(), ring.max())]
    if min(ends) == max(ends):
        return geometry
    return dataclasses.replace(geometry, fov_up=max(ends), fov_down=min(ends))


def normalised_record(dataset: OwnScans) -> dict[str, Any]:
    """Return the entries of a training record that describe the sensor of normalised scans.

    With these entries, the weights normalise other scans in the same way.
    """
    normaliser = dataset.normalise
    if not isinstance(normaliser, Normaliser) or normaliser.expected is None:
        return {}
    for source in list(dataset.recordings())[:MAX_MEASURED_RECORDINGS]:
        normaliser.measure(source)

    record: dict[str, Any] = {SENSOR_KEY: normaliser.target()}
    if normaliser.expected.intensity is not None:
        record[QUANTILES_KEY] = list(normaliser.expected.intensity.quantiles)
    return record
