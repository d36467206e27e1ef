"""The nearest other points of some points of a scan, by a k-d tree; knows nothing of torch."""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

SOME = 0.001  # of all points: in one place by chance are fewer


def nearest_others(xyz: np.ndarray, own: np.ndarray, n: int) -> np.ndarray:
    """(U, n) int64 indices of the n nearest other points of each point in `own`.

    Of a scan with fewer than n other points the last one is repeated; a lone point is its own neighbour.

    Args:
        xyz: (P, 3) metres.
        own: (U,) indices of the points whose neighbours are asked for.
    """
    if not len(own):
        return np.zeros((0, n), dtype=np.int64)
    found = _nearest(np.ascontiguousarray(xyz), xyz[own], min(n + 1, len(xyz)))
    return _without_own(found, own, n)


def _nearest(xyz: np.ndarray, asked: np.ndarray, n: int) -> np.ndarray:
    """(U, n) indices of the nearest points, the point itself among them.

    By pykdtree, which takes half of SciPy's time. Where several points are as near as the last one, SciPy chooses: so
    labels do not depend on which of the two is installed. (Of the real nuScenes points at hand a sixth are doubled.)
    """
    try:
        from pykdtree.kdtree import KDTree
    except ImportError:  # the runner of exported graphs does without
        return _nearest_by_scipy(xyz, asked, n)
    distance, found = KDTree(xyz).query(asked, k=n + 1)
    tied, found = distance[:, -1] == distance[:, -2], found[:, :n].astype(np.int64)
    if tied.mean() > SOME:
        found[tied] = _nearest_by_scipy(xyz, asked[tied], n)
    return found


def _nearest_by_scipy(xyz: np.ndarray, asked: np.ndarray, n: int) -> np.ndarray:
    # A tree that is not balanced costs a third to build, and a tenth more to ask.
    tree = cKDTree(xyz, balanced_tree=False, compact_nodes=False)
    return np.asarray(tree.query(asked, k=np.arange(1, n + 1), workers=-1)[1])


def _without_own(found: np.ndarray, own: np.ndarray, n: int) -> np.ndarray:
    """Drop each point from its own neighbours; the farthest where, among points in one place, it is not found."""
    if (found[:, 0] == own).all() and found.shape[
        1
    ] > 1:  # as it is where no two points are in one place
        found = found[:, 1:]
    elif found.shape[1] > 1:
        is_own = found == own[:, None]
        is_own[~is_own.any(axis=1), -1] = True
        found = found[~is_own].reshape(len(own), -1)
    missing = n - found.shape[1]
    return np.pad(found, ((0, 0), (0, missing)), mode="edge") if missing > 0 else found
