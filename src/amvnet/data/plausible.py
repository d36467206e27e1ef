"""Find labels that are whole and known, but implausible: they do not fit their points.

The limits are from 243 real scans of an HDL-64E, an HDL-32E and a Pandar64, and from simulated
ones. Neighbours have the same label in 96 % beyond chance, and at most 2 % of the points of a class
of the ground are raised. In the same scans, sorted along an axis, by distance or by angle without
their labels, the first number is below 80 %; in reversed ones, the second one is above 8 %.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from amvnet.data.class_maps import class_map
from amvnet.data.taxonomy import Taxonomy

CELL_SIDE = 0.3  # side of the cells in which points are neighbours, metres
MIN_NEIGHBOURS = 500  # smallest number of points with neighbours that are judged
MIN_FOLLOWING = 0.85  # smallest share of a scan's neighbours with equal labels beyond chance
MIN_FOLLOWING_CLASS = 0.3  # smallest such share of a class, over all scans

GROUND = "ground"  # the coarse class of the ground
RAISED = 1.0  # height over the lowest point of its square metre that raises a point, metres
MAX_RAISED = 0.05  # largest share of the points of a class of the ground that are raised

# Largest shares of all points that one class has on any street, by its coarse class.
MAX_SHARES = {"two-wheeler": 0.1, "person": 0.1, "pole": 0.2, "vehicle": 0.5}


def neighbours(xyz: np.ndarray, labels: np.ndarray, size: int) -> np.ndarray:
    """Count valid points (N, 3), metres, with a labelled neighbour, and with one of their label.

    Neighbours follow each other in the file among the points of one cell.

    Returns:
        (2, K + 1) int64, both counts by train id.
    """
    cells = np.floor(xyz / CELL_SIDE).astype(np.int64)
    order, is_first = _grouped(cells)
    pairs = np.stack([labels[order][:-1], labels[order][1:]])[:, ~is_first[1:]]
    pairs = pairs[:, pairs.all(axis=0)]
    equal = pairs[:, pairs[0] == pairs[1]]
    return np.stack([np.bincount(ids.ravel(), minlength=size + 1) for ids in (pairs, equal)])


def following(counts: np.ndarray) -> np.ndarray:
    """Return the shares of neighbours with the same label beyond what chance gives, at most 1.

    Returns:
        (K + 2,) the share of each train id, and last the share of all points; random labels have
        about 0, and NaN says that too few points have neighbours.
    """
    found, equal = np.column_stack([counts, counts.sum(axis=1)])
    chance = counts[0] / max(found[-1], 1)
    chance = np.append(chance, (chance**2).sum())
    with np.errstate(invalid="ignore", divide="ignore"):
        shares: np.ndarray = (equal / found - chance) / (1 - chance)
    shares[(found < MIN_NEIGHBOURS) | (chance == 1)] = np.nan
    return shares


def raised(xyz: np.ndarray, labels: np.ndarray, is_ground: np.ndarray) -> np.ndarray:
    """Count the points of the ground that are high above others at the same place.

    A file may have any axis up. If many points of the ground are raised along z, the axis counts
    across which the points cover the largest area, in the direction that raises fewer of them.

    Args:
        is_ground: (K + 1,) bool, whether each train id is of the ground.

    Returns:
        (K + 1,) int64 counts by train id.
    """
    ground = is_ground[labels]
    is_raised = ground & (_over_lowest(xyz) > RAISED)
    if is_raised.sum() > MAX_RAISED * ground.sum():
        level = max((np.roll(xyz, turn, axis=1) for turn in range(3)), key=_area)
        both = (ground & (_over_lowest(points) > RAISED) for points in (level, -level))
        is_raised = min(both, key=np.sum)
    counts: np.ndarray = np.bincount(labels[is_raised], minlength=len(is_ground))
    return counts


def _area(xyz: np.ndarray) -> int:
    """Return the area that points (N, 3) cover along x and y, square metres."""
    return int(_grouped(np.floor(xyz[:, :2]).astype(np.int64))[1].sum())


def _over_lowest(xyz: np.ndarray) -> np.ndarray:
    """Return the (N,) heights of points over the lowest one of the same square metre, metres."""
    order, is_first = _grouped(np.floor(xyz[:, :2]).astype(np.int64))
    height = xyz[order, 2]
    lowest = np.minimum.reduceat(height, np.flatnonzero(is_first))
    heights: np.ndarray = np.empty_like(height)
    heights[order] = height - lowest[np.cumsum(is_first) - 1]
    return heights


def _grouped(cells: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the order that joins points of one cell (N, 2 or 3), and which points begin a cell."""
    key = np.zeros(len(cells), dtype=np.int64)
    for axis in cells.T:
        key = key * 100_003 + axis  # wraps around; two cells share a key only by rare chance
    order = np.argsort(key, kind="stable")
    return order, np.diff(key[order], prepend=key[order[:1]] - 1) != 0


def coarse_names(taxonomy: Taxonomy) -> list[str]:
    """Return the K + 1 names of coarse classes by train id, "unlabelled" for unknown names."""
    coarse = class_map("coarse")
    names = coarse.target.names
    return [names[0], *(names[coarse.train_id(name.lower())] for name in taxonomy.classes)]


def scattered_classes(counts: np.ndarray, taxonomy: Taxonomy) -> Iterator[str]:
    """Yield the classes whose points are spread like random ones, given `neighbours`."""
    for train_id in np.flatnonzero(following(counts)[:-1] < MIN_FOLLOWING_CLASS):
        yield taxonomy.names[train_id]


def raised_classes(counts: np.ndarray, points: np.ndarray, taxonomy: Taxonomy) -> Iterator[str]:
    """Yield the classes with many `raised` ones of their (K + 1,) points, and the share."""
    shares = counts / np.maximum(points, 1)
    for train_id in np.flatnonzero((shares > MAX_RAISED) & (points >= MIN_NEIGHBOURS)):
        yield f"{taxonomy.names[train_id]} ({shares[train_id]:.0%})"


def frequent_classes(points: np.ndarray, taxonomy: Taxonomy) -> Iterator[str]:
    """Yield the classes with more of the (K + 1,) points than on any street, with their share."""
    shares = points / max(points.sum(), 1)
    for train_id, coarse in enumerate(coarse_names(taxonomy)):
        if shares[train_id] > MAX_SHARES.get(coarse, 1):
            yield f"{taxonomy.names[train_id]} ({shares[train_id]:.0%})"
