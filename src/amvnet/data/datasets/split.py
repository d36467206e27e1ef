"""How the sequences of a dataset are split: which train, which validate, which test."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

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
