"""Choose the scans of a dataset to train on and to validate with."""

from __future__ import annotations

from collections.abc import Sequence

from amvnet.data.datasets.base import Dataset
from amvnet.data.datasets.split import Names, Split, without
from amvnet.data.datasets.training_data import Source
from amvnet.errors import InputError


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
    """Return the error that says why no sequence is left to train on or to validate with."""
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
