"""The segmenter that takes the built-in weights which suit the lasers of its first scan."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from amvnet.data.datasets.files import ScanFiles
from amvnet.data.formats.cloud import Cloud
from amvnet.data.recordings import Recording, ScanFile
from amvnet.errors import InputError
from amvnet.inference.listing import Inputs, ScanOptions
from amvnet.inference.reading import Reading, array_cloud
from amvnet.inference.segmenter import Segmenter
from amvnet.progress import Reporter
from amvnet.scan import AnyArray, Scan
from amvnet.sensors.built_in import weights_for
from amvnet.sensors.lasers import SensorGeometry
from amvnet.sensors.lidars import Sensor

CHOSEN = ("weights", "engine", "at_once")  # what a segmenter lacks until its weights are chosen


def choose_by(cloud: Cloud, sensor: Sensor) -> tuple[str, str]:
    """Return the name of built-in weights for a scan in memory, and why, as `Inputs` does."""
    recording = Recording("scan")
    recording.scans.append(ScanFile("scan", recording, Path("scan"), read=lambda: cloud))
    inputs = Inputs([ScanFiles(recording.scans)], ScanOptions(reading=Reading(sensor)))
    return inputs.choose_weights()


class ChoosingSegmenter(Segmenter):
    """Segments scans with the built-in weights that suit the lasers of the first scan.

    Args:
        make: returns the segmenter with the weights of a name.
        reading: as `Segmenter` takes it.
        report: called with a line that says which weights are chosen, and why.
    """

    def __init__(
        self, make: Callable[[str], Segmenter], reading: Reading, report: Reporter
    ) -> None:
        self.reading = reading
        self._make = make
        self._report = report
        self._choice = ""  # the line that is reported

    def __getattr__(self, name: str) -> Any:
        if name not in CHOSEN:
            raise AttributeError(f"{type(self).__name__!r} object has no attribute {name!r}")
        raise InputError(
            f"{name}: expected a segmented scan, whose lasers choose the weights, found none; "
            "segment one, or name weights, as "
            "amvnet.load(amvnet.list_weights()[0])"
        )

    def __repr__(self) -> str:
        if self._choice:
            return super().__repr__()
        return "<Segmenter with built-in weights by the lasers of the first scan>"

    def _list(self, inputs: Inputs) -> list[ScanFile]:
        if not self._choice:
            self._take(*inputs.choose_weights())
        return super()._list(inputs)

    def _read_array(
        self, points: AnyArray | Scan, columns: str | Sequence[str] | None = None
    ) -> Scan:
        if not self._choice:
            if isinstance(points, Scan):
                cloud = Cloud(points.points[:, :3], points.points[:, 3], points.ring)
            else:
                cloud = array_cloud(points, self.reading.by(columns).layout)
            self._take(*self._choose_by(cloud))
        return super()._read_array(points, columns)

    def _choose_by(self, cloud: Cloud) -> tuple[str, str]:
        """Return the name of the weights for points in memory, and in words why these.

        Unless the sensor is described, such points are not normalised: without rings, the networks
        would not know the lasers.
        """
        if cloud.ring is None and not self.reading.sensor.is_known:
            return weights_for(SensorGeometry())
        return choose_by(cloud, self.reading.sensor)

    def _take(self, name: str, reason: str) -> None:
        """Take the weights of a name."""
        made = self._make(name)
        self.weights = made.weights
        self.engine = made.engine
        self.at_once = made.at_once
        self._choice = f"weights {name}, {reason}"
        self._report(self._choice)
