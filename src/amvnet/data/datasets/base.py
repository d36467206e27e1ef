"""What every dataset offers: its scans by sequence, and the split of its sequences."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

from amvnet.data.recordings import DatasetFiles, Normalise, Recording, ScanFile
from amvnet.errors import InputError, counted

Names = tuple[str, ...]  # names of sequences


@dataclass(frozen=True)
class Split:
    """The sequences of a dataset on disk, and what they are for.

    Attributes:
        parts: the sequences of "all" and of each split that the dataset knows, some of which may
            have none. "rest" has those that the split in a user's file does not name.
        is_given: whether the dataset says itself what trains and what validates. If not, all
            sequences outside "test" do.
        having_labels: returns those of some sequences that have labels.
        note: what a user should know about a split that nobody named.
    """

    parts: Mapping[str, Names]
    is_given: bool
    having_labels: Callable[[Names], Names]
    note: str = ""

    def part(self, name: str) -> Names:
        """Return the sequences of a split of the dataset, which may be none."""
        return self.parts.get(name, ())

    @cached_property
    def trainable(self) -> Names:
        """The sequences that may train, before those that validate are left out."""
        if self.is_given:
            return self.part("train")
        names = without(self.part("all"), self.part("test"))
        return self.having_labels(names) or names

    def choose(
        self, train: Sequence[str] | None = None, val: Sequence[str] | None = None
    ) -> tuple[Names, Names]:
        """Return the sequences to train on and to validate with: the named ones, or the usual ones.

        Without a split of its own, the last sequence of a dataset validates and the others train.
        If only its "val" is on disk, that validates. If too few are on disk, one of both is empty.
        A sequence that is named for one purpose is not used for the other by default.
        """
        usual = self.part("val")
        if not (self.is_given or usual) and len(self.trainable) > 1:
            usual = self.trainable[-1:]
        val = val or without(usual, train or ())
        return tuple(train or without(self.trainable, val)), tuple(val)


def without(names: Names, others: Sequence[str]) -> Names:
    """Return the names that are not among others, in order."""
    return tuple(name for name in names if name not in others)


class Dataset(DatasetFiles):
    """One dataset on disk; instances can be pickled, so that worker processes can read.

    Attributes:
        readers: number of threads that may read scans at the same time.
        simulated_sensor: the sensor whose scans are simulated, new ones in each epoch; "" if the
            scans are recorded.
        described_sensor: what a description of the dataset says of the sensor, if anything.
        benchmark_sensor: the name of the sensor of a benchmark, whose scans are normalised for
            weights that do not know it; "" if all scans stay unchanged: other sensors' scans often
            have the layout of SemanticKITTI, and so have those that weights are trained on.
    """

    readers = 8
    simulated_sensor = ""
    described_sensor: str | Mapping[str, Any] | None = None
    benchmark_sensor = ""

    @abstractmethod
    def parts(self) -> dict[str, Names]:
        """Return the sequences on disk of "all" and of each split that the dataset knows."""

    def split(self) -> Split:
        """Return how the sequences on disk are split.

        The split of a benchmark counts if there are sequences to train on and to validate with.
        """
        parts = self.parts()
        return Split(parts, bool(parts.get("train") and parts.get("val")), self._with_labels)

    def _with_labels(self, names: Names) -> Names:
        labelled = {record.sequence for record in self.having_labels(self.records(names))}
        return tuple(name for name in names if name in labelled)

    def lacks(self, split: str) -> str:
        """Return the message that says what a split without a sequence lacks."""
        return f"{self.spec}: expected sequences of the split {split}, found none; name others"

    def sequences(self, name: str) -> Names:
        """Return the sequences of a split, for "train" and "val" as `Split.choose` returns them.

        Raises:
            InputError: if the split is unknown or has no sequence.
        """
        split = self.split()
        if name not in split.parts:
            raise InputError(
                f"{self.spec}: expected a split of {', '.join(split.parts)}, found {name!r}; give "
                "one of them"
            )
        names = split.part(name)
        if name in ("train", "val"):
            train, val = split.choose()
            names = train if name == "train" else val
        if not names:
            raise InputError(self.lacks(name))
        return names

    @abstractmethod
    def records(self, sequences: Sequence[str]) -> list[ScanFile]:
        """Return the scans of these sequences, sorted by sequence and then by time.

        Raises:
            InputError: if a sequence does not exist; the message lists those that do.
        """

    def recordings(self) -> list[Recording]:
        """Return the recordings whose sensors are measured; a benchmark has none."""
        return []

    def normalised_by(self, normalise: Normalise) -> Dataset:
        """Return the dataset with its scans normalised, if they can be."""
        return self

    def at_epoch(self, record: ScanFile, epoch: int) -> ScanFile:
        """Return the scan that takes a scan's place in an epoch: in most datasets, the scan."""
        return record

    def labelled(self, records: Sequence[ScanFile]) -> list[ScanFile]:
        """Return the scans to train on or to score: those that have labels.

        Raises:
            InputError: if none of the scans has labels.
        """
        labelled = self.having_labels(records)
        if not labelled:
            path = records[0].labels_path if records else None
            found = f"no {path}" if path is not None else "no labels"
            raise InputError(
                f"{self.spec}: expected labelled scans, found {found} among "
                f"{counted(len(records), 'scan')}; name labelled sequences, or add the labels"
            )
        return labelled

    def having_labels(self, records: Sequence[ScanFile]) -> list[ScanFile]:
        """Return the scans that have labels, which may be none."""
        return [record for record in records if record.has_labels]


def not_trained_on(unseen: Sequence[str]) -> str:
    """Return the end of an advice: which sequences to name that are not of the split "train"."""
    advice = "sequences on which the weights were not trained"
    if not unseen:
        return f"{advice}, with --sequences"
    return f"{advice}, such as --sequences {','.join(unseen[:3])}"


def choose_records(dataset: Dataset, sequences: Sequence[str] | None, split: str) -> list[ScanFile]:
    """Return the scans of the named sequences, or of a split if there are no names."""
    return dataset.records(dataset.sequences(split) if sequences is None else sequences)
