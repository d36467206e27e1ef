"""The scans of a training: of its datasets, the first also validates, the others are mixed in."""

from __future__ import annotations

import dataclasses
import math
import os
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache, cached_property

import numpy as np

from amvnet.data.datasets.base import Dataset, Names, Split, without
from amvnet.data.datasets.simulated import SCANS
from amvnet.data.formats.detect import scan_stem
from amvnet.data.recordings import ScanFile
from amvnet.data.taxonomy import Taxonomy, describe_difference
from amvnet.errors import InputError
from amvnet.files import digest
from amvnet.scan import Scan

SEED = 16  # seed of the order in which the scans of a mixed dataset take their turns
# Number of successive scans that take their turns together. A simulated street is simulated whole,
# so all its scans take their turns together. Blocks at random show several places of a drive.
BLOCK = SCANS


@dataclass(frozen=True)
class Source:
    """A dataset of a training, with its scans to train on and to validate with.

    Attributes:
        unlabelled: chosen scans without labels, which are skipped.

    Raises:
        InputError: if a scan is in both `train` and `val`.
    """

    dataset: Dataset
    train: Sequence[ScanFile]
    val: Sequence[ScanFile] = ()
    unlabelled: Sequence[ScanFile] = ()

    def __post_init__(self) -> None:
        names = {record.name for record in self.train}
        common = names & {record.name for record in self.val}
        if common:
            raise InputError(
                "expected different scans to train on and to validate with, "
                f"found {min(common)} in both; name other sequences"
            )

    @classmethod
    def labelled(cls, dataset: Dataset, train: Sequence[str], val: Sequence[str] = ()) -> Source:
        """Return the labelled scans of some sequences.

        Raises:
            InputError: if a sequence does not exist or is in both, or no scan has labels.
        """
        chosen, chosen_val = dataset.records(train), dataset.records(val)
        labelled, labelled_val = (
            dataset.labelled(chosen),
            dataset.labelled(chosen_val) if val else [],
        )
        used = {record.name for record in (*labelled, *labelled_val)}
        unlabelled = [record for record in (*chosen, *chosen_val) if record.name not in used]
        return cls(dataset, labelled, labelled_val, unlabelled)


@dataclass(frozen=True)
class TrainingData:
    """The sources of a training, and the order in which it reads their scans.

    An epoch has a place for each scan of the first source, then the places of the others. A source
    with fewer places in an epoch than scans shows other scans in the next epoch. In the end it has
    shown all equally often.

    Attributes:
        sources: the first source, which validates, and those that are mixed in.
        share: the share of an epoch's scans that the others have in equal parts, in [0, 1). With 0,
            each of their scans is in each epoch once.

    Raises:
        InputError: if a dataset has other classes, or scans to train on that the first one
            validates or tests with, or the share leaves nothing for the first one.
    """

    sources: Sequence[Source]
    share: float = 0.0

    def __post_init__(self) -> None:
        first, *others = self.sources
        if others and self.share >= 1:
            raise InputError(
                "training.others: expected a share below 1, to leave some for the first --data, "
                f"found {self.share:g}; lower it"
            )
        apart: set[tuple[str, str]] = set()
        if others:
            test = first.dataset.records(first.dataset.split().part("test"))
            apart = {_identity(record) for record in (*first.val, *test)}
        for other in others:
            for record in other.train:
                if _identity(record) in apart:
                    raise InputError(
                        "expected scans to train on apart from those to validate or to test with, "
                        f"found {record.path} among both; leave it out of "
                        f"{other.dataset.spec}"
                    )
            classes = other.dataset.taxonomy.classes
            if classes != self.taxonomy.classes:
                difference = describe_difference(self.taxonomy.classes, classes, other.dataset.spec)
                raise InputError(
                    f"expected the same classes in every --data, found {difference}; leave out "
                    "that --data"
                )

    @property
    def taxonomy(self) -> Taxonomy:
        """The classes of all sources."""
        return self.sources[0].dataset.taxonomy

    @property
    def val(self) -> Sequence[ScanFile]:
        """The scans to validate with."""
        return self.sources[0].val

    @property
    def specs(self) -> list[str]:
        """The texts by which `open_dataset` opens the datasets; a share follows an @."""
        first, *others = (source.dataset.spec for source in self.sources)
        suffix = f"@{self.share / len(others):g}" if others and self.share else ""
        return [first, *(other + suffix for other in others)]

    def to_validate(self) -> TrainingData:
        """Return the scans to validate with in the place of those to train on."""
        return TrainingData([Source(self.sources[0].dataset, self.val)])

    @cached_property
    def places(self) -> list[int]:
        """The number of places that each source has in an epoch."""
        first, *others = (len(source.train) for source in self.sources)
        if others and self.share:
            epoch = first / (1 - self.share)
            others = [max(round(self.share / len(others) * epoch), 1)] * len(others)
        return [first, *others]

    @cached_property
    def train(self) -> list[ScanFile]:
        """The scans of the first epoch, under the names that they have in the files of a run.

        A name begins with the numbers of the source and of the place, if it is not of the first
        source: "2.0/00/000012" of the sequence "2/00".
        """
        records = []
        for number in range(len(self.sources)):
            for place, record in enumerate(self.in_epoch(number)):
                if number > 0:
                    name = f"{number + 1}.{place}/{record.name}"
                    sequence = f"{number + 1}/{record.sequence}"
                    record = dataclasses.replace(record, name=name, sequence=sequence)
                records.append(record)
        return records

    def digest_of_classes(self) -> str:
        """Return a digest of the classes' names in order, and of their raw ids in each dataset."""
        classes = []
        for source in self.sources:
            taxonomy = source.dataset.taxonomy
            classes.append((taxonomy.classes, sorted(taxonomy.raw_to_train.items(), key=str)))
        return digest(repr(classes))

    def in_epoch(self, number: int, epoch: int = 0) -> list[ScanFile]:
        """Return the scans of a source in an epoch, in the order of their places."""
        return [self._turn(number, place, epoch) for place in range(self.places[number])]

    def __len__(self) -> int:
        return sum(self.places)

    def read(self, index: int, epoch: int = 0, labels: bool = True) -> Scan:
        """Read the scan that has a place in an epoch; its points know the number of their source.

        Raises:
            InputError: if it cannot be read (`Dataset.read`).
        """
        number = 0
        while index >= self.places[number]:
            index -= self.places[number]
            number += 1
        scan = self.sources[number].dataset.read(self._turn(number, index, epoch), labels)
        return dataclasses.replace(scan, source=np.full(len(scan), number))

    def _turn(self, number: int, place: int, epoch: int) -> ScanFile:
        """Return the scan of a source whose turn it is at a place in an epoch."""
        source = self.sources[number]
        turn = (epoch * self.places[number] + place) % len(source.train)
        if number > 0:
            turn = _order(number, len(source.train))[turn]
        return source.dataset.at_epoch(source.train[turn], epoch)


