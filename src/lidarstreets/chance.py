"""Draw weighted choices, and random numbers that are alike at neighbouring places."""

from collections.abc import Mapping
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

Option = TypeVar("Option")

# The hash of a cube is the dot product of its indices and these primes, modulo `HASH_VALUES`.
HASH_PRIMES = (73_856_093, 19_349_663, 83_492_791)
HASH_VALUES = 2**16


def weighted_choice(rng: np.random.Generator, shares: Mapping[Option, float]) -> Option:
    """Draw a key of `shares`; the chance of each key is proportional to its value."""
    weights = np.array(list(shares.values()))
    return list(shares)[rng.choice(len(weights), p=weights / weights.sum())]


def scaled(shares: Mapping[Option, float], factors: Mapping[Option, float]) -> dict[Option, float]:
    """Return shares times their factors, which are 1 where a factor is missing."""
    return {name: share * factors.get(name, 1.0) for name, share in shares.items()}


def patchy_normal(
    rng: np.random.Generator, places: NDArray[np.floating], patch: float, correlation: float
) -> NDArray[np.float64]:
    """Draw one standard normal number for each place; the numbers are correlated within cubes.

    Args:
        rng: draws the numbers and the position of the cubes.
        places: (N, 3) x, y, z in metres.
        patch: edge of a cube in metres.
        correlation: correlation in [0, 1] of the numbers of two places in one cube.

    Returns:
        (N,) float32 or float64.
    """
    cubes = np.floor(places / patch + rng.random(3)).astype(np.int64)
    shared = rng.standard_normal(HASH_VALUES, np.float32)[cubes @ HASH_PRIMES % HASH_VALUES]
    own = rng.standard_normal(len(places), np.float32)
    normal: NDArray[np.float64] = np.sqrt(correlation) * shared + np.sqrt(1 - correlation) * own
    return normal
