"""Several datasets joined to train on: the first also validates, the others are mixed in."""

from __future__ import annotations

import dataclasses
import math
import os
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache

import numpy as np

from amvnet.data.datasets.base import Dataset, ScanRecord
from amvnet.data.datasets.select import TrainingScans, official_or_none
from amvnet.data.datasets.simulated import SCANS
from amvnet.data.formats.find import scan_stem
from amvnet.data.taxonomy import describe_difference
from amvnet.errors import InputError
from amvnet.scan import Scan

SEED = 16  # seed of the order in which the scans of a mixed dataset take their turns
# Number of successive scans that take their turns together. A simulated street is simulated whole,
# so all its scans take their turns together. Blocks at random show several places of a drive.
BLOCK = SCANS


@dataclass(frozen=True)
class MixedRecord(ScanRecord):
    """A place in each epoch for a scan of a dataset that is mixed in.

    Attributes:
        member: index of the dataset among all, 1 for the first that is mixed in.
        place: index of the place among the dataset's places.
        original: the scan that has the place.
    """

    member: int
    place: int
    original: ScanRecord


class Joined(Dataset):
    """Several datasets with the same classes. `Dataset` documents the methods and their errors.

    Scans of the first dataset keep their records. Scans of the others have a `MixedRecord`, whose
    sequence begins with the number of the dataset: "2/000012". A dataset with fewer places in an
    epoch than scans shows other scans in the next epoch. In the end it has shown all equally often.

    Args:
        scans: the scans of the first dataset, which has the split, validates and takes predictions.
        others: the other datasets, with the scans to train on.
        share: the share of an epoch, as `join` takes it.
    """

    def __init__(self, scans: TrainingScans, others: Sequence[TrainingScans], share: float) -> None:
        self.dataset = scans.dataset
        super().__init__(self.dataset.root, self.dataset.taxonomy, self.dataset.spec)
        self.others = others
        # The share and the places in an epoch that each of the others has.
        self.share = share / len(others)
        self.places = _places(len(scans.train), others, share)

    @property
    def members(self) -> Sequence[Dataset]:
        """The first dataset, and the others."""
        return [self.dataset, *(other.dataset for other in self.others)]

    @property
    def specs(self) -> list[str]:
        """The texts by which `open_dataset` opens the datasets; a share follows an @."""
        suffix = f"@{self.share:g}" if self.share else ""
        texts = [self.dataset.spec]
        for other in self.others:
            texts.append(other.dataset.spec + suffix)
        return texts

    def official(self, split: str) -> tuple[str, ...]:
        """Return the sequences of the first dataset."""
        return self.dataset.official(split)

    def sequences(self, split: str) -> tuple[str, ...]:
        """Return the sequences of the first dataset."""
        return self.dataset.sequences(split)

    def records(self, sequences: Sequence[str]) -> list[ScanRecord]:
        """Return scans of the first dataset."""
        return self.dataset.records(sequences)

    def mixed_records(self) -> list[MixedRecord]:
        """Return the places of the others in an epoch, with the scans of the first epoch."""
        records = []
        for member, count in enumerate(self.places, start=1):
            for place in range(count):
                records.append(self._record(member, place, epoch=0))
        return records

    def at_epoch(self, record: ScanRecord, epoch: int) -> ScanRecord:
        """Return the scan that takes a place in an epoch."""
        if not isinstance(record, MixedRecord):
            return self.dataset.at_epoch(record, epoch)

        turn = self._record(record.member, record.place, epoch)
        dataset = self.others[record.member - 1].dataset
        return dataclasses.replace(turn, original=dataset.at_epoch(turn.original, epoch))

    def read(self, record: ScanRecord, labels: bool = True) -> Scan:
        """Read a scan of any of the datasets; its points have the dataset as their source."""
        member = 0
        if isinstance(record, MixedRecord):
            member = record.member
            scan = self.others[member - 1].dataset.read(record.original, labels)
        else:
            scan = self.dataset.read(record, labels)
        return dataclasses.replace(scan, source=np.full(len(scan), member))

    def raw_labels(self, record: ScanRecord, count: int) -> np.ndarray:
        """Read the raw ids of a scan of any dataset; each dataset may have its own ids."""
        if not isinstance(record, MixedRecord):
            return self.dataset.raw_labels(record, count)
        return self.others[record.member - 1].dataset.raw_labels(record.original, count)

    def _record(self, member: int, place: int, epoch: int) -> MixedRecord:
        """Return the record of the scan whose turn it is at a place in an epoch."""
        records = self.others[member - 1].train
        turn = epoch * self.places[member - 1] + place
        original = records[_order(member, len(records))[turn % len(records)]]

        fields = vars(original) | {
            "name": f"{member + 1}.{place}/{original.name}",
            "sequence": f"{member + 1}/{original.sequence}",
        }
        return MixedRecord(**fields, member=member, place=place, original=original)


def join(
    scans: TrainingScans, others: Sequence[TrainingScans], share: float = 0.0
) -> TrainingScans:
    """Mix other scans into the scans to train on; the scans to validate with stay the same.

    Args:
        share: the share of an epoch's scans that the others have in equal parts, in [0, 1). With 0,
            each of their scans is in each epoch once.

    Raises:
        InputError: if a dataset has other classes, or scans to train on that the first dataset
            validates or tests with, or the share leaves nothing for the first.
    """
    if not others:
        return scans
    test = official_or_none(scans.dataset, "test")
    apart = {_identity(record) for record in (*scans.val, *scans.dataset.records(test))}
    for other in others:
        for record in other.train:
            if _identity(record) in apart:
                raise InputError(
                    "expected scans to train on apart from those to validate or to test with, "
                    f"found {record.points_path} among both; leave it out of {other.dataset.spec}"
                )
        classes = scans.dataset.taxonomy.classes
        others_classes = other.dataset.taxonomy.classes
        if classes != others_classes:
            difference = describe_difference(classes, others_classes, other.dataset.spec)
            raise InputError(
                f"expected the same classes in every --data, found {difference}; leave out that "
                "--data"
            )

    joined = Joined(scans, others, share)
    train = [*scans.train, *joined.mixed_records()]
    return TrainingScans(joined, train, scans.val, scans.unlabelled)


def _identity(record: ScanRecord) -> tuple[str, str]:
    """Return what identifies a scan in any dataset: its file, and its name in a bag."""
    in_file = record.name.partition(f"{scan_stem(record.points_path)}/")[2]
    return os.path.realpath(record.points_path), in_file


@cache
def _order(member: int, count: int) -> np.ndarray:
    """Return the (count,) indices of the scans of a dataset in the order of their turns."""
    blocks = np.random.default_rng([SEED, member]).permutation(math.ceil(count / BLOCK))
    indices = (blocks[:, None] * BLOCK + np.arange(BLOCK)).ravel()
    return indices[indices < count]


def _places(first: int, others: Sequence[TrainingScans], share: float) -> list[int]:
    """Return how many places in an epoch each other dataset has, if the first has `first` scans."""
    if not share:
        return [max(len(other.train), 1) for other in others]
    if share >= 1:
        raise InputError(
            "training.others: expected a share below 1, to leave some for the first --data, found "
            f"{share:g}; lower it"
        )
    epoch = first / (1 - share)
    return [max(round(share / len(others) * epoch), 1)] * len(others)
