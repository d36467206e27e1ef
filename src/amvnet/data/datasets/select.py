"""Which scans of a dataset to use, and checks of its classes."""

from __future__ import annotations

from collections.abc import Sequence

from amvnet.data.datasets.base import Dataset, ScanRecord
from amvnet.data.taxonomy import TAXONOMIES, Taxonomy
from amvnet.errors import InputError


def custom_taxonomy(taxonomy: Taxonomy) -> Taxonomy | None:
    """A user's own classes, with which a data set has to be read; None for those of a benchmark."""
    return taxonomy if taxonomy.name not in TAXONOMIES else None


def check_classes(dataset: Dataset, taxonomy: Taxonomy) -> None:
    """Raises InputError where weights know other classes than the data set."""
    if taxonomy.classes != dataset.taxonomy.classes:
        raise InputError(
            f"expected weights for the classes of {dataset.taxonomy.name}, found weights for those of "
            f"{taxonomy.name}; use weights trained on this benchmark"
        )


def choose_records(
    dataset: Dataset, sequences: Sequence[str] | None, split: str
) -> list[ScanRecord]:
    """The scans of the named sequences, or else of a split."""
    return dataset.records(dataset.sequences(split) if sequences is None else sequences)


def split_records(
    dataset: Dataset, train: Sequence[str] | None, val: Sequence[str] | None, with_val: bool = False
) -> tuple[list[ScanRecord], list[ScanRecord]]:
    """The scans to train on and those to validate with: as named, else by the official split.

    Of a data set that has no scan of one of the two official splits, the last sequence validates.

    Args:
        with_val: train on both, and validate with none.

    Raises:
        InputError: where there is just one sequence.
    """
    present = dataset.sequences("all")
    official = {split: _present(dataset, split) for split in ("train", "val")}
    if not (train or official["train"]) or not (val or official["val"]):
        official = {"train": present[:-1], "val": present[-1:]}
    val = val or [s for s in official["val"] if s not in (train or ())]
    train = train or [s for s in official["train"] if s not in val]
    if with_val:
        return dataset.records([*train, *(s for s in val if s not in train)]), []
    if not train or not val:
        raise InputError(
            f"{dataset.root}: expected two sequences, one to train on and one to validate with, "
            f"found {', '.join(present)}; name them"
        )
    return dataset.records(train), dataset.records(val)


def _present(dataset: Dataset, split: str) -> tuple[str, ...]:
    try:
        return dataset.sequences(split)
    except InputError:
        return ()
