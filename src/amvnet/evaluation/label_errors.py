"""Rank points whose labels may be wrong, because both views contradict them.

The points are divided into clusters. The most doubtful clusters come first.
"""

from __future__ import annotations

import csv
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from amvnet.data.datasets.base import Dataset
from amvnet.data.recordings import ScanFile
from amvnet.data.taxonomy import Taxonomy, check_classes
from amvnet.errors import InputError
from amvnet.files import Signature, atomic_write
from amvnet.inference.scan_stream import stream_scans
from amvnet.inference.segmentation import expand_labels, expand_to_scan
from amvnet.inference.segmenter import Segmenter
from amvnet.progress import Progress, no_progress
from amvnet.scan import Scan, check_scan

CELL = 0.4  # side of a cell, metres; points in the same cell or in touching cells are connected
# The indices of cells that touch, even if only at a corner, are at most sqrt(3) apart. The indices
# of other cells are at least 2 apart.
TOUCHING = 1.75  # a distance between these two, cells
APART = 4.0  # least distance between cells of different kinds, cells
# The radius of the sensor's vehicle, metres. Nearer points are never doubted.
VEHICLE_RADIUS = 1.5
# The number of additional points with doubt 0 in the mean doubt of a cluster. They keep clusters of
# a few stray points from the first ranks.
ADDED_POINTS = 20.0
# The power of the number of clusters of the same kind by which a score is divided. If a
# contradiction occurs often, the views are more likely to be wrong than the labels.
COMMON_POWER = 0.5

COLUMNS = ("rank", "scan", "score", "x", "y", "z", "points", "point", "rv", "bev", "label")
TABLE = Signature("a table of rank", ",".join(COLUMNS).encode())

# The row of a cluster. The middle point of a cluster is the point nearest to the mean of its
# points.
ROW = np.dtype(
    [
        ("scan", np.int32),  # index of the scan among the ranked scans
        ("score", np.float32),
        ("xyz", np.float32, 3),  # position of the middle point, metres
        ("points", np.int32),  # number of points
        ("point", np.int32),  # index of the middle point in the scan
        ("rv", np.uint8),  # most common train id predicted by the range view
        ("bev", np.uint8),  # most common train id predicted by the bird's-eye view
        ("label", np.uint8),  # train id of the middle point's label
        ("kind", np.int32),  # `PointDoubts.kind` of its points
    ]
)


@dataclass(frozen=True)
class PointDoubts:
    """How doubtful the label of each of the N points of a scan is.

    Attributes:
        doubt: (N,) float32, in [0, 1]; 0 for points that are not doubted.
        rv: (N,) train ids predicted by the range view.
        bev: (N,) train ids predicted by the bird's-eye view.
        label: (N,) train ids of the labels.
        kind: (N,) a number for the pair of the label and the class that both views agree on. All
            points of a cluster have the same kind.
        whole: (N,) number of points in the labelled thing to which the point belongs.
    """

    xyz: np.ndarray
    doubt: np.ndarray
    rv: np.ndarray
    bev: np.ndarray
    label: np.ndarray
    kind: np.ndarray
    whole: np.ndarray


def rank(
    dataset: Dataset,
    records: Sequence[ScanFile],
    segmenter: Segmenter,
    progress: Progress = no_progress,
) -> np.ndarray:
    """Return the doubtful clusters of some labelled scans, (C,) of `ROW`, most doubtful first.

    Raises:
        InputError: if the weights lack a network or do not have the dataset's classes, or a scan
            has no labels.
    """
    check_classes(dataset.spec, dataset.taxonomy, segmenter.taxonomy)
    if not {"range_net", "polar_net"} <= set(segmenter.weights.parts):
        raise InputError("expected weights with both networks, found only one; train the other")

    def rank_scan(record: ScanFile, scan: Scan) -> np.ndarray:
        return find_clusters(measure_doubts(check_scan(scan), segmenter))

    rows_by_scan = [np.zeros(0, dtype=ROW)]  # in case there are no scans
    for rows in stream_scans(records, dataset.read, rank_scan, segmenter.at_once, progress):
        rows["scan"] = len(rows_by_scan) - 1
        rows_by_scan.append(rows)

    clusters = np.concatenate(rows_by_scan)
    _, kind, counts = np.unique(clusters["kind"], return_inverse=True, return_counts=True)
    clusters["score"] /= counts[kind] ** COMMON_POWER
    # A stable sort keeps equal scores in the dataset's order, on every machine.
    return clusters[np.argsort(-clusters["score"], kind="stable")]


