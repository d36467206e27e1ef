"""Simulated streets as a dataset, made on first use and cached."""

from __future__ import annotations

import dataclasses
import hashlib
import inspect
import os
import re
import shutil
import time
import uuid
from collections.abc import Iterator, Sequence
from contextlib import suppress
from functools import cache
from pathlib import Path

import numpy as np

from amvnet.data.datasets.base import Dataset
from amvnet.data.formats.raw import FULL_INTENSITY
from amvnet.data.labels.ids import write_array
from amvnet.data.recordings import Normalise, Recording, ScanFile, normalised_scan
from amvnet.data.taxonomy import CLASSES_BY_SENSOR, NUSCENES, SEMANTICKITTI
from amvnet.errors import InputError, one_line_errors, shown
from amvnet.files import temporary_folder
from amvnet.scan import Scan
from lidarstreets import SimulationError, drive_street
from lidarstreets import simulate as simulate_streets

SCANS = 6  # number of scans of a street
TRAIN_STREETS = {"hdl64e": 140, "hdl32e": 84}  # of other sensors: `STREET_STEP`
# Weights of these sensors take their scans unchanged. The scans of other sensors are normalised, as
# scan files are.
UNCHANGED = ("hdl64e", "hdl32e")
VAL_STREETS = 6
FIRST_VAL_STREET = 900_000  # streets with lower numbers are for training
LAST_STREET = 999_999

# From one epoch to the next, the numbers of the streets rise by this step: new streets help a
# training, more scans of the same streets do not (docs/log.md).
STREET_STEP = 1000

SEED = 64  # `amvnet simulate`, whose seed is 0 by default, makes other streets
CACHE_BYTES = 25 * 10**9
ABANDONED = 3600  # age of an unfinished street whose process must have been killed, seconds

# The simulator, with its errors as `InputError`.
simulate = one_line_errors(str, only=(SimulationError,))(simulate_streets)


