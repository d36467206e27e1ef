"""The nearest other points of some points of a scan, by SciPy's tree; knows nothing of torch."""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree


def nearest_others(xyz: np.ndarray, own: np.ndarray, n: int) -> np.ndarray:
    """(U, n) int64 indices of the n nearest other points of each point in `own`.

    Of a scan with fewer than n other points the last one is repeated; a lone point is its own neighbour.

    Args:
        xyz: (P, 3) metres.
        own: (U,) indices of the points whose neighbours are asked for.
    """
    if not len(own):
        return np.zeros((0, n), dtype=np.int64)
    # A tree that is not balanced costs a third to build, and a tenth more to ask.
    tree = cKDTree(xyz, balanced_tree=False, compact_nodes=False)
    _, found = tree.query(xyz[own], k=np.arange(1, min(n + 1, len(xyz)) + 1), workers=-1)  # (U, <= n + 1)
    return _without_own(np.asarray(found), own, n)


def _without_own(found: np.ndarray, own: np.ndarray, n: int) -> np.ndarray:
    """Drop each point from its own neighbours; the farthest where, among points in one place, it is not found."""
    if found.shape[1] > 1:
        is_own = found == own[:, None]
        is_own[~is_own.any(axis=1), -1] = True
        found = found[~is_own].reshape(len(own), -1)
    missing = n - found.shape[1]
    return np.pad(found, ((0, 0), (0, missing)), mode="edge") if missing > 0 else found
