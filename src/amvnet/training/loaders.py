"""Batches of training scans: read from disk, augmented, collated."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any
from zipfile import BadZipFile

import numpy as np
import torch
from torch import Tensor
from torch.utils import data

from amvnet.config.schema import AugmentConfig
from amvnet.data.datasets.base import Dataset, ScanRecord
from amvnet.data.datasets.joined import Joined
from amvnet.data.datasets.own import OwnScans
from amvnet.data.laser_order import with_lasers
from amvnet.data.spacing import evenly_spaced
from amvnet.errors import InputError
from amvnet.files import atomic_write
from amvnet.models.views.points import PointBatch
from amvnet.progress import Say, Tenths, say_nothing
from amvnet.runtime.distributed import ALONE, Processes
from amvnet.scan import Scan
from amvnet.sensors.intensity import KEY as INTENSITY
from amvnet.sensors.intensity import (
    MATCHED,
    NO_INTENSITY,
    TrainedIntensity,
    are_quantiles,
    match_scan,
    quantiles_of,
)
from amvnet.sensors.record import AS_IS, measure_sensor, normalised_record
from amvnet.sensors.record import KEY as SENSOR
from amvnet.training.augment import augment, mix, mix_lasers, paste

SAMPLED_SCANS = 60  # to measure: enough for the mean height of simulated sensors

Key = tuple[int, int]  # epoch, index in the list of scans

# Small or rare objects of both benchmarks, which are pasted into other scans. Cars are common.
PASTED = frozenset(
    {
        "barrier",
        "bicycle",
        "bicyclist",
        "bus",
        "construction_vehicle",
        "motorcycle",
        "motorcyclist",
        "other-vehicle",
        "pedestrian",
        "person",
        "traffic_cone",
        "trailer",
        "truck",
    }
)


class ScanSet(data.Dataset[Scan]):
    """Labelled scans by epoch and index.

    The augmentation depends only on seed, epoch and index: it is the same on any number of
    processes. Augmented scans are those of the epoch (`Dataset.at_epoch`).

    Args:
        augment: how they are augmented, or None for scans as they are.
        intensity: what the intensities of each scan are brought to, before its augmentation.
        lasers: number of lasers to look for in scans without rings (`with_lasers`); 0: none.
    """

    def __init__(
        self,
        dataset: Dataset,
        records: Sequence[ScanRecord],
        augment: AugmentConfig | None = None,
        seed: int = 0,
        intensity: TrainedIntensity | None = None,
        lasers: int = 0,
    ) -> None:
        self.dataset = dataset
        self.records = list(records)
        self.augment = augment
        self.seed = seed
        self.intensity = intensity
        self.lasers = lasers

        classes = enumerate(dataset.taxonomy.classes, start=1)
        self.pasted = [train_id for train_id, name in classes if name in PASTED]

    def __len__(self) -> int:
        return len(self.records)

    def __getitem__(self, key: Key) -> Scan:
        epoch, index = key
        if self.augment is None:
            return self._read(self.records[index])

        # The order of the random draws decides which scan a seed gives: keep it.
        config = self.augment
        rng = np.random.default_rng([self.seed, epoch, index])
        scan = self._draw(key, rng)
        if rng.random() < config.mix:
            scan = mix(scan, self._draw_other(epoch, rng), rng)
        if config.laser_mix and rng.random() < config.laser_mix:
            scan = mix_lasers(scan, self._draw_other(epoch, rng), rng)
        if config.paste and rng.random() < config.paste:
            scan = paste(scan, self._draw_other(epoch, rng), self.pasted, rng)
        return scan

    def _draw_other(self, epoch: int, rng: np.random.Generator) -> Scan:
        """Return a random scan of an epoch, augmented, to mix with another one."""
        index = int(rng.integers(len(self)))
        return self._draw((epoch, index), rng)

    def _draw(self, key: Key, rng: np.random.Generator) -> Scan:
        """Return a scan of an epoch, augmented."""
        assert self.augment is not None
        epoch, index = key
        record = self.dataset.at_epoch(self.records[index], epoch)
        return augment(self._read(record), self.augment, rng)

    def _read(self, record: ScanRecord) -> Scan:
        scan = self.dataset.read(record)
        if scan.labels is None:
            raise InputError(
                f"{scan.name}: expected labels to train with, found none; name labelled sequences"
            )

        valid = scan.valid.sum()
        if valid < 2:  # batch norm needs two points to compute a variance
            raise InputError(
                f"{scan.name}: expected at least two valid points to train with, found {valid}; "
                "leave the scan out"
            )
        # Not after the augmentation, which changes the order of the points and the intensity.
        if self.lasers:
            scan = with_lasers(scan, self.lasers)
        return match_scan(scan, self.intensity)


class EpochOrder(data.Sampler[Any]):
    """The base of samplers whose random order depends on seed and epoch."""

    def __init__(self, seed: int, processes: Processes = ALONE) -> None:
        self.seed = seed
        self.processes = processes
        self.epoch = 0

    def set_epoch(self, epoch: int) -> None:
        """Set the epoch; Lightning calls this."""
        self.epoch = epoch

    def rng(self) -> np.random.Generator:
        """Return the generator of the epoch's order."""
        return np.random.default_rng([self.seed, self.epoch])


