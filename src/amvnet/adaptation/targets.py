"""The scans to adapt to: read once without labels, adapted to the weights, and kept."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from amvnet.adaptation.kept_scans import KeptScans
from amvnet.adaptation.sensor import sensor_to_simulate
from amvnet.data.datasets.simulated import SCANS, train_labels
from amvnet.data.formats.cloud import Cloud
from amvnet.data.spacing import evenly_spaced
from amvnet.data.taxonomy import NUSCENES, SEMANTICKITTI, Taxonomy
from amvnet.errors import InputError
from amvnet.inference.inputs import FileScan, InputScan
from amvnet.progress import Progress, no_progress
from amvnet.scan import Scan
from amvnet.sensors.adapt import ScanAdapter
from amvnet.sensors.measure import SensorGeometry, measure
from amvnet.simulation import LidarModel, SimulatedScan, drive_street
from amvnet.weights.file import Weights

MEASURED = 5  # scans, to find the directions that the sensor does not see
SEED = 65  # other streets than those of `amvnet simulate` and of the simulated datasets


@dataclass(frozen=True)
class Targets:
    """The scans to adapt to.

    Attributes:
        scans: of the inputs, those that are used.
        kept: the same, adapted to the weights, without labels.
        weights: to begin with.
    """

    scans: Sequence[InputScan]
    kept: KeptScans
    weights: Weights

    def read(self, step: Progress = no_progress) -> None:
        """Read the scans that have not been kept yet; their labels are never read."""
        for index, scan in enumerate(self.scans):
            if not self.kept.path(index).is_file():
                self.kept.keep(index, scan.load(labels=False).scan)
            step(index + 1, len(self.scans))

    def sensor(self) -> LidarModel:
        """Return the LiDAR to simulate.

        Raises:
            InputError: if its simulation has other classes than the weights.
        """
        usual = simulated_sensor(self.weights.taxonomy)
        some = [self.kept.read(record) for record in evenly_spaced(self.kept.records(), MEASURED)]
        return sensor_to_simulate(self._geometry(some[0]), some, usual)

    def _geometry(self, kept: Scan) -> SensorGeometry:
        """Return the geometry of the sensor, as its first scans were measured.

        Args:
            kept: the first scan, adapted to the weights.
        """
        scan = self.scans[0]
        if not isinstance(scan, FileScan):
            valid = kept.valid
            return measure(kept.points[valid], None if kept.ring is None else kept.ring[valid])

        adapter = scan.reader.adapter
        assert isinstance(adapter, ScanAdapter)
        scan.load()  # after an interruption nothing has been measured yet
        return adapter.geometry(scan.scan.source)


def are_adapted(scans: Sequence[InputScan]) -> bool:
    """Return whether scans are from files, and so adapted to the weights.

    Raises:
        InputError: if only some are.
    """
    kinds = {scan.is_adapted for scan in scans}
    if len(kinds) > 1:
        raise InputError("expected either datasets or scan files, found both; adapt to one of them")
    return kinds.pop()


def simulated_sensor(taxonomy: Taxonomy) -> str:
    """Return the name of the simulated sensor with some classes.

    Raises:
        InputError: if there is none.
    """
    for name, known in (("hdl64e", SEMANTICKITTI), ("hdl32e", NUSCENES)):
        if taxonomy.classes == known.classes:
            return name
    raise InputError(
        f"expected the classes of semantickitti or nuscenes to simulate scans with, found those of "
        f"{taxonomy.name}; use weights with these classes"
    )


def simulate_streets(
    sensor: LidarModel,
    streets: int,
    kept: KeptScans,
    adapter: ScanAdapter | None,
    step: Progress = no_progress,
) -> None:
    """Simulate the streets that have not been kept yet, with labels.

    Args:
        sensor: the LiDAR.
        streets: how many; each has `SCANS` scans.
        kept: receives the scans.
        adapter: adapts scans to the weights as those of files; None keeps them as they are.
    """
    for street in range(streets):
        first = street * SCANS
        if not all(kept.path(first + index).is_file() for index in range(SCANS)):
            seed = np.random.SeedSequence((SEED, street))
            for index, simulated in enumerate(drive_street(sensor, SCANS, seed)):
                kept.keep(first + index, _to_scan(simulated, kept.taxonomy, adapter, street))
        step((street + 1) * SCANS, streets * SCANS)


def _to_scan(
    simulated: SimulatedScan, taxonomy: Taxonomy, adapter: ScanAdapter | None, street: int
) -> Scan:
    """Return a simulated scan as the networks take it.

    Args:
        street: number of the street; each has a device of its own.
    """
    labels = train_labels(simulated.labels, taxonomy)
    ring = simulated.ring.astype(np.int64)
    points = simulated.points.astype(np.float32)
    if adapter is None:
        return Scan(points, labels, ring)

    cloud = Cloud(points[:, :3], points[:, 3], ring, "simulated", full=1.0)
    adapted = adapter(cloud, f"street {street}")
    return Scan(adapted.points, labels, adapted.ring)