def measure_doubts(scan: Scan, segmenter: Segmenter) -> PointDoubts:
    """Return how doubtful each label of a scan is; raise InputError if the scan has no labels."""
    label = scan.labels
    if label is None:
        raise InputError(
            f"{scan.name}: expected labels to check, found none; choose sequences with labels"
        )

    valid = scan.valid
    result = segmenter(scan)
    assert result.rv is not None
    assert result.bev is not None
    f = torch.from_numpy(result.rv[valid])  # (P, K) class probabilities of the P valid points
    g = torch.from_numpy(result.bev[valid])  # (P, K)
    rv = expand_labels(f, valid)
    bev = expand_labels(g, valid)

    xyz = scan.points[:, :3]
    distance = np.hypot(xyz[valid, 0], xyz[valid, 1])
    off_vehicle = torch.from_numpy(distance >= VEHICLE_RADIUS)  # (P,)

    contradiction, agreed_ids = _contradiction(f, g, torch.from_numpy(label[valid]))
    doubt = expand_to_scan(contradiction * off_vehicle, valid)
    # Each pair of train ids becomes one number.
    kind = label.astype(np.int64) * 256 + expand_to_scan(agreed_ids, valid)
    whole = _thing_sizes(xyz, label, valid)
    return PointDoubts(xyz, doubt, rv=rv, bev=bev, label=label, kind=kind, whole=whole)


def _contradiction(
    f: torch.Tensor, g: torch.Tensor, label: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor]:
    """Return how strongly both views (P, K) contradict the labels, and the class they agree on.

    Each view gives a probability to the class that both agree on, and a probability to the label.
    The contradiction is the smaller probability of the class minus the larger probability of the
    label, in [0, 1]. It is 0 if this difference is negative, or if the point has no label.
    """
    agreed = (f * g).argmax(dim=1)
    column = (label.long() - 1).clamp_min(0)

    for_label = torch.maximum(f, g).gather(1, column[:, None])[:, 0]
    for_agreed = torch.minimum(f, g).gather(1, agreed[:, None])[:, 0]
    contradiction = (for_agreed - for_label).clamp_min(0) * (label > 0)
    return contradiction, (agreed + 1).to(torch.uint8)


def _thing_sizes(xyz: np.ndarray, label: np.ndarray, valid: np.ndarray) -> np.ndarray:
    """Return the (N,) number of points in the thing to which each point belongs.

    A thing is a set of connected points with one label. Each point that is not valid is a thing of
    its own.
    """
    things = cluster(xyz[valid], label[valid])
    sizes = np.ones(len(xyz))
    sizes[valid] = np.bincount(things)[things]
    return sizes


def find_clusters(doubts: PointDoubts) -> np.ndarray:
    """Divide the doubted points of one scan into clusters, and return the (C,) rows of `ROW`."""
    doubted = np.flatnonzero(doubts.doubt > 0)
    group = cluster(doubts.xyz[doubted], doubts.kind[doubted])
    sizes = np.bincount(group)
    middle = doubted[_middle_points(doubts.xyz[doubted], group, sizes)]
    total_doubt = np.bincount(group, doubts.doubt[doubted])
    # A cluster that is a whole labelled thing counts more than a cluster at the edge of a thing.
    share = sizes / doubts.whole[middle]

    rows = np.zeros(len(sizes), dtype=ROW)
    rows["score"] = share * total_doubt / (sizes + ADDED_POINTS)
    rows["xyz"] = doubts.xyz[middle]
    rows["points"] = sizes
    rows["point"] = middle
    rows["rv"] = _most_common(doubts.rv[doubted], group, len(sizes))
    rows["bev"] = _most_common(doubts.bev[doubted], group, len(sizes))
    rows["label"] = doubts.label[middle]
    rows["kind"] = doubts.kind[middle]
    return rows


def _middle_points(
    xyz: NDArray[np.floating], group: NDArray[np.intp], sizes: NDArray[np.intp]
) -> NDArray[np.intp]:
    """Return for each group the index of the point nearest to the mean."""
    mean = np.stack([np.bincount(group, axis) / sizes for axis in xyz.T], axis=1)
    squared_distance = ((xyz - mean[group]) ** 2).sum(axis=1)
    order = np.lexsort((squared_distance, group))
    group_starts = np.cumsum(sizes) - sizes

    nearest: NDArray[np.intp] = order[group_starts]
    return nearest


def _most_common(ids: NDArray[np.integer], group: NDArray[np.intp], count: int) -> NDArray[np.intp]:
    """Return the most common id in each of `count` groups; among equals, the lowest id."""
    table = np.zeros((count, 256), dtype=np.int32)
    np.add.at(table, (group, ids), 1)
    most_common: NDArray[np.intp] = table.argmax(axis=1)
    return most_common


def write_clusters(
    clusters: np.ndarray, records: Sequence[ScanFile], taxonomy: Taxonomy, path: Path
) -> None:
    """Write clusters, sorted rows of `ROW`, to a CSV file with their ranks in the first column."""
    names = ("", *taxonomy.classes)
    with atomic_write(path) as part, part.open("w", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(COLUMNS)

        for position, row in enumerate(clusters, start=1):
            x, y, z = row["xyz"]
            values = [
                position,
                records[row["scan"]].name,
                f"{row['score']:.4f}",
                f"{x:.2f}",
                f"{y:.2f}",
                f"{z:.2f}",
                row["points"],
                row["point"],
                names[row["rv"]],
                names[row["bev"]],
                names[row["label"]],
            ]
            writer.writerow(values)


def cluster(xyz: np.ndarray, kind: np.ndarray) -> np.ndarray:
    """Return the (N,) int64 cluster of each point, numbered from 0.

    Args:
        xyz: (N, 3) coordinates, metres.
        kind: (N,) integers. Points of different kinds are never in one cluster.
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
