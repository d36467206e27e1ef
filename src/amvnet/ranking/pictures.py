"""Draw the first clusters of a ranking from above, as predicted by both views and as labelled."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from amvnet.data.datasets.base import Dataset
from amvnet.evaluation.top_view import TopView, draw_scan
from amvnet.inference.reading import check_scan
from amvnet.inference.segmenter import Segmenter
from amvnet.ranking.label_errors import Ranking, find_clusters, find_doubts
from amvnet.scan import Scan

PICTURES = 12  # clusters that are drawn
REACH = 8.0  # metres from the cluster to each side
DEPTH = 6.0  # metres above and below it: higher points, such as treetops, would hide it


def draw(ranking: Ranking, dataset: Dataset, segmenter: Segmenter, folder: Path) -> list[Path]:
    """Draw each of the first clusters with its surroundings, and return the files (RANK.png)."""
    segmenter = segmenter.for_dataset(dataset)
    paths = []
    for row, path in zip(ranking.clusters, possible_files(folder), strict=False):
        record = ranking.records[row["scan"]]
        scan = check_scan(dataset.read(record))
        draw_scan(path, _view_of_cluster(row, scan, segmenter))
        paths.append(path)

    return paths


def possible_files(folder: Path) -> list[Path]:
    """Return the paths of all files that `draw` may write into a folder."""
    return [folder / f"{position:02d}.png" for position in range(1, PICTURES + 1)]


def _view_of_cluster(row: np.void, scan: Scan, segmenter: Segmenter) -> TopView:
    """Return a cluster of a scan and its surroundings, by both views and by the labels."""
    doubts = find_doubts(scan, segmenter)
    _, cluster_ids = find_clusters(doubts)
    in_cluster = cluster_ids == cluster_ids[row["point"]]

    xyz = scan.points[:, :3] - row["xyz"]  # relative to the cluster's middle point
    near = (np.abs(xyz) <= (REACH, REACH, DEPTH)).all(axis=1)
    panels = {"rv": doubts.rv[near], "bev": doubts.bev[near], "label": doubts.label[near]}

    x, y, z = row["xyz"]
    return TopView(
        xyz[near],
        segmenter.taxonomy,
        panels,
        uncertain=in_cluster[near],
        title=f"{scan.name}, around ({x:.1f}, {y:.1f}, {z:.1f}) m",
        reach=REACH,
        marked="cluster",
    )
