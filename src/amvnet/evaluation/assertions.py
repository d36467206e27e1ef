"""A comparison of assertions: the same share of the points of each scan is uncertain by each."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field

import numpy as np
import torch
from torch import Tensor

from amvnet.data.datasets.base import Dataset, ScanRecord
from amvnet.evaluation.analysis import Swept
from amvnet.evaluation.metrics import confusion
from amvnet.evaluation.scoring import stream_labelled
from amvnet.inference.segmentation import expand_labels
from amvnet.inference.segmenter import Segmenter, check_scan
from amvnet.models.assertions import cosine_similarity, entropy, margin
from amvnet.progress import Progress, no_progress
from amvnet.scan import Scan

SHARES = (0.05, 0.1, 0.2, 0.3)  # of the points of a scan that are uncertain


def _certainty_of_labels(f: Tensor, g: Tensor) -> Tensor:
    """Return (P,) values: below 1 if the labels differ, by similarity among themselves."""
    is_same = f.argmax(dim=1) == g.argmax(dim=1)
    return cosine_similarity(f, g) + 2 * is_same


# How certain a point is, (P,), given f and g (P, K): the lowest are asked first.
MEASURES: dict[str, Callable[[Tensor, Tensor], Tensor]] = {
    "disagreement": cosine_similarity,
    "entropy": lambda f, g: -entropy(f, g),
    "margin": margin,
    "labels": _certainty_of_labels,
}
FIRST, SECOND = "disagreement", "entropy"  # whose union and intersection are compared, too


@dataclass
class Comparison:
    """Confusion matrices of AMVNet (K + 1, K + 1), by assertion and share of uncertain points."""

    matrices: dict[tuple[str, float], np.ndarray] = field(default_factory=dict)

    def add(self, truth: np.ndarray, ids: dict[tuple[str, float], np.ndarray], size: int) -> None:
        """Add the points of one scan: (N,) train ids of each assertion and share."""
        for key, labels in ids.items():
            matrix = confusion(truth, labels, size)
            self.matrices[key] = self.matrices.get(key, 0) + matrix

    def results(self, dataset: Dataset) -> Iterator[tuple[str, Swept]]:
        """Yield each assertion with its figures, by share."""
        for (name, share), matrix in self.matrices.items():
            yield name, Swept.of(share, share, matrix, dataset.taxonomy)


def compare_assertions(
    dataset: Dataset,
    records: Sequence[ScanRecord],
    segmenter: Segmenter,
    progress: Progress = no_progress,
) -> Comparison:
    """Score labelled scans by AMVNet, asking the head for equal shares by each assertion.

    The head stays as it is: it was trained on the points of its own assertion.
    """

    def label(record: ScanRecord, scan: Scan) -> tuple[Scan, dict[tuple[str, float], np.ndarray]]:
        return scan, _label(check_scan(scan), segmenter)

    comparison = Comparison()
    for scan, ids in stream_labelled(dataset, records, label, segmenter.at_once, progress):
        assert scan.labels is not None
        comparison.add(scan.labels, ids, dataset.taxonomy.size)
    return comparison


@torch.inference_mode()
def _label(scan: Scan, segmenter: Segmenter) -> dict[tuple[str, float], np.ndarray]:
    """Return (N,) train ids of a scan, by assertion and share of uncertain points."""
    model = segmenter.model
    batch = segmenter.batch([scan])
    f, g = model.score(*model.project(batch))

    # The head is asked once, for all points that any assertion finds at the largest share.
    ranks = rank_points(f, g)
    asked = torch.zeros(len(f), dtype=torch.bool, device=f.device)
    for rank in ranks.values():
        asked |= rank < round(max(SHARES) * len(f))
    h = model.refine(batch, f, g, asked)
    assert h is not None

    ids = {}
    for name, rank in ranks.items():
        for share in SHARES:
            uncertain = rank < round(share * len(f))
            merged = model.merge(f, g, uncertain, h[uncertain[asked]])
            ids[name, share] = expand_labels(merged, scan.valid)
    return ids


def rank_points(f: Tensor, g: Tensor) -> dict[str, Tensor]:
    """Return the (P,) ranks of the points by each assertion, from the least certain, 0.

    A union of two assertions has a point's better rank, their intersection its worse one.

    Args:
        f, g: (P, K) class probabilities.
    """
    ranks = {name: _rank(measure(f, g)) for name, measure in MEASURES.items()}
    first = ranks[FIRST]
    second = ranks[SECOND]
    ranks[f"{FIRST} or {SECOND}"] = _rank(torch.minimum(first, second))
    ranks[f"{FIRST} and {SECOND}"] = _rank(torch.maximum(first, second))
    return ranks


def _rank(values: Tensor) -> Tensor:
    """Return the (P,) position of each value in ascending order; of equal ones, the first first."""
    order = values.argsort(stable=True)
    ranks = torch.empty_like(order)
    ranks[order] = torch.arange(len(order), device=order.device)
    return ranks