class SimulatedStreets(Dataset):
    """Streets of a simulated sensor. `Dataset` documents the arguments and errors of its methods.

    A sequence is a street, named by its number: "000012". There are streets for all numbers up to
    `LAST_STREET`. On one kind of processor, a street depends only on its number. It is simulated
    when one of its scans is first read. Several processes may share the folder of the cache. If it
    exceeds `CACHE_BYTES`, the streets that were read longest ago are removed.

    Args:
        root: the folder of the cache, which is made if it does not exist.
        sensor: a name in `CLASSES_BY_SENSOR`; "any" stands for another sensor in each scan.
        normalise: as in `Dataset`; only scans of sensors that are not `UNCHANGED` are normalised.
    """

    readers = 1  # two threads would simulate the same street

    def __init__(
        self, root: Path | str, sensor: str = "hdl64e", normalise: Normalise | None = None
    ) -> None:
        super().__init__(root, CLASSES_BY_SENSOR[sensor], f"simulated-{sensor}:{root}")
        self.simulated_sensor = sensor
        self.normalise = normalise
        if sensor not in UNCHANGED:
            self.described_sensor = {"unit": "m", "axes": "x-forward", "keep_own": True}

    def parts(self) -> dict[str, tuple[str, ...]]:
        """Return the streets of "train", "val" and "all"."""
        streets = TRAIN_STREETS.get(self.simulated_sensor, STREET_STEP)
        train = tuple(map(_name, range(streets)))
        val = tuple(map(_name, range(FIRST_VAL_STREET, FIRST_VAL_STREET + VAL_STREETS)))
        return {"train": train, "val": val, "all": (*train, *val)}

    def records(self, sequences: Sequence[str]) -> list[ScanFile]:
        """Return the scans of these streets, in order."""
        records = []
        for number in sorted({self._number(sequence) for sequence in sequences}):
            recording = Recording(_name(number))
            recording.scans += [self._record(number, index, recording) for index in range(SCANS)]
            records += recording.scans
        return records

    def at_epoch(self, record: ScanFile, epoch: int) -> ScanFile:
        """Return the same scan of the epoch's street; streets to validate with do not change."""
        number = int(record.sequence)
        if number >= FIRST_VAL_STREET:
            return record

        shift = epoch * STREET_STEP
        index = int(record.path.name)
        return self._record((number + shift) % FIRST_VAL_STREET, index, record.recording)

    def normalised_by(self, normalise: Normalise) -> Dataset:
        """Return the same streets, with scans that are normalised if their sensor asks for it."""
        if self.simulated_sensor in UNCHANGED:
            return self
        return SimulatedStreets(self.root, self.simulated_sensor, normalise)

    def having_labels(self, records: Sequence[ScanFile]) -> list[ScanFile]:
        """Return all scans: labels are simulated with them."""
        return list(records)

    def raw_labels(self, record: ScanFile, count: int) -> np.ndarray:
        """Return the (N,) train ids of the points: the cache has no raw ids."""
        labels = self.read(record).labels
        assert labels is not None
        return labels

    def train_ids_by_raw(self) -> np.ndarray:
        """Return each train id as its own raw id."""
        return np.arange(self.taxonomy.size + 1, dtype=np.int16)

    def read(self, record: ScanFile, labels: bool = True) -> Scan:
        """Read one scan; simulate its street if it is not in the cache."""
        scan = self._read(record, labels)
        if self.normalise is None:
            return scan
        # Without rings, as most files of scans are. With "any", each scan has another sensor.
        scan = dataclasses.replace(scan, ring=None)
        return normalised_scan(scan, self.normalise(Recording(scan.name)))

    def _read(self, record: ScanFile, labels: bool) -> Scan:
        """Return a scan as its sensor writes it; raise the errors of `read`."""
        street = record.path.parent
        with suppress(FileNotFoundError):
            os.utime(street)  # marks the street as just read, so that other processes keep it
            return self._load(record, labels)

        self._simulate(int(record.sequence), street)
        try:
            return self._load(record, labels)
        except FileNotFoundError:
            raise InputError(
                f"{street}: expected {SCANS} scans of a simulated street, found a part of them; "
                "delete the folder"
            ) from None

    @property
    def _is_nuscenes(self) -> bool:
        return CLASSES_BY_SENSOR[self.simulated_sensor] is NUSCENES

    def _number(self, sequence: str) -> int:
        if not re.fullmatch("[0-9]{1,9}", sequence) or int(sequence) > LAST_STREET:
            raise InputError(
                f"{self.spec}: expected streets 0 to {LAST_STREET}, found {shown(sequence)}; "
                "give their numbers"
            )
        return int(sequence)

    def _record(self, number: int, index: int, recording: Recording) -> ScanFile:
        sequence = _name(number)
        scan = _name(index)
        folder = self.root / f"streets-{self.simulated_sensor}-{_simulator()}" / sequence / scan

        return ScanFile(
            name=f"{sequence}/{scan}",
            recording=recording,
            path=folder,
            sequence=sequence,
            labels_path=folder / "labels.npy",
            prediction=f"sequences/{sequence}/predictions/{scan}.label",
            dataset=self,
        )

    def _load(self, record: ScanFile, labels: bool) -> Scan:
        """Read a scan from the cache; raise FileNotFoundError if the cache lacks it."""
        folder = record.path

        try:
            return Scan(
                np.load(folder / "points.npy"),
                labels=np.load(folder / "labels.npy") if labels else None,
                ring=np.load(folder / "ring.npy").astype(np.int64),
                name=record.name,
            )
        except (ValueError, EOFError):
            raise InputError(
                f"{folder}: expected a simulated scan, found a broken file; "
                f"delete the folder {folder.parent}"
            ) from None

    def _simulate(self, number: int, street: Path) -> None:
        """Simulate a street and put all its scans into the cache at once."""
        with temporary_folder(street.parent) as part:
            for index, scan in enumerate(self._drive(number)):
                _write(part / _name(index), scan)
            _put(part, street)

        _make_room(self.root, street)

    def _drive(self, number: int) -> Iterator[Scan]:
        """Yield the scans of a street, equal to the scans that `amvnet simulate` writes."""
        seed = np.random.SeedSequence((SEED, number))
        with one_line_errors(str, only=(SimulationError,)):
            for scan in drive_street(self.simulated_sensor, SCANS, seed):
                if self._is_nuscenes:
                    indices, categories = scan.nuscenes_categories()
                    train_ids = [NUSCENES.raw_to_train[category] for category in categories]
                    labels = np.array(train_ids, dtype=np.uint8)[indices]
                    points = scan.nuscenes_points()
                    points[:, 3] /= FULL_INTENSITY
                    yield Scan(points, labels, scan.ring)
                else:
                    labels = SEMANTICKITTI.to_train(scan.semantickitti_ids())
                    yield Scan(scan.points, labels, scan.ring)


def _name(number: int) -> str:
    return f"{number:06d}"


@cache
def _simulator() -> str:
    digest = hashlib.sha256()
    for path in sorted(Path(inspect.getfile(drive_street)).parent.rglob("*")):
        if path.suffix in (".py", ".toml"):
            digest.update(path.read_bytes())
    return digest.hexdigest()[:8]


def _write(folder: Path, scan: Scan) -> None:
    folder.mkdir()
    arrays = {"points": scan.points, "labels": scan.labels, "ring": scan.ring}
    for name, array in arrays.items():
        if array is not None:
            write_array(folder / f"{name}.npy", array)


def _put(part: Path, street: Path) -> None:
    """Rename a finished folder, unless another process has made the street."""
    try:
        part.rename(street)
    except OSError:
        if not street.is_dir():
            raise


def _make_room(root: Path, latest: Path) -> None:
    """Remove the streets that were read longest ago until the cache is small enough."""
    for part in root.glob("streets-*/.*.part"):
        with suppress(FileNotFoundError):  # another process may be removing it
            if time.time() - part.stat().st_mtime > ABANDONED:
                shutil.rmtree(part, ignore_errors=True)

    streets = []
    total = 0
    for street in root.glob(f"streets-*/{'[0-9]' * 6}"):
        with suppress(FileNotFoundError):
            size = sum(path.stat().st_size for path in street.rglob("*.npy"))
            streets.append((street.stat().st_mtime, street, size))
            total += size

    for _, street, size in sorted(streets):
        if total <= CACHE_BYTES:
            return
        if street != latest:
            # Renamed first, so that no process sees a part of a street.
            removed = street.with_name(f".{uuid.uuid4().hex}.part")
            with suppress(FileNotFoundError):
                street.rename(removed)
            shutil.rmtree(removed, ignore_errors=True)
            total -= size
