"""The first clusters of a ranking from above: where they are, and what each view and the label take them for."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from amvnet.data.datasets.base import Dataset
from amvnet.evaluation.top_view import draw_scan
from amvnet.inference.segmenter import Segmenter, check_scan
from amvnet.ranking.rank import Criterion, Ranking, find_clusters, find_doubts

PICTURES = 12  # clusters that are drawn
REACH = 8.0  # metres from the cluster to each side
DEEP = 6.0  # metres above and below it: what is farther would hide it


def draw(
    ranking: Ranking, dataset: Dataset, segmenter: Segmenter, by: Criterion, folder: Path
) -> list[Path]:
    """Draw the first clusters, each with its surroundings; returns the files, RANK.png."""
    return [
        _draw(row, ranking, dataset, segmenter, by, folder / f"{place:02d}.png")
        for place, row in enumerate(ranking.clusters[:PICTURES], start=1)
    ]


def _draw(
    row: np.void,
    ranking: Ranking,
    dataset: Dataset,
    segmenter: Segmenter,
    by: Criterion,
    path: Path,
) -> Path:
    record = ranking.records[row["scan"]]
    scan = check_scan(dataset.read(record))
    doubts = find_doubts(scan, segmenter, by)
    _, of = find_clusters(doubts)
    points = scan.points[:, :3] - row["xyz"]
    near = (np.abs(points) <= (REACH, REACH, DEEP)).all(axis=1)
    panels = {
        "rv": doubts.rv,
        "bev": doubts.bev,
        **({} if scan.labels is None else {"label": doubts.label}),
    }
    x, y, z = row["xyz"]
    return draw_scan(
        path,
        points[near],
        dataset.taxonomy,
        {name: ids[near] for name, ids in panels.items()},
        uncertain=(of == of[row["point"]])[near],
        title=f"{record.name}, around ({x:.1f}, {y:.1f}, {z:.1f}) m",
        reach=REACH,
        marked="cluster",
    )
