"""Choose a few items of many."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TypeVar

import numpy as np

Item = TypeVar("Item")


def evenly_spaced(items: Sequence[Item], limit: int) -> list[Item]:
    """Return at most `limit` of the items, evenly spaced, including the first and the last.

    If there are fewer items, return all of them. If `limit` is 1, return the first.
    """
    indices = np.linspace(0, len(items) - 1, min(limit, len(items))).astype(int)
    return [items[index] for index in indices]
