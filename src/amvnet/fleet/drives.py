"""What is measured of the sensor of a drive: once, for all workers and later runs."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Sequence
from typing import Any

import numpy as np
import pyarrow as pa

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
    values = [dataclasses.asdict(estimate) for estimate in estimates]
    return {
        "drive": drive,
        "sensor": sensor,
        "assumed": assumed,
        "height": frame.height,
        "pitch": frame.pitch,
        "roll": frame.roll,
        "estimates": json.dumps(values, default=np.ndarray.tolist),  # keeps all digits
    }


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
