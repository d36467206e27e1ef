"""Weighted random choice."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TypeVar

import numpy as np

Option = TypeVar("Option")


def normalised(shares: Mapping[Option, float]) -> dict[Option, float]:
    """Return shares that add up to 1 in the ratios of the given ones."""
    total = sum(shares.values())
    return {option: share / total for option, share in shares.items()}


def weighted_choice(rng: np.random.Generator, chances: Mapping[Option, float]) -> Option:
    """Draw one of the keys, each with the chance that is its value; the chances add up to 1."""
    options = list(chances)
    return options[rng.choice(len(options), p=list(chances.values()))]
