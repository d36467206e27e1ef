"""A user's own scans (data/datasets/own.py), adapted as scan files are."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from amvnet.data.datasets.own import OwnScans
from amvnet.data.formats.cloud import Cloud
from amvnet.errors import InputError
from amvnet.scan import Scan
from amvnet.sensors.adapt import MEASURED, ScanAdapter
from amvnet.sensors.intensity import KEY as INTENSITY
from amvnet.sensors.lidars import Sensor, make_sensor, sensor_from
from amvnet.sensors.plain import PlainAdapter
from amvnet.sensors.record import KEY as SENSOR

MEASURED_RECORDINGS = 20  # whose sensor is measured for the weights


@dataclass(frozen=True)
class FirstMeasured:
    """Adapts scans in any order; the first ones of each recording are measured for all.

    Attributes:
        adapter: adapts the scans.
        first: by recording, functions that read its first scans.
    """

    adapter: ScanAdapter | PlainAdapter
    first: Mapping[str, Sequence[Callable[[], Cloud]]]

    def __call__(self, cloud: Cloud, source: str) -> Scan:
        self.adapter.learn(source, self.first[source])
        return self.adapter(cloud, source)

    def learn(self, most: int) -> ScanAdapter | PlainAdapter:
        """Measure some recordings; return the adapter."""
        for source in list(self.first)[:most]:
            self.adapter.learn(source, self.first[source])
        return self.adapter


def training_record(dataset: OwnScans) -> dict[str, Any]:
    """Return what weights that are trained on adapted scans carry of their sensor.

    With it, other scans are adapted as these.
    """
    if not isinstance(dataset.adapt, FirstMeasured):
        return {}
    adapter = dataset.adapt.learn(MEASURED_RECORDINGS)
    if not isinstance(adapter, ScanAdapter):
        return {}
    record: dict[str, Any] = {SENSOR: adapter.target()}
    if adapter.trained_intensity is not None:
        record[INTENSITY] = list(adapter.trained_intensity.quantiles)
    return record


def adapted_by(dataset: OwnScans, adapter: ScanAdapter | PlainAdapter) -> OwnScans:
    """Return the dataset with scans that are adapted as those of its folders would be.

    Args:
        dataset: the scans. What its file says of the sensor counts, unless the adapter knows more.
        adapter: as for scan files.

    Raises:
        InputError: if the file describes an impossible sensor.
    """
    if dataset.description.sensor is not None and adapter.sensor == Sensor():
        adapter = adapter.for_sensor(_described_sensor(dataset))

    first = {}
    for source, scans in dataset.recordings().items():
        first[source] = [scan.read for scan in scans[:MEASURED]]
    return dataclasses.replace(
        dataset,
        adapt=FirstMeasured(adapter, first),
        is_adapted=isinstance(adapter, ScanAdapter),
    )


def _described_sensor(dataset: OwnScans) -> Sensor:
    """Return what the file of a dataset says of the sensor."""
    sensor = dataset.description.sensor
    try:
        return sensor_from(sensor) if isinstance(sensor, Mapping) else make_sensor(sensor)
    except InputError as error:
        raise InputError(f"{dataset.spec}: sensor: {error}") from None
