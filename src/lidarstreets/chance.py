"""Weighted random choice, and random numbers that are alike at neighbouring places."""

from collections.abc import Mapping
from typing import TypeVar

import numpy as np

Option = TypeVar("Option")

# A hash of the indices of a cube: their product with large primes, up to the number of values.
PRIMES = (73_856_093, 19_349_663, 83_492_791)
HASHES = 2**16


def weighted_choice(rng: np.random.Generator, shares: Mapping[Option, float]) -> Option:
    """Draw one of the keys, each with a chance in proportion to its value."""
    weights = np.array(list(shares.values()))
    return list(shares)[rng.choice(len(weights), p=weights / weights.sum())]


def patchy_normal(
    rng: np.random.Generator, places: np.ndarray, patch: float, correlation: float
) -> np.ndarray:
    """Return (N,) standard normal numbers for the (N, 3) places, which are in metres.

    The numbers of two places are correlated if they are in the same cube of `patch` metres.
    """
    cubes = np.floor(places / patch + rng.random(3)).astype(np.int64)
    shared = rng.standard_normal(HASHES, np.float32)[cubes @ PRIMES % HASHES]
    own = rng.standard_normal(len(places), np.float32)
    return np.sqrt(correlation) * shared + np.sqrt(1 - correlation) * own
