"""The nearest neighbours of points of a scan, found by a k-d tree, without torch."""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

FREQUENT_TIES = 0.001  # share of the points; ties by chance are rarer


def nearest_others(xyz: np.ndarray, own: np.ndarray, n: int) -> np.ndarray:
    """Return (U, n) int64 indices of the n nearest other points of each point in `own`.

    If a scan has fewer than n other points, the last one is repeated. A lone point is its own
    neighbour.

    Args:
        xyz: (P, 3) metres.
        own: (U,) indices of the points whose neighbours are searched for.
    """
    if not len(own):
        return np.zeros((0, n), dtype=np.int64)

    nearest = _nearest(np.ascontiguousarray(xyz), xyz[own], min(n + 1, len(xyz)))
    return _without_own(nearest, own, n)


def _nearest(xyz: np.ndarray, queries: np.ndarray, n: int) -> np.ndarray:
    """Return (U, n) indices of the points nearest to the queries (U, 3), themselves among them.

    pykdtree takes half of SciPy's time. If several points are as near as the last one, SciPy
    chooses among them, so that labels do not depend on which library is installed. (A sixth of
    the points of the real nuScenes scans at hand occur twice.)
    """
    try:
        from pykdtree.kdtree import KDTree
    except ImportError:  # the runner of exported graphs does not need it
        return _nearest_by_scipy(xyz, queries, n)

    # One neighbour more than needed shows whether the last one is tied.
    distance, nearest = KDTree(xyz).query(queries, k=n + 1)
    tied = distance[:, -1] == distance[:, -2]
    nearest = nearest[:, :n].astype(np.int64)
    if tied.mean() > FREQUENT_TIES:
        nearest[tied] = _nearest_by_scipy(xyz, queries[tied], n)
    return nearest


def _nearest_by_scipy(xyz: np.ndarray, queries: np.ndarray, n: int) -> np.ndarray:
    # An unbalanced tree takes a third of the time to build, and a tenth more to query.
    tree = cKDTree(xyz, balanced_tree=False, compact_nodes=False)
    return np.asarray(tree.query(queries, k=np.arange(1, n + 1), workers=-1)[1])


def _without_own(nearest: np.ndarray, own: np.ndarray, n: int) -> np.ndarray:
    """Drop each point from its own neighbours (U, m), and fill them up to (U, n).

    Among many points in one place a point may be missing from its own neighbours. Then the
    farthest is dropped.
    """
    if nearest.shape[1] > 1:
        if (nearest[:, 0] == own).all():  # the usual case: no two points in one place
            nearest = nearest[:, 1:]
        else:
            dropped = nearest == own[:, None]
            dropped[~dropped.any(axis=1), -1] = True
            nearest = nearest[~dropped].reshape(len(own), -1)

    missing = n - nearest.shape[1]
    return np.pad(nearest, ((0, 0), (0, missing)), mode="edge") if missing > 0 else nearest
