"""Divide points into clusters. A cluster is a set of connected points of one kind."""

from __future__ import annotations

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

CELL = 0.4  # side of a cell, metres; points in the same cell or in touching cells are connected
# The indices of cells that touch, even if only at a corner, are at most sqrt(3) apart. The indices
# of other cells are at least 2 apart.
TOUCHING = 1.75  # a distance between these two, cells
APART = 4.0  # least distance between cells of different kinds, cells


def cluster(xyz: np.ndarray, kind: np.ndarray) -> np.ndarray:
    """Return the (N,) int64 cluster, from 0, of each point at (N, 3) metres.

    Points of different kinds, (N,) integers, are never in one cluster.
    """
    if not len(xyz):
        return np.zeros(0, dtype=np.int64)

    # The kind is a fourth coordinate of a cell, so that cells of different kinds never touch.
    cell_of_point = np.column_stack([np.floor(xyz / CELL), kind]).astype(np.int64)
    cells, cell_index = np.unique(cell_of_point, axis=0, return_inverse=True)
    tree = cKDTree(cells * [1, 1, 1, APART])
    pairs = tree.query_pairs(TOUCHING, output_type="ndarray")

    touching = np.ones(len(pairs), dtype=bool)
    shape = (len(cells), len(cells))
    graph = coo_array((touching, (pairs[:, 0], pairs[:, 1])), shape=shape)
    _, cluster_of_cell = connected_components(graph, directed=False)
    return cluster_of_cell[cell_index.ravel()].astype(np.int64)
