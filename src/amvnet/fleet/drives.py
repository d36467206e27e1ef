"""What is measured of the sensor of a drive: once, for all workers and later runs."""

from __future__ import annotations

import dataclasses
import json
from typing import Any

import numpy as np
import pyarrow as pa

from amvnet.sensors.frame import Frame
from amvnet.sensors.lasers import SensorGeometry
from amvnet.sensors.measure import Estimate

SCHEMA = pa.schema(
    {
        "drive": pa.string(),
        "assumed": pa.string(),
        "height": pa.float64(),  # metres over the ground
        "pitch": pa.float64(),  # degrees that turn the scans level
        "roll": pa.float64(),
        "estimates": pa.string(),  # JSON
    }
)


def describe_drive(drive: str, assumed: str, usual: Estimate | None) -> dict[str, Any]:
    """Return the row of a drive.

    Args:
        assumed: a line about the first scan.
        usual: measured of the first scans; None if these could not be read, or are of several
            sensors.
    """
    frame = Frame() if usual is None else usual.frame
    values = None if usual is None else dataclasses.asdict(usual)
    return {
        "drive": drive,
        "assumed": assumed,
        "height": frame.height,
        "pitch": frame.pitch,
        "roll": frame.roll,
        "estimates": json.dumps(values, default=np.ndarray.tolist),  # keeps all digits
    }


def parse_estimate(text: str) -> Estimate | None:
    """Return the estimate in a row of a drive."""
    values = json.loads(text)
    if values is None:
        return None
    quantiles = values["quantiles"]
    values["frame"] = Frame(**values["frame"])
    values["lasers"] = SensorGeometry(**values["lasers"])
    values["quantiles"] = None if quantiles is None else np.array(quantiles)
    return Estimate(**values)
