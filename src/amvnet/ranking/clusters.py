"""Points that belong together: connected ones of one kind."""

from __future__ import annotations

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

CELL = 0.4  # metres: points in cells that touch are connected
TOUCHING = 1.75  # a little over the square root of 3, in cells: at a side, an edge or a corner
APART = 4.0  # in cells: between points of different kinds, wherever they are


def cluster(xyz: np.ndarray, kind: np.ndarray) -> np.ndarray:
    """(N, 3) metres and (N,) kinds from 0 -> (N,) which cluster each point is in, from 0."""
    if not len(xyz):
        return np.zeros(0, dtype=np.int64)
    cells = np.column_stack([np.floor(xyz / CELL), kind]).astype(np.int64)
    cells, cell_of = np.unique(cells, axis=0, return_inverse=True)
    pairs = cKDTree(cells * [1, 1, 1, APART]).query_pairs(TOUCHING, output_type="ndarray")
    links = coo_array(
        (np.ones(len(pairs), dtype=bool), (pairs[:, 0], pairs[:, 1])), shape=(len(cells),) * 2
    )
    return connected_components(links, directed=False)[1][cell_of.ravel()].astype(np.int64)
