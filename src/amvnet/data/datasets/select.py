"""Choose the scans to train on, to validate with and to score."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from amvnet.data.datasets.base import Dataset, ScanRecord
from amvnet.errors import InputError


@dataclass(frozen=True)
class TrainingScans:
    """The scans of a dataset to train on, and the scans to validate with, if there are any.

    Attributes:
        unlabelled: chosen scans without labels, which are skipped.

    Raises:
        InputError: if a scan is in both `train` and `val`.
    """

    dataset: Dataset
    train: Sequence[ScanRecord]
    val: Sequence[ScanRecord]
    unlabelled: Sequence[ScanRecord] = ()

    def __post_init__(self) -> None:
        names = {record.name for record in self.train}
        common = names & {record.name for record in self.val}
        if common:
            raise InputError(
                "expected different scans to train on and to validate with, "
                f"found {min(common)} in both; name other sequences"
            )


def split_records(
    dataset: Dataset, train: Sequence[str] | None, val: Sequence[str] | None, with_val: bool = False
) -> TrainingScans:
    """Return the scans to train on and to validate with.

    Args:
        train, val: names of sequences; by default the sequences that `Dataset.sequences` returns.
        with_val: also train on the sequences of `val`, and validate with none.

    Raises:
        InputError: if no sequence is left to train on or to validate with, a sequence does not
            exist or belongs to the test split, or a scan is in both.
    """
    names_train, names_val = named_sequences(dataset, train, val, with_val)
    chosen = dataset.records(names_train)
    chosen_val = dataset.records(names_val) if names_val else []
    train_records = dataset.labelled(chosen)
    val_records = dataset.labelled(chosen_val) if names_val else []

    used = {record.name for record in (*train_records, *val_records)}
    unlabelled = [record for record in (*chosen, *chosen_val) if record.name not in used]
    return TrainingScans(dataset, train_records, val_records, unlabelled)


def named_sequences(
    dataset: Dataset, train: Sequence[str] | None, val: Sequence[str] | None, with_val: bool = False
) -> tuple[list[str], list[str]]:
    """Return the sequences to train on and to validate with; `split_records` has the arguments."""
    if not (train or val or with_val or dataset.is_split):
        _require_two(dataset)

    # A sequence that the user named for one purpose is not used for the other by default.
    by_default = _sequences_with_val if with_val else Dataset.sequences
    names_val = list(val) if val else _without(by_default(dataset, "val"), train or ())
    if train:
        names_train = list(train)
    elif val and not dataset.is_split:
        names_train = _without(dataset.trainable(), val)
    else:
        names_train = _without(by_default(dataset, "train"), names_val)

    if with_val:
        names_train += _without(names_val, names_train)
        names_val = []
    elif not names_train or not names_val:
        raise InputError(
            f"{dataset.spec}: expected two sequences, one to train on and one to validate with, "
            f"found {', '.join(dataset.sequences('all'))}; name them"
        )
    _refuse_test(dataset, names_train)
    return names_train, names_val


def _sequences_with_val(dataset: Dataset, split: str) -> tuple[str, ...]:
    """Return the sequences of a split for a training on all scans; a split may be empty."""
    try:
        return dataset.sequences(split)
    except InputError:
        return () if dataset.is_split or split == "val" else dataset.trainable()


def _require_two(dataset: Dataset) -> None:
    """Raise InputError if the sequences do not suffice for a training and its validation."""
    names = dataset.trainable()
    if len(names) < 2:
        raise InputError(
            f"{dataset.spec}: expected two sequences with labels, one to train on and one to "
            f"validate with, found {' '.join(names) or 'none'} alone; add another one, or divide "
            "it under split in a YAML file that describes the scans (docs/own_data.md)"
        )


def _refuse_test(dataset: Dataset, names: Sequence[str]) -> None:
    """Raise InputError if a sequence to train on belongs to the test split."""
    of_test = sorted(set(names) & set(official_or_none(dataset, "test")))
    if of_test:
        raise InputError(
            f"{dataset.spec}: expected sequences to train on outside the test split, found "
            f"{', '.join(of_test)}; name others, or correct the split"
        )


def official_or_none(dataset: Dataset, split: str) -> tuple[str, ...]:
    """Return the sequences of an official split, or none if there is no such split."""
    try:
        return dataset.official(split)
    except InputError:
        return ()


def _without(names: Sequence[str], others: Sequence[str]) -> list[str]:
    return [name for name in names if name not in others]


def all_to_train(dataset: Dataset) -> TrainingScans:
    """Return the scans of the training split to train on; without a split, all but test and val.

    Raises:
        InputError: if there are none.
    """
    if dataset.is_split:
        names = list(_sequences_with_val(dataset, "train"))
    else:
        names = _without(dataset.trainable(), official_or_none(dataset, "val"))
    if not names:
        raise InputError(
            f"{dataset.spec}: expected sequences to train on, found none outside val and test; "
            "correct the split, or leave out this --data"
        )
    chosen = dataset.records(names)
    train = dataset.labelled(chosen)
    used = {record.name for record in train}
    return TrainingScans(dataset, train, [], [each for each in chosen if each.name not in used])
