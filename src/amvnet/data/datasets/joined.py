"""Several datasets as one to train on: the first is validated, the others are mixed in."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache

import numpy as np

from amvnet.data.datasets.base import Dataset, ScanRecord
from amvnet.data.datasets.open import check_classes
from amvnet.data.datasets.select import TrainingScans
from amvnet.data.datasets.simulated import SCANS
from amvnet.errors import InputError
from amvnet.scan import Scan

SEED = 16  # of the order in which the scans of a mixed dataset take their turns
# Successive scans that take their turns together, in random blocks: a simulated street at once, as
# it is simulated whole, and several places of a drive.
BLOCK = SCANS


@dataclass(frozen=True)
class MixedRecord(ScanRecord):
    """A place in each epoch for a scan of a dataset that is mixed in.

    Attributes:
        member: number of the dataset, 1 for the second.
        place: number of the place among those of the dataset.
        original: the scan of the first epoch.
    """

    member: int
    place: int
    original: ScanRecord


@dataclass(frozen=True)
class Part:
    """A dataset that is mixed in.

    Attributes:
        share: of the scans of an epoch; None takes every scan once per epoch.
    """

    dataset: Dataset
    records: Sequence[ScanRecord]
    share: float | None = None


class Joined(Dataset):
    """Several datasets with the same classes. `Dataset` documents the methods and their errors.

    Scans of the first dataset keep their records. Scans of the others have a `MixedRecord`, and
    sequences named by the number of the dataset: "2/000012". A dataset with fewer places than scans
    shows others of its scans in each epoch, all of them equally often.

    Args:
        dataset: the first of them; names the split, is validated, and takes predictions.
        parts: the others.
        places: of each of the parts, how many scans an epoch has.
    """

    def __init__(self, dataset: Dataset, parts: Sequence[Part], places: Sequence[int]) -> None:
        super().__init__(dataset.root, dataset.taxonomy, dataset.spec)
        self.is_normalised = dataset.is_normalised
        self.dataset = dataset
        self.parts = parts
        self.places = places

    @property
    def specs(self) -> list[str]:
        """What all of them are opened with: PATH or PATH@SHARE."""
        texts = [self.dataset.spec]
        for part in self.parts:
            share = "" if part.share is None else f"@{part.share:g}"
            texts.append(f"{part.dataset.spec}{share}")
        return texts

    def sequences(self, split: str) -> tuple[str, ...]:
        """Return the sequences of the first dataset."""
        return self.dataset.sequences(split)

    def records(self, sequences: Sequence[str]) -> list[ScanRecord]:
        """Return scans of the first dataset."""
        return self.dataset.records(sequences)

    def mixed_records(self) -> list[MixedRecord]:
        """Return the places of all others in an epoch."""
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
        dataset = self.parts[record.member - 1].dataset
        return dataclasses.replace(turn, original=dataset.at_epoch(turn.original, epoch))

    def read(self, record: ScanRecord, labels: bool = True) -> Scan:
        """Read a scan of any of them."""
        if not isinstance(record, MixedRecord):
            return self.dataset.read(record, labels)
        return self.parts[record.member - 1].dataset.read(record.original, labels)

    def _record(self, member: int, place: int, epoch: int) -> MixedRecord:
        """Return the record of the scan whose turn it is at a place in an epoch."""
        records = self.parts[member - 1].records
        turn = epoch * self.places[member - 1] + place
        original = records[_order(member, len(records))[turn % len(records)]]

        fields = vars(original) | {
            "name": f"{member + 1}.{place}/{original.name}",
            "sequence": f"{member + 1}/{original.sequence}",
        }
        return MixedRecord(**fields, member=member, place=place, original=original)


def join(scans: TrainingScans, parts: Sequence[Part]) -> TrainingScans:
    """Return scans to train on, with others mixed in; the scans to validate with stay.

    Raises:
        InputError: if a dataset has other classes, scans of a user's own are mixed with others, or
            the shares leave nothing for the first.
    """
    if not parts:
        return scans
    for part in parts:
        check_classes(part.dataset, scans.dataset.taxonomy)
        if part.dataset.is_normalised != scans.dataset.is_normalised:
            raise InputError(
                f"{part.dataset.root}: expected either scans of your own (a YAML file) or datasets "
                "in every --data, found both; train on one after the other, with --init"
            )

    joined = Joined(scans.dataset, parts, _places(len(scans.train), parts))
    return TrainingScans(joined, [*scans.train, *joined.mixed_records()], scans.val)


@cache
def _order(member: int, count: int) -> np.ndarray:
    """Return the (count,) indices of the scans of a dataset in the order of their turns."""
    blocks = np.random.default_rng([SEED, member]).permutation(-(-count // BLOCK))  # rounded up
    indices = (blocks[:, None] * BLOCK + np.arange(BLOCK)).ravel()
    return indices[indices < count]


def _places(first: int, parts: Sequence[Part]) -> list[int]:
    """Return how many scans of an epoch each of the parts has, at least one.

    Args:
        first: scans of the first dataset.
    """
    shares = sum(part.share for part in parts if part.share is not None)
    if shares >= 1:
        raise InputError(
            f"expected shares below 1 in all, to leave some for the first --data, found "
            f"{shares:g}; lower them"
        )

    whole = first + sum(len(part.records) for part in parts if part.share is None)
    epoch = whole / (1 - shares)
    places = []
    for part in parts:
        count = len(part.records) if part.share is None else round(part.share * epoch)
        places.append(max(count, 1))
    return places
