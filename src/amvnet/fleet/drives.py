"""What is measured of the sensor of a drive: once, for all workers and later runs."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Mapping, Sequence
from io import BytesIO
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet
from pyarrow.fs import FileType

from amvnet.fleet.storage import Place, reaching
from amvnet.sensors.frame import Frame
from amvnet.sensors.lasers import SensorGeometry
from amvnet.sensors.measure import Estimate

SCHEMA = pa.schema(
    {
        "drive": pa.string(),
        "sensor": pa.string(),  # its name in a manifest
        "assumed": pa.string(),
        "height": pa.float64(),  # metres over the ground
        "pitch": pa.float64(),  # degrees that turn the scans level
        "roll": pa.float64(),
        "estimates": pa.string(),  # JSON
    }
)


class Drives:
    """The table of drives of a fleet, `drives.parquet`.

    Args:
        place: its file, which need not exist.

    Raises:
        InputError: if the file cannot be read.
    """

    def __init__(self, place: Place) -> None:
        self._place = place
        self._rows: dict[str, Mapping[str, Any]] = {}
        if place.kind() == FileType.File:
            with reaching(place.url):
                table = pa.parquet.read_table(BytesIO(place.read()), schema=SCHEMA)
            self._rows = {row["drive"]: row for row in table.to_pylist()}

    def __contains__(self, drive: str) -> bool:
        return drive in self._rows

    def __getitem__(self, drive: str) -> Mapping[str, Any]:
        return self._rows[drive]

    def add(self, rows: Sequence[Mapping[str, Any]]) -> None:
        """Add drives, and write the table.

        Args:
            rows: as `describe_drive` returns them.
        """
        if not rows:
            return
        self._rows |= {row["drive"]: row for row in rows}
        buffer = BytesIO()
        pa.parquet.write_table(pa.Table.from_pylist(list(self._rows.values()), SCHEMA), buffer)
        self._place.write(buffer.getvalue())


def describe_drive(
    drive: str, sensor: str, assumed: str, estimates: Sequence[Estimate]
) -> dict[str, Any]:
    """Return the row of a drive.

    Args:
        sensor: its name in a manifest; empty if unknown.
        assumed: a line about the first scan.
        estimates: one for each sensor of the first scans, the usual one first; none if these could
            not be read.
    """
    frame = estimates[0].frame if estimates else Frame(height=None)
    texts = [_to_json(estimate) for estimate in estimates]
    return {
        "drive": drive,
        "sensor": sensor,
        "assumed": assumed,
        "height": frame.height,
        "pitch": frame.pitch,
        "roll": frame.roll,
        "estimates": json.dumps(texts),
    }


def _to_json(estimate: Estimate) -> dict[str, Any]:
    """Return an estimate as values of JSON, which keeps all digits of its numbers."""
    values = dataclasses.asdict(estimate)
    values["quantiles"] = None if estimate.quantiles is None else estimate.quantiles.tolist()
    return values


def parse_estimates(text: str) -> list[Estimate]:
    """Return the estimates in a row of a drive."""
    estimates = []
    for values in json.loads(text):
        quantiles = values["quantiles"]
        values["frame"] = Frame(**values["frame"])
        values["lasers"] = SensorGeometry(**values["lasers"])
        values["quantiles"] = None if quantiles is None else np.array(quantiles)
        estimates.append(Estimate(**values))
    return estimates
