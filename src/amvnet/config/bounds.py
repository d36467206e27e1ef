"""Define ranges of numbers, and a base class of dataclasses that refuse numbers out of range."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields
from typing import Annotated, Any, get_args, get_type_hints

from amvnet.errors import InputError, shown


@dataclass(frozen=True)
class Range:
    """The numbers that a field may hold, such as `Range(0, 1)`; `open` excludes both ends."""

    low: float
    high: float = math.inf
    open: bool = False

    def __contains__(self, value: float) -> bool:
        if self.open:
            return self.low < value < self.high
        return self.low <= value <= self.high

    def __repr__(self) -> str:
        above = "above" if self.open else "at least"
        below = "below" if self.open else "at most"
        if math.isinf(self.high):
            return f"{above} {self.low:g}"
        return f"{above} {self.low:g} and {below} {self.high:g}"


MAX_TEXT_LENGTH = 200  # largest number of characters in a text from a file
MAX_ITEMS = 12  # largest number of values in a list, such as the channels of a network's layers
Count = Annotated[int, Range(1, 1_000_000)]  # number of items; the limit is far above any use
Seed = Annotated[int, Range(0, 2**32 - 1)]  # seed of all random numbers
Share = Annotated[float, Range(0, 1)]  # share of a whole


class Bounded:
    """A base class of dataclasses whose numbers must be finite and in their `Range`."""

    def __post_init__(self) -> None:
        """Check every number.

        Raises:
            InputError: if a number is not finite or out of its range. The message names the first
                such number.
        """
        kinds = get_type_hints(type(self), include_extras=True)
        for field in fields(self):  # type: ignore[arg-type]
            name = field.name
            value = getattr(self, name)
            if not isinstance(value, tuple):
                _check_range(name, value, kinds[name])
                continue
            self.check(
                holds=len(value) <= MAX_ITEMS,
                expected=f"at most {MAX_ITEMS} values of {name}",
                found=str(len(value)),
            )
            for item in value:
                _check_range(name, item, get_args(kinds[name])[0])

    def check(self, holds: bool, expected: str, found: str) -> None:
        """Check a condition on several numbers; raise InputError if the condition does not hold."""
        if not holds:
            raise InputError(f"expected {expected}, found {found}; correct the values")


def _check_range(name: str, value: Any, kind: Any) -> None:
    if isinstance(value, float) and not math.isfinite(value):
        raise InputError(f"{name}: expected a finite number, found {value}; correct the value")

    for allowed in getattr(kind, "__metadata__", ()):  # each range of an `Annotated` type
        if value not in allowed:
            raise InputError(
                f"{name}: expected a number {allowed}, found {shown(value)}; correct the value"
            )


def check_text(name: str, value: Any) -> None:
    """Raise InputError if a value of a file is not a short text of one line."""
    if not isinstance(value, str) or not value.isprintable() or len(value) > MAX_TEXT_LENGTH:
        raise InputError(
            f"{name}: expected a text of at most {MAX_TEXT_LENGTH} printable characters, "
            f"found {shown(value)}; correct the value"
        )
