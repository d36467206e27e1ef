"""Find the nearest neighbours of points with a k-d tree. This module does not import torch."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

FREQUENT_TIES = 0.001  # largest share of queries with a tie that chance explains
LEAF_SIZE = 32  # points in a leaf of pykdtree's trees, which take longer to build with fewer
QUERIES_AT_ONCE = 2**17  # number of queries answered at a time, which limits the memory
CROWD = 256  # largest number of points in one place that a tree gets; nuScenes has about 70
LINE = np.sqrt(np.array([2, 3, 5], dtype=np.float32))  # a direction in which few points are equal

# Takes queries (Q, 3). Returns the indices (Q, m) of the m nearest points, and (Q,) bool: whether
# another point is as near as the m-th (a tie).
Query = Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]]


def nearest_others(xyz: np.ndarray, own: np.ndarray, n: int) -> np.ndarray:
    """Return (U, n) int32 indices of the n nearest other points of some points of a scan.

    If the scan has fewer than n other points, the farthest of them is repeated. If it has only one
    point, the point is its own neighbour.

    pykdtree takes half of SciPy's time. If ties are frequent, SciPy breaks them, so that labels do
    not depend on the installed library. (In real scans of nuScenes, a sixth of the points occur
    twice.)

    A tree cannot divide points in one place: every search there goes through all of them. So the
    tree gets `CROWD` of them. The others, such as a million lost returns, have the same neighbours.

    Args:
        xyz: (P, 3), all points of the scan, metres.
        own: (U,) indices of the points whose neighbours are wanted.
    """
    most = max(CROWD, n + 2)  # a point, n neighbours, and one more point, which shows a tie
    if not _may_have_crowds(xyz, most):
        return _nearest_others(xyz, own, n)

    order = np.lexsort(xyz.T)
    ordered = xyz[order]
    is_kept = np.ones(len(xyz), dtype=bool)
    is_kept[most:] = (ordered[most:] != ordered[:-most]).any(axis=1)
    kept = order[is_kept].astype(np.int32)

    slot = np.empty(len(xyz), dtype=np.int64)  # each point, or the last one kept in its place
    slot[order] = is_kept.cumsum() - 1
    queries, rows = np.unique(slot[own], return_inverse=True)
    nearest: np.ndarray = kept[_nearest_others(xyz[kept], queries, n)][rows]
    return nearest


def _may_have_crowds(xyz: np.ndarray, most: int) -> bool:
    """Return False if no more than `most` of the points (P, 3) are in one place.

    Points in one place have one position on a line. Others hardly ever do.
    """
    x, y, z = xyz.T
    position = np.sort(x * LINE[0] + y * LINE[1] + z * LINE[2])
    return bool((position[most:] == position[:-most]).any())


def _nearest_others(xyz: np.ndarray, own: np.ndarray, n: int) -> np.ndarray:
    """Return the result of `nearest_others`, by a tree of all points."""
    nearest = np.empty((len(own), n), dtype=np.int32)
    if not len(own):
        return nearest

    xyz = np.ascontiguousarray(xyz)
    m = min(n + 1, len(xyz))
    try:
        query = _query_by_pykdtree(xyz, m)
    except ImportError:  # not required by `onnx_runner`
        query = _query_by_scipy(xyz, m)
    is_tied = _search(query, xyz, own, rows=np.arange(len(own)), nearest=nearest)

    if is_tied.mean() > FREQUENT_TIES:
        query = _query_by_scipy(xyz, m)
        _search(query, xyz, own, rows=is_tied.nonzero()[0], nearest=nearest)
    return nearest


def _search(
    query: Query, xyz: np.ndarray, own: np.ndarray, rows: np.ndarray, nearest: np.ndarray
) -> np.ndarray:
    """Write the rows (R,) of `nearest` (U, n); return (R,) bool, which have a tie (`Query`)."""
    is_tied = np.empty(len(rows), dtype=bool)
    for start in range(0, len(rows), QUERIES_AT_ONCE):
        part = rows[start : start + QUERIES_AT_ONCE]
        indices, ties = query(xyz[own[part]])
        nearest[part] = _drop_self(indices, own[part], nearest.shape[1])
        is_tied[start : start + QUERIES_AT_ONCE] = ties
    return is_tied


def _query_by_pykdtree(xyz: np.ndarray, m: int) -> Query:
    """Return a search for the m nearest of points (P, 3)."""
    from pykdtree.kdtree import KDTree

    tree = KDTree(xyz, leafsize=LEAF_SIZE)

    def query(queries: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        # The neighbour after the m-th shows whether the m-th has a tie.
        distances, nearest = tree.query(queries, k=m + 1)
        return nearest[:, :m].astype(np.int32), distances[:, -1] == distances[:, -2]

    return query


def _query_by_scipy(xyz: np.ndarray, m: int) -> Query:
    """Return a search for the m nearest of points (P, 3), which reports no ties."""
    from scipy.spatial import cKDTree

    # An unbalanced tree takes a third of the time to build, and a tenth more time to query.
    tree = cKDTree(xyz, balanced_tree=False, compact_nodes=False)

    def query(queries: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        _, nearest = tree.query(queries, k=np.arange(1, m + 1), workers=-1)
        return np.asarray(nearest, dtype=np.int32), np.zeros(len(queries), dtype=bool)

    return query


def _drop_self(nearest: np.ndarray, index: np.ndarray, n: int) -> np.ndarray:
    """Drop each point itself from its nearest points: (U, m) -> (U, n) indices.

    The nearest points come first. If fewer than n are left, the last of them is repeated. If many
    points coincide, a point may not be among its own nearest points. Then the last of them is
    dropped instead.
    """
    if nearest.shape[1] > 1:
        if (nearest[:, 0] == index).all():  # usually, no points coincide
            nearest = nearest[:, 1:]
        else:
            is_dropped = nearest == index[:, None]
            is_dropped[~is_dropped.any(axis=1), -1] = True
            nearest = nearest[~is_dropped].reshape(len(index), -1)

    missing = n - nearest.shape[1]
    if missing > 0:
        nearest = np.pad(nearest, ((0, 0), (0, missing)), mode="edge")
    return nearest
