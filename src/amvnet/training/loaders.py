"""Scans from disk to batches for training: read, augmented by seed, collated."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import suppress
from pathlib import Path
from zipfile import BadZipFile

import numpy as np
import torch
from torch import Tensor
from torch.utils import data

from amvnet.config.schema import AugmentConfig
from amvnet.data.datasets.base import Dataset, ScanRecord
from amvnet.distributed import ALONE, Processes
from amvnet.errors import InputError
from amvnet.files import atomic_write
from amvnet.models.views.points import PointBatch
from amvnet.scan import Scan
from amvnet.training.augment import augment, mix

Key = tuple[int, int]  # epoch, place in the list of scans


class ScanSet(data.Dataset[Scan]):
    """Labelled scans, each augmented by (seed, epoch, place): the same on any number of processes."""

    def __init__(
        self,
        dataset: Dataset,
        records: Sequence[ScanRecord],
        augment: AugmentConfig | None = None,
        seed: int = 0,
    ) -> None:
        self.dataset, self.records, self.augment, self.seed = dataset, list(records), augment, seed

    def __len__(self) -> int:
        return len(self.records)

    def __getitem__(self, key: Key) -> Scan:
        epoch, place = key
        scan = self._read(place)
        if self.augment is None:
            return scan
        rng = np.random.default_rng([self.seed, epoch, place])
        scan = augment(scan, self.augment, rng)
        if rng.random() >= self.augment.mix:
            return scan
        other = augment(self._read(int(rng.integers(len(self)))), self.augment, rng)
        return mix(scan, other, rng)

    def _read(self, place: int) -> Scan:
        scan = self.dataset.read(self.records[place])
        if scan.labels is None:
            raise InputError(
                f"{scan.name}: expected labels to train with, found none; name labelled sequences"
            )
        if scan.valid.sum() < 2:  # of one point batch norm has no variance
            raise InputError(
                f"{scan.name}: expected points to train with, found fewer than two; leave the scan out"
            )
        return scan


class EpochSampler(data.Sampler[Key]):
    """Every scan once an epoch, in an order drawn from (seed, epoch); Lightning tells the epoch.

    Of several processes each takes its part of every batch. In training all have as many scans: where they cannot be
    shared out evenly, the first ones of the order come again at its end.
    """

    def __init__(self, size: int, seed: int, shuffle: bool, processes: Processes = ALONE) -> None:
        self.size, self.seed, self.shuffle, self.processes, self.epoch = (
            size,
            seed,
            shuffle,
            processes,
            0,
        )

    def set_epoch(self, epoch: int) -> None:
        self.epoch = epoch

    def __len__(self) -> int:
        return len(self._mine())

    def __iter__(self) -> Iterator[Key]:
        return iter([(self.epoch, place) for place in self._mine()])

    def _mine(self) -> list[int]:
        order = np.arange(self.size)
        if self.shuffle:
            even = -(-self.size // self.processes.size) * self.processes.size
            order = np.resize(
                np.random.default_rng([self.seed, self.epoch]).permutation(self.size), even
            )
        return list(self.processes.share(order.tolist()))


def collate(scans: Sequence[Scan]) -> tuple[PointBatch, Tensor]:
    """Scans -> their valid points, and (P,) int64 train ids."""
    labels = [scan.labels[scan.valid] for scan in scans if scan.labels is not None]
    return PointBatch.of(scans), torch.from_numpy(np.concatenate(labels).astype(np.int64))


def make_loader(
    scans: ScanSet, batch: int, workers: int, shuffle: bool, processes: Processes = ALONE
) -> data.DataLoader[tuple[PointBatch, Tensor]]:
    """Batches of scans, of each process its own; the last one of a training epoch may be smaller."""
    return data.DataLoader(
        scans,  # type: ignore[arg-type]  # its keys are pairs, as the sampler gives them
        batch_size=batch,
        sampler=EpochSampler(len(scans), scans.seed, shuffle, processes),
        num_workers=workers,
        collate_fn=collate,
        persistent_workers=workers > 0,
        pin_memory=torch.cuda.is_available(),  # so that batches go to a GPU while it computes
    )


def count_classes(
    dataset: Dataset, records: Sequence[ScanRecord], kept: Path, processes: Processes = ALONE
) -> np.ndarray:
    """(K,) points of each class in some scans; counted once, and kept in a file beside the run."""
    made = {"scans": [record.name for record in records], "classes": list(dataset.taxonomy.classes)}
    # What the first process found counts for all, who might see the file when it is just being written.
    if (counted := processes.gather(_counted(kept, made))[0]) is not None:
        return counted
    mine = np.zeros(dataset.taxonomy.size + 1, dtype=np.int64)
    for record in processes.share(records):
        labels = dataset.read(record).labels
        if labels is not None:
            mine += np.bincount(labels, minlength=len(mine))
    counts = np.sum(processes.gather(mine), axis=0)[1:]
    if processes.first:
        with atomic_write(kept) as part:
            np.savez(
                part,
                counts=counts,
                scans=np.array(made["scans"]),
                classes=np.array(made["classes"]),
            )
    return counts


def _counted(kept: Path, made: dict[str, list[str]]) -> np.ndarray | None:
    """The counts in a file, where they are of these scans and classes."""
    with (
        suppress(OSError, ValueError, KeyError, BadZipFile),
        np.load(kept, allow_pickle=False) as file,
    ):
        if all(file[key].tolist() == value for key, value in made.items()):
            return file["counts"]
    return None
