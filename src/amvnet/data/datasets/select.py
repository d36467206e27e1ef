"""Choose the scans to train on, to validate with and to score."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from amvnet.data.datasets.base import Dataset, ScanRecord
from amvnet.errors import InputError


@dataclass(frozen=True)
class TrainingScans:
    """The scans of a dataset to train on, and those to validate with, which may be none.

    Raises:
        InputError: if a scan is in both `train` and `val`.
    """

    dataset: Dataset
    train: Sequence[ScanRecord]
    val: Sequence[ScanRecord]

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

    If an official split is needed and the dataset has no sequence of it, the last sequence is used
    to validate and the others to train.

    Args:
        train, val: sequences; None for the sequences of the official split.
        with_val: train on the sequences of `val`, too, and validate with none.

    Raises:
        InputError: if no sequence is left for one of the two, a sequence does not exist, or a scan
            is in both.
    """
    present = dataset.sequences("all")
    official_train = _sequences_on_disk(dataset, "train")
    official_val = _sequences_on_disk(dataset, "val")
    has_train = train or official_train
    has_val = val or official_val
    if not has_train or not has_val:
        official_train = present[:-1]
        official_val = present[-1:]

    # A sequence that the user named for one purpose is not used for the other by default.
    if not val:
        val = _without(official_val, train or ())
    if not train:
        train = _without(official_train, val)

    if with_val:
        names = [*train, *_without(val, train)]
        return TrainingScans(dataset, dataset.labelled(dataset.records(names)), [])

    if not train or not val:
        raise InputError(
            f"{dataset.root}: expected two sequences, one to train on and one to validate with, "
            f"found {', '.join(present)}; name them"
        )
    return TrainingScans(
        dataset,
        dataset.labelled(dataset.records(train)),
        dataset.labelled(dataset.records(val)),
    )


def _without(names: Sequence[str], others: Sequence[str]) -> list[str]:
    return [name for name in names if name not in others]


def training_records(dataset: Dataset) -> list[ScanRecord]:
    """Return the scans of the official training split, or all if none of it is on disk."""
    names = _sequences_on_disk(dataset, "train") or dataset.sequences("all")
    return dataset.records(names)


def _sequences_on_disk(dataset: Dataset, split: str) -> tuple[str, ...]:
    """Return the sequences of an official split that are on disk; empty if there are none."""
    try:
        return dataset.sequences(split)
    except InputError:
        return ()
