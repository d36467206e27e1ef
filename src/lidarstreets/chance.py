"""Weighted random choice."""

from collections.abc import Mapping
from typing import TypeVar

import numpy as np

Option = TypeVar("Option")


def weighted_choice(rng: np.random.Generator, shares: Mapping[Option, float]) -> Option:
    """Draw one of the keys, each with a chance in proportion to its value."""
    weights = np.array(list(shares.values()))
    return list(shares)[rng.choice(len(weights), p=weights / weights.sum())]
