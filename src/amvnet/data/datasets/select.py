"""Choose the scans of a training, and the classes that a user names."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from amvnet.data.datasets.base import Dataset, ScanRecord
from amvnet.data.taxonomy import TAXONOMIES, Taxonomy, taxonomy_from_yaml
from amvnet.errors import InputError


@dataclass(frozen=True)
class TrainingScans:
    """The scans of a training.

    Attributes:
        dataset: where they are.
        train: to learn from.
        val: to validate with; empty if nothing is validated. No scan may be in both.

    Raises:
        InputError: if a scan is in both.
    """

    dataset: Dataset
    train: Sequence[ScanRecord]
    val: Sequence[ScanRecord]

    def __post_init__(self) -> None:
        names = {record.name for record in self.train}
        common = names & {record.name for record in self.val}
        if common:
            raise InputError(
                f"expected validation scans apart from training, found {min(common)} in both; "
                "name others"
            )


def taxonomy_named(text: str) -> Taxonomy:
    """Return the classes of a benchmark by its name, or those of a YAML file."""
    return TAXONOMIES[text] if text in TAXONOMIES else taxonomy_from_yaml(text)


def split_records(
    dataset: Dataset, train: Sequence[str] | None, val: Sequence[str] | None, with_val: bool = False
) -> TrainingScans:
    """Return the scans to train on and to validate with: as named, else by the official split.

    If a dataset has no scan of one of the two official splits, its last sequence validates.

    Args:
        with_val: train on both, and validate with none.

    Raises:
        InputError: if there is just one sequence.
    """
    present = dataset.sequences("all")
    official_train = _present(dataset, "train")
    official_val = _present(dataset, "val")
    if not (train or official_train) or not (val or official_val):
        official_train = present[:-1]
        official_val = present[-1:]

    if not val:
        val = [name for name in official_val if name not in (train or ())]
    if not train:
        train = [name for name in official_train if name not in val]
    if with_val:
        added = [name for name in val if name not in train]
        return TrainingScans(dataset, dataset.records([*train, *added]), [])
    if not train or not val:
        raise InputError(
            f"{dataset.root}: expected two sequences, one to train on and one to validate with, "
            f"found {', '.join(present)}; name them"
        )
    return TrainingScans(dataset, dataset.records(train), dataset.records(val))


def _present(dataset: Dataset, split: str) -> tuple[str, ...]:
    """Return the sequences of an official split that are on disk, which may be none."""
    try:
        return dataset.sequences(split)
    except InputError:
        return ()