class EpochSampler(EpochOrder):
    """Draws every scan once per epoch, in a random order.

    With several processes, each takes its part of every batch. All processes draw equally many
    scans: if the scans cannot be shared equally, the first ones are drawn again.
    """

    def __init__(self, size: int, seed: int, processes: Processes = ALONE) -> None:
        super().__init__(seed, processes)
        self.size = size

    def __len__(self) -> int:
        return -(-self.size // self.processes.size)  # rounded up

    def __iter__(self) -> Iterator[Key]:
        total = len(self) * self.processes.size
        order = np.resize(self.rng().permutation(self.size), total)  # repeats the first ones
        for index in self.processes.share(order.tolist()):
            yield self.epoch, index


def collate(scans: Sequence[Scan]) -> tuple[PointBatch, Tensor]:
    """Return the valid points of labelled scans, and their (P,) int64 train ids."""
    labels = [scan.labels[scan.valid] for scan in scans if scan.labels is not None]
    return PointBatch.of(scans), torch.from_numpy(np.concatenate(labels).astype(np.int64))


def make_loader(
    scans: ScanSet, batch: int, workers: int, shuffle: bool, processes: Processes = ALONE
) -> data.DataLoader[tuple[PointBatch, Tensor]]:
    """Make a loader of this process's batches; the last one of an epoch may be smaller.

    Args:
        batch: scans in a batch of one process.
        workers: processes that read scans; 0 to read in this one.
        shuffle: draw the scans of each epoch by an `EpochSampler`, as in training.
    """
    sampler: data.Sampler[Any] | list[Key] = EpochSampler(len(scans), scans.seed, processes)
    if not shuffle:
        sampler = [(0, index) for index in processes.share(range(len(scans)))]
    return data.DataLoader(
        scans,  # type: ignore[arg-type]  # the sampler gives keys, not indices
        batch_size=batch,
        sampler=sampler,
        num_workers=workers,
        collate_fn=collate,
        persistent_workers=workers > 0,
        pin_memory=torch.cuda.is_available(),  # so that batches go to a GPU while it computes
    )


def count_classes(
    dataset: Dataset,
    records: Sequence[ScanRecord],
    path: Path,
    processes: Processes = ALONE,
    say: Say = say_nothing,
) -> np.ndarray:
    """Return how many points of each class some scans have, (K,) int64.

    The counts are read from the .npz file `path` if it is of these scans, else written to it.
    """
    source = {
        "scans": [record.name for record in records],
        "classes": list(dataset.taxonomy.classes),
    }

    # The first process reads for all: others might already see the file that it writes below.
    earlier = processes.gather(_read_counts(path, source))[0]
    if earlier is not None:
        return earlier

    counts = np.zeros(dataset.taxonomy.size + 1, dtype=np.int64)
    share = processes.share(records)
    tenths = Tenths()
    for number, record in enumerate(share, start=1):
        labels = dataset.read(record).labels
        if labels is not None:
            counts += np.bincount(labels, minlength=len(counts))
        if tenths.ends(number, len(share)):
            done = number * len(records) // len(share)
            say(f"classes: counted in {done} of {len(records)} scans")

    totals = np.sum(processes.gather(counts), axis=0)[1:]

    if processes.first:
        with atomic_write(path) as part:
            np.savez(part, counts=totals, scans=source["scans"], classes=source["classes"])
    return totals


def sensor_record(
    dataset: Dataset, records: Sequence[ScanRecord], intensity: TrainedIntensity | None = None
) -> dict[str, Any]:
    """Return what weights record of the sensor, measured on some of their training scans.

    These are the measures of `sensors.record`, and the mean quantiles of the intensities at
    `sensors.intensity.PROBABILITIES`, empty if no scan has usable ones. Broken scans are left out:
    the training names them.

    Args:
        intensity: what the intensities of the scans are brought to.
    """
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
    record: dict[str, Any] = {INTENSITY: mean if is_known else []}

    # Normalised scans are as the weights will get them: record what they are normalised to.
    first = dataset.dataset if isinstance(dataset, Joined) else dataset
    normalised = normalised_record(first) if isinstance(first, OwnScans) else {}
    record |= normalised or {SENSOR: {**measure_sensor(scans), AS_IS: True}}
    if intensity is not None and intensity.is_matched:
        record |= {INTENSITY: list(intensity.quantiles), MATCHED: True}
    return record


def _read_counts(path: Path, source: dict[str, list[str]]) -> np.ndarray | None:
    """Return the counts in a file, or None if it is missing, broken or of other scans."""
    with (
        suppress(OSError, ValueError, KeyError, BadZipFile),
        np.load(path, allow_pickle=False) as file,
    ):
        if all(file[name].tolist() == values for name, values in source.items()):
            return file["counts"]
    return None