def digest_of_scans(records: Sequence[ScanFile]) -> str:
    """Return a digest of the names of some scans and the sizes of their files."""
    sizes = []
    for record in records:
        path = record.path
        sizes.append((record.name, path.stat().st_size if path.is_file() else None))
    return digest(repr(sizes))


def sequence_names(records: Sequence[ScanFile]) -> list[str]:
    """Return the sorted names of the sequences of some scans, each once."""
    return sorted({record.sequence for record in records})


def _identity(record: ScanFile) -> tuple[str, str]:
    """Return what identifies a scan in any dataset: its file, and its name in a bag."""
    in_file = record.name.partition(f"{scan_stem(record.path)}/")[2]
    return os.path.realpath(record.path), in_file


@cache
def _order(member: int, count: int) -> np.ndarray:
    """Return the (count,) indices of the scans of a dataset in the order of their turns."""
    blocks = np.random.default_rng([SEED, member]).permutation(math.ceil(count / BLOCK))
    indices = (blocks[:, None] * BLOCK + np.arange(BLOCK)).ravel()
    return indices[indices < count]


def to_train(
    dataset: Dataset,
    train: Sequence[str] | None = None,
    val: Sequence[str] | None = None,
    with_val: bool = False,
) -> Source:
    """Return the labelled scans to train on and to validate with.

    Args:
        train, val: names of sequences; by default the sequences that `Split.choose` returns.
        with_val: also train on the sequences of `val`, and validate with none.

    Raises:
        InputError: if no sequence is left to train on or to validate with, a sequence does not
            exist or belongs to the test split, a scan is in both, or no scan has labels.
    """
    return Source.labelled(dataset, *named_sequences(dataset, train, val, with_val))


def to_mix_in(dataset: Dataset) -> Source:
    """Return the labelled scans that can be mixed into those of another dataset.

    They are the scans of the dataset's own split train. If it has no split of its own, they are all
    scans outside test and val.

    Raises:
        InputError: if there are none.
    """
    split = dataset.split()
    names = without(split.trainable, split.part("val"))
    if not names:
        raise InputError(
            f"{dataset.spec}: expected sequences to train on, found none outside val and test; "
            "correct the split, or leave out this --data"
        )
    return Source.labelled(dataset, names)


def named_sequences(
    dataset: Dataset, train: Sequence[str] | None, val: Sequence[str] | None, with_val: bool = False
) -> tuple[Names, Names]:
    """Return the sequences to train on and to validate with; `to_train` says what the arguments do.

    Raises:
        InputError: if no sequence is left for one of both, or one to train on is of the test split.
    """
    split = dataset.split()
    names_train, names_val = split.choose(train, val)
    if with_val:
        names_train = (*names_train, *without(names_val, names_train))
        names_val = ()
    elif not names_train or not names_val:
        raise InputError(_too_few(dataset, split, train, val))
    of_test = sorted(set(names_train) & set(split.part("test")))
    if of_test:
        raise InputError(
            f"{dataset.spec}: expected sequences to train on outside the test split, found "
            f"{', '.join(of_test)}; name others, or correct the split"
        )
    return names_train, names_val


def _too_few(
    dataset: Dataset, split: Split, train: Sequence[str] | None, val: Sequence[str] | None
) -> str:
    """Return the message that says why no sequence is left to train on or to validate with."""
    if not split.having_labels(split.part("all")):
        dataset.labelled(dataset.records(split.part("all")))  # raises
    trainable = split.trainable
    if not (train or val or split.is_given) and len(trainable) < 2:
        return (
            f"{dataset.spec}: expected two sequences with labels, one to train on and one to "
            f"validate with, found {' '.join(trainable) or 'none'} alone; add another one, or "
            "divide it under split in a YAML file that describes the scans (docs/own_data.md)"
        )
    usual_train, usual_val = split.choose()
    if not (val or usual_val):
        return dataset.lacks("val")
    if not (train or usual_train):
        return dataset.lacks("train")
    return (
        f"{dataset.spec}: expected two sequences, one to train on and one to validate with, "
        f"found {', '.join(split.part('all'))}; name them"
    )
