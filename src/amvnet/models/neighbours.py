"""Find the nearest neighbours of points with a k-d tree. This module does not import torch."""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

FREQUENT_TIES = 0.001  # share of the queries with a tie; chance alone causes fewer


def nearest_others(xyz: np.ndarray, own: np.ndarray, n: int) -> np.ndarray:
    """Return (U, n) int64 indices of the n nearest other points of each point in `own`.

    If a scan has fewer than n other points, the farthest is repeated. A lone point is its own
    neighbour.

    Args:
        xyz: (P, 3) metres.
        own: (U,) indices of the points whose neighbours are searched for.
        n: neighbours per point.
    """
    if not len(own):
        return np.zeros((0, n), dtype=np.int64)

    nearest = _nearest(np.ascontiguousarray(xyz), xyz[own], min(n + 1, len(xyz)))
    return _drop_self(nearest, own, n)


def _nearest(xyz: np.ndarray, queries: np.ndarray, n: int) -> np.ndarray:
    """Return (U, n) indices of the points nearest to the queries (U, 3), some of the same points.

    pykdtree takes half of SciPy's time. If ties are frequent, SciPy chooses among points that are
    as near as the n-th, so that labels do not depend on which library is installed. (A sixth of
    the points of the real nuScenes scans at hand occur twice.)
    """
    try:
        from pykdtree.kdtree import KDTree
    except ImportError:  # not required by `onnx_runner`
        return _nearest_by_scipy(xyz, queries, n)

    # One neighbour more than needed shows whether the n-th has a tie.
    distances, nearest = KDTree(xyz).query(queries, k=n + 1)
    is_tied = distances[:, -1] == distances[:, -2]
    nearest = nearest[:, :n].astype(np.int64)
    if is_tied.mean() > FREQUENT_TIES:
        nearest[is_tied] = _nearest_by_scipy(xyz, queries[is_tied], n)
    return nearest


def _nearest_by_scipy(xyz: np.ndarray, queries: np.ndarray, n: int) -> np.ndarray:
    # An unbalanced tree takes a third of the time to build, and a tenth more to query.
    tree = cKDTree(xyz, balanced_tree=False, compact_nodes=False)
    _, nearest = tree.query(queries, k=np.arange(1, n + 1), workers=-1)
    return np.asarray(nearest)


def _drop_self(nearest: np.ndarray, index: np.ndarray, n: int) -> np.ndarray:
    """Drop each point from its own neighbours, and repeat the last one up to n neighbours.

    If many points coincide, a point may be missing from its own neighbours. Then the last one is
    dropped instead.

    Args:
        nearest: (U, m) indices of neighbours, the nearest first.
        index: (U,) indices of the points themselves.

    Returns:
        (U, n) indices.
    """
    if nearest.shape[1] > 1:
        if (nearest[:, 0] == index).all():  # the usual case: no points coincide
            nearest = nearest[:, 1:]
        else:
            is_dropped = nearest == index[:, None]
            is_dropped[~is_dropped.any(axis=1), -1] = True
            nearest = nearest[~is_dropped].reshape(len(index), -1)

    missing = n - nearest.shape[1]
    if missing > 0:
        nearest = np.pad(nearest, ((0, 0), (0, missing)), mode="edge")
    return nearest
