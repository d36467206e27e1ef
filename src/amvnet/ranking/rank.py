"""What to look at next: clusters of points on which the two views disagree, or whose label both contradict."""

from __future__ import annotations

import csv
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch

from amvnet.data.datasets.base import Dataset, ScanRecord
from amvnet.data.datasets.open import check_classes
from amvnet.data.taxonomy import Taxonomy
from amvnet.errors import InputError
from amvnet.files import atomic_write
from amvnet.inference.segmenter import Segmenter, check_scan, expand_to_scan
from amvnet.models.assertions import cosine_similarity
from amvnet.progress import Progress
from amvnet.ranking.clusters import cluster
from amvnet.scan import Scan

Criterion = Literal["disagreement", "labels"]

NEAR = 1.5  # metres: what is nearer to the sensor is the vehicle that carries it
FEW = 20.0  # points: a cluster counts as if so many more of it were beyond doubt, so that stray points do not lead
COMMON = 0.5  # power of how often the views contradict labels so: a mistake that they make often says less
COLUMNS = ("rank", "scan", "score", "x", "y", "z", "points", "point", "rv", "bev", "label")
SCAN_COLUMNS = ("rank", "scan", "score", "points", "clusters")
ROW = np.dtype(
    [
        ("scan", np.int32),
        ("score", np.float32),
        ("xyz", np.float32, 3),
        ("points", np.int32),
        ("point", np.int32),
        ("rv", np.uint8),
        ("bev", np.uint8),
        ("label", np.uint8),
        ("kind", np.int32),
    ]
)


@dataclass(frozen=True)
class Doubts:
    """What is doubted of a scan with N points.

    Attributes:
        xyz: (N, 3) metres.
        doubt: (N,) float32 in [0, 1], 0 where nothing is doubted.
        rv, bev, label: (N,) train ids: by the two views and by the labels (0 where there is none).
        kind: (N,) of what kind a doubt is; a cluster has points of one kind.
        whole: (N,) number of points of the labelled thing that a point is part of, where the labels are doubted.
    """

    xyz: np.ndarray
    doubt: np.ndarray
    rv: np.ndarray
    bev: np.ndarray
    label: np.ndarray
    kind: np.ndarray
    whole: np.ndarray | None = None


@dataclass(frozen=True)
class Ranking:
    """The clusters and the scans of a data set, the most doubtful first.

    Attributes:
        records: the scans, in the order of their numbers.
        clusters: rows of `ROW`.
        scans: (S,) scan numbers.
        scores: (S,) mean doubt of their points.
        sizes: (S,) their points.
    """

    records: Sequence[ScanRecord]
    clusters: np.ndarray
    scans: np.ndarray
    scores: np.ndarray
    sizes: np.ndarray


def rank(
    dataset: Dataset,
    records: Sequence[ScanRecord],
    segmenter: Segmenter,
    by: Criterion,
    progress: Progress = lambda done, total: None,
) -> Ranking:
    """Rank the clusters of some scans, one scan in memory at a time and 39 bytes a cluster.

    Args:
        by: `disagreement`: where the two views disagree, labelled or not: what to label next. `labels`: where both
            views contradict the label: what may be labelled wrong.

    Raises:
        InputError: where the weights lack a network or know other classes, or labels are asked for and missing.
    """
    check_classes(dataset, segmenter.taxonomy)
    if not {"range_net", "polar_net"} <= set(segmenter.weights.parts):
        raise InputError("expected weights with both networks, found one; train the other, too")
    found, means, sizes = (
        [np.zeros(0, dtype=ROW)],
        np.zeros(len(records)),
        np.zeros(len(records), dtype=np.int64),
    )
    for place, record in enumerate(records):
        progress(place, len(records))
        doubts = find_doubts(check_scan(dataset.read(record)), segmenter, by)
        rows, _ = find_clusters(doubts)
        rows["scan"] = place
        found.append(rows)
        means[place], sizes[place] = doubts.doubt.mean(), len(doubts.doubt)
    progress(len(records), len(records))
    rows = np.concatenate(found)
    if by == "labels":
        rows["score"] /= _times(rows["kind"]) ** COMMON
    # Stable, and so the same on every machine: of equals, the first of the data set leads.
    order, scans = np.argsort(-rows["score"], kind="stable"), np.argsort(-means, kind="stable")
    return Ranking(records, rows[order], scans, means[scans], sizes[scans])


def find_doubts(scan: Scan, segmenter: Segmenter, by: Criterion) -> Doubts:
    """What is doubted of one scan's points.

    Raises:
        InputError: where labels are asked for and the scan has none.
    """
    if by == "labels" and scan.labels is None:
        raise InputError(
            f"{scan.name}: expected labels to doubt, found none; name labelled sequences"
        )
    scores, uncertain = segmenter.scores_by_method(scan, ("rv", "bev"))
    assert uncertain is not None
    f, g = scores["rv"], scores["bev"]
    xyz, valid = scan.points[:, :3], scan.valid
    seen = torch.from_numpy(np.hypot(*scan.points[valid, :2].T) >= NEAR).to(f.device)
    rv, bev = (expand_to_scan((one.argmax(dim=1) + 1).to(torch.uint8), valid) for one in (f, g))
    label = np.zeros(len(scan), dtype=np.uint8) if scan.labels is None else scan.labels
    if by == "disagreement":
        doubt = expand_to_scan(
            (1 - cosine_similarity(f, g)).clamp(0, 1) * (uncertain & seen), valid
        )
        return Doubts(xyz, doubt, rv, bev, label, _pair(rv, bev))
    against, said = _contradicted(f, g, torch.from_numpy(label[valid]).to(f.device))
    doubt, kind = expand_to_scan(against * seen, valid), _pair(label, expand_to_scan(said, valid))
    return Doubts(xyz, doubt, rv, bev, label, kind, _sizes_of_things(xyz, label, valid))


