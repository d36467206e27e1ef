"""Read training scans from disk, augment them, and collate them to batches."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.utils import data

from amvnet.config.schema import AugmentConfig
from amvnet.data.check import check_trainable
from amvnet.data.datasets.training_data import TrainingData
from amvnet.errors import InputError
from amvnet.models.views.points import PointBatch
from amvnet.runtime.distributed import ALONE, Processes
from amvnet.scan import Scan
from amvnet.sensors.expectation import Expectation
from amvnet.training.augment import augment, mix, mix_lasers, paste

Key = tuple[int, int]  # the epoch, and the index of a scan in the list of scans

# The classes of small or rare objects in both benchmarks, which are pasted into other scans. Cars
# are common enough.
PASTED_CLASSES = frozenset(
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
    """Labelled scans by epoch and index, prepared for the networks and augmented if `augment`.

    The augmentation depends only on the seed, the epoch and the index, so that it is the same for
    any number of processes.
    """

    def __init__(
        self,
        scans: TrainingData,
        expects: Expectation,
        augment: AugmentConfig | None = None,
        seed: int = 0,
    ) -> None:
        self.scans = scans
        self.expects = expects
        self.augment = augment
        self.seed = seed

        classes = enumerate(scans.taxonomy.classes, start=1)
        self.pasted = [train_id for train_id, name in classes if name in PASTED_CLASSES]

    def __len__(self) -> int:
        return len(self.scans)

    def __getitem__(self, key: Key) -> Scan:
        epoch, index = key
        if self.augment is None:
            return self._read((0, index))  # what validates does not change

        # Keep the order of the random draws, because it decides which scan a seed gives.
        config = self.augment
        rng = np.random.default_rng([self.seed, epoch, index])
        scan = self._draw(key, rng)
        if rng.random() < config.mix:
            scan = mix(scan, self._draw_other(epoch, rng), rng)
        if config.laser_mix and rng.random() < config.laser_mix:
            scan = mix_lasers(scan, self._draw_other(epoch, rng), rng)
        if self.pasted and config.paste and rng.random() < config.paste:
            scan = paste(scan, self._draw_other(epoch, rng), self.pasted, rng)
        return scan

    def _draw_other(self, epoch: int, rng: np.random.Generator) -> Scan:
        """Return a random scan of an epoch, augmented. It is mixed with another scan."""
        index = int(rng.integers(len(self)))
        return self._draw((epoch, index), rng)

    def _draw(self, key: Key, rng: np.random.Generator) -> Scan:
        """Return a scan of an epoch, augmented."""
        assert self.augment is not None
        return augment(self._read(key), self.augment, rng)

    def _read(self, key: Key) -> Scan:
        epoch, index = key
        scan = self.scans.read(index, epoch)
        if scan.labels is None:
            raise InputError(
                f"{scan.name}: expected labels to train with, found none; name labelled sequences"
            )
        check_trainable(scan)
        # Before the augmentation, which changes the order and the intensities of the points.
        return self.expects.prepare(scan)


class EpochOrder(data.Sampler[Any]):
    """The base class of samplers whose random order depends on a seed and the epoch."""

    def __init__(self, seed: int, processes: Processes = ALONE) -> None:
        self.seed = seed
        self.processes = processes
        self.epoch = 0

    def set_epoch(self, epoch: int) -> None:
        """Set the epoch; Lightning calls this."""
        self.epoch = epoch

    def rng(self) -> np.random.Generator:
        """Return the random generator that decides the order of the epoch."""
        return np.random.default_rng([self.seed, self.epoch])


class EpochSampler(EpochOrder):
    """Draws every scan once per epoch, in a random order.

    If there are several processes, each takes its part of every batch. All processes draw the same
    number of scans. If the scans cannot be shared equally, the first scans are drawn again.
    """

    def __init__(self, size: int, seed: int, processes: Processes = ALONE) -> None:
        super().__init__(seed, processes)
        self.size = size

    def __len__(self) -> int:
        return -(-self.size // self.processes.size)  # rounded up

    def __iter__(self) -> Iterator[Key]:
        total = len(self) * self.processes.size
        order = np.resize(self.rng().permutation(self.size), total)  # repeats the first scans
        for index in self.processes.share(order.tolist()):
            yield self.epoch, index


def collate(scans: Sequence[Scan]) -> tuple[PointBatch, Tensor, Tensor]:
    """Return the P valid points of labelled scans, their train ids and their sources, (P,) int64.

    Points of an unknown source have the source 0.
    """
    labels = []
    sources = []
    for scan in scans:
        assert scan.labels is not None
        valid = scan.valid
        labels.append(scan.labels[valid])
        source = np.zeros(len(scan), np.int64) if scan.source is None else scan.source
        sources.append(source[valid])
    return (
        PointBatch.of(scans),
        torch.from_numpy(np.concatenate(labels).astype(np.int64)),
        torch.from_numpy(np.concatenate(sources)),
    )


def make_loader(
    scans: ScanSet, batch: int, workers: int, shuffle: bool, processes: Processes = ALONE
) -> data.DataLoader[tuple[PointBatch, Tensor, Tensor]]:
    """Make a loader of this process's batches. The last batch of an epoch may be smaller.

    No `workers` read the scans in this process; `shuffle` lets an `EpochSampler` draw them.
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
        pin_memory=torch.cuda.is_available(),  # so that a GPU computes while it receives batches
    )
