"""Ranges of numbers, and a base class of dataclasses that refuse numbers outside their range."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated, Any, get_args, get_type_hints

from amvnet.errors import InputError


@dataclass(frozen=True)
class Range:
    """The numbers that a field may hold: `Annotated[float, Range(0, 1)]`.

    Attributes:
        low: lower end.
        high: upper end.
        open: whether the ends themselves are excluded.
    """

    low: float
    high: float = math.inf
    open: bool = False

    def __contains__(self, value: Any) -> bool:
        if self.open:
            return self.low < value < self.high
        return self.low <= value <= self.high

    def __repr__(self) -> str:
        above = "above" if self.open else "at least"
        below = "below" if self.open else "at most"
        if math.isinf(self.high):
            return f"{above} {self.low:g}"
        return f"{above} {self.low:g} and {below} {self.high:g}"


Count = Annotated[int, Range(1)]
NotNegative = Annotated[float, Range(0)]
Positive = Annotated[float, Range(0, open=True)]
Share = Annotated[float, Range(0, 1)]


class Checked:
    """A base class of dataclasses whose numbers must lie in the `Range` of their annotation."""

    def __post_init__(self) -> None:
        """Check every number.

        Raises:
            InputError: if a number is out of its range; the message names the first.
        """
        for name, kind in get_type_hints(type(self), include_extras=True).items():
            value = getattr(self, name)
            if isinstance(value, tuple):
                item_kind = get_args(kind)[0]
                for item in value:
                    _check_range(name, item, item_kind)
            else:
                _check_range(name, value, kind)

    def check(self, holds: bool, expected: str, found: str) -> None:
        """Check a condition that involves several numbers.

        Args:
            holds: the condition.
            expected: what the message says was expected.
            found: what the message says was found.

        Raises:
            InputError: if the condition does not hold.
        """
        if not holds:
            raise InputError(f"expected {expected}, found {found}; correct the values")


def _check_range(name: str, value: Any, kind: Any) -> None:
    for allowed in getattr(kind, "__metadata__", ()):  # the ranges of an `Annotated` type
        if value not in allowed:
            raise InputError(
                f"{name}: expected a number {allowed}, found {value}; correct the value"
            )