def _sizes_of_things(xyz: np.ndarray, label: np.ndarray, valid: np.ndarray) -> np.ndarray:
    """(N,) how many points the connected thing of one label has that a point is part of."""
    sizes, thing = np.ones(len(xyz)), cluster(xyz[valid], label[valid])
    sizes[valid] = np.bincount(thing)[thing]
    return sizes


def _contradicted(
    f: torch.Tensor, g: torch.Tensor, label: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor]:
    """(P,) by how much the views contradict the labels, and (P,) what they say together.

    Both views must: it is what the less sure one gives that class, less what the other one at most gives the label.
    """
    said = (f * g).argmax(dim=1)
    own = torch.maximum(f, g).gather(1, (label.long() - 1).clamp_min(0)[:, None])[:, 0]
    other = torch.minimum(f, g).gather(1, said[:, None])[:, 0]
    return (other - own).clamp_min(0) * (label > 0), (said + 1).to(torch.uint8)


def find_clusters(doubts: Doubts) -> tuple[np.ndarray, np.ndarray]:
    """The clusters of one scan, rows of `ROW` in no order, and (N,) which of them a point is in, -1 for none."""
    of = np.full(len(doubts.doubt), -1)
    index = np.flatnonzero(doubts.doubt > 0)
    of[index] = group = cluster(doubts.xyz[index], doubts.kind[index])
    size = np.bincount(group)
    rows = np.zeros(len(size), dtype=ROW)
    rows["points"] = size
    rows["point"] = index[_middles(doubts.xyz[index], group, size)]
    # A cluster that is the whole of a labelled thing counts more than one at the edge of it.
    share = 1.0 if doubts.whole is None else size / doubts.whole[rows["point"]]
    rows["score"] = share * np.bincount(group, doubts.doubt[index]) / (size + FEW)
    rows["xyz"] = doubts.xyz[rows["point"]]
    rows["label"], rows["kind"] = doubts.label[rows["point"]], doubts.kind[rows["point"]]
    for name, ids in (("rv", doubts.rv), ("bev", doubts.bev)):
        rows[name] = _commonest(ids[index], group, len(size))
    return rows, of


def _middles(xyz: np.ndarray, group: np.ndarray, size: np.ndarray) -> np.ndarray:
    """Of each group, the place of the point that is nearest to its mean."""
    mean = np.stack([np.bincount(group, column) / size for column in xyz.T], axis=1)
    order = np.lexsort((((xyz - mean[group]) ** 2).sum(axis=1), group))
    return order[np.cumsum(size) - size]


def _commonest(ids: np.ndarray, group: np.ndarray, count: int) -> np.ndarray:
    table = np.zeros((count, 256), dtype=np.int32)
    np.add.at(table, (group, ids), 1)
    return table.argmax(axis=1)


def _pair(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    return first.astype(np.int64) * 256 + second


def _times(kind: np.ndarray) -> np.ndarray:
    """How many of all are of the same kind."""
    _, which, times = np.unique(kind, return_inverse=True, return_counts=True)
    return times[which]


def write_ranking(ranking: Ranking, taxonomy: Taxonomy, path: Path) -> Path:
    """Write the clusters to `path` (CSV), and the scans beside it; returns the latter's file."""
    _write(path, COLUMNS, _cluster_rows(ranking, taxonomy))
    scans = path.with_name(f"{path.stem}-scans{path.suffix}")
    _write(scans, SCAN_COLUMNS, _scan_rows(ranking))
    return scans


def _write(path: Path, columns: Sequence[str], rows: Iterator[list[Any]]) -> None:
    with atomic_write(path) as part, part.open("w", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(columns)
        writer.writerows([place, *row] for place, row in enumerate(rows, start=1))


def _cluster_rows(ranking: Ranking, taxonomy: Taxonomy) -> Iterator[list[Any]]:
    names = ("", *taxonomy.classes)
    for row in ranking.clusters:
        classes = [names[row[column]] for column in ("rv", "bev", "label")]
        place = [f"{value:.2f}" for value in row["xyz"]]
        yield [
            ranking.records[row["scan"]].name,
            f"{row['score']:.4f}",
            *place,
            row["points"],
            row["point"],
            *classes,
        ]


def _scan_rows(ranking: Ranking) -> Iterator[list[Any]]:
    clusters = np.bincount(ranking.clusters["scan"], minlength=len(ranking.records))
    for scan, score, size in zip(ranking.scans, ranking.scores, ranking.sizes, strict=True):
        yield [ranking.records[scan].name, f"{score:.5f}", size, clusters[scan]]
