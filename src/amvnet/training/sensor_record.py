"""Measure the sensor of the training scans, for the record in the weights."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from typing import Any

import numpy as np

from amvnet.data.datasets.base import Dataset, ScanRecord
from amvnet.data.datasets.own import OwnScans
from amvnet.data.spacing import evenly_spaced
from amvnet.errors import InputError
from amvnet.sensors.intensity import (
    MATCHED_KEY,
    NO_INTENSITY,
    OPTIONAL_KEY,
    QUANTILES_KEY,
    TrainedIntensity,
    are_quantiles,
    quantiles_of,
)
from amvnet.sensors.record import AS_IS_KEY, SENSOR_KEY, measure_sensor, normalised_record

# Largest number of scans that are measured; it is enough for the mean height of simulated sensors.
SAMPLED_SCANS = 60


def sensor_record(
    dataset: Dataset, records: Sequence[ScanRecord], intensity: TrainedIntensity | None = None
) -> dict[str, Any]:
    """Return the record of the sensor in the weights, measured on some of their training scans.

    It holds the measures of `sensors.record`, and the mean quantiles of the intensities at
    `sensors.intensity.PROBABILITIES`. The quantiles are empty if no scan has usable intensities.
    Broken scans are left out, because the training itself reports them.

    Args:
        dataset: the dataset that reads the scans.
        records: the training scans.
        intensity: the intensities that the network learns, or None if these are unknown.
    """
    first = dataset.members[0]
    if first.sensor_record is not None:
        keys = (SENSOR_KEY, QUANTILES_KEY, MATCHED_KEY, OPTIONAL_KEY)
        return {key: first.sensor_record[key] for key in keys if key in first.sensor_record}

    scans = []
    for sampled in evenly_spaced(records, SAMPLED_SCANS):
        with suppress(InputError):
            scans.append(dataset.read(sampled, labels=False))

    quantiles_of_scans = []
    for scan in scans:
        quantiles = quantiles_of(scan.points[scan.valid, 3])
        if quantiles is not None:
            quantiles_of_scans.append(quantiles)
    mean = np.mean(quantiles_of_scans, axis=0).round(4).tolist() if quantiles_of_scans else []
    is_known = mean == NO_INTENSITY or are_quantiles(mean)
    record: dict[str, Any] = {QUANTILES_KEY: mean if is_known else []}

    # The weights will get scans that are normalised in the same way, so record the normalisation.
    normalised = normalised_record(first) if isinstance(first, OwnScans) else {}
    record |= normalised or {SENSOR_KEY: {**measure_sensor(scans), AS_IS_KEY: True}}
    if intensity is not None:
        record[OPTIONAL_KEY] = intensity.is_optional
        if intensity.is_matched:
            record |= {QUANTILES_KEY: list(intensity.quantiles), MATCHED_KEY: True}
    return record
