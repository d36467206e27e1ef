"""Numbers that say which values they may have, and dataclasses that refuse others."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated, Any, get_args, get_type_hints

from amvnet.errors import InputError


@dataclass(frozen=True)
class Range:
    """The numbers that a value may have, for `Annotated`."""

    low: float
    high: float = math.inf
    open: bool = False  # without its ends

    def __contains__(self, value: Any) -> bool:
        return self.low < value < self.high if self.open else self.low <= value <= self.high

    def __repr__(self) -> str:
        low, high = ("above", "below") if self.open else ("at least", "at most")
        return f"{low} {self.low:g}" + (
            "" if math.isinf(self.high) else f" and {high} {self.high:g}"
        )


Count = Annotated[int, Range(1)]
NotNegative = Annotated[float, Range(0)]
Positive = Annotated[float, Range(0, open=True)]
Share = Annotated[float, Range(0, 1)]


class Checked:
    """A dataclass that refuses numbers out of their ranges."""

    def __post_init__(self) -> None:
        """Raises InputError on the first value out of its range."""
        for name, kind in get_type_hints(type(self), include_extras=True).items():
            value = getattr(self, name)
            if isinstance(value, tuple):
                kind = get_args(kind)[0]
            for allowed in getattr(kind, "__metadata__", ()):
                if wrong := [
                    v for v in (value if isinstance(value, tuple) else (value,)) if v not in allowed
                ]:
                    raise InputError(
                        f"{name}: expected a number {allowed}, found {wrong[0]}; correct the value"
                    )

    def check(self, holds: bool, expected: str, found: str) -> None:
        """Raises InputError unless something holds."""
        if not holds:
            raise InputError(f"expected {expected}, found {found}; correct the values")
