"""Clusters: connected points of one kind."""

from __future__ import annotations

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

CELL = 0.4  # metres: points in cells that touch are connected
TOUCHING = 1.75  # a little over sqrt(3), in cells: they touch at a side, an edge or a corner
APART = 4.0  # in cells: distance between points of different kinds, wherever they are


def cluster(xyz: np.ndarray, kind: np.ndarray) -> np.ndarray:
    """Return which cluster each point is in, (N,) int64 from 0.

    Args:
        xyz: (N, 3) metres.
        kind: (N,) ids from 0; a cluster has points of one kind.
    """
    if not len(xyz):
        return np.zeros(0, dtype=np.int64)

    # Cells have the kind as a fourth coordinate, in which different kinds never touch.
    cell_of_point = np.column_stack([np.floor(xyz / CELL), kind]).astype(np.int64)
    cells, cell_index = np.unique(cell_of_point, axis=0, return_inverse=True)
    tree = cKDTree(cells * [1, 1, 1, APART])
    pairs = tree.query_pairs(TOUCHING, output_type="ndarray")

    touching = np.ones(len(pairs), dtype=bool)
    shape = (len(cells), len(cells))
    graph = coo_array((touching, (pairs[:, 0], pairs[:, 1])), shape=shape)
    _, cluster_of_cell = connected_components(graph, directed=False)
    return cluster_of_cell[cell_index.ravel()].astype(np.int64)
