"""What the paper shows of the method: who agrees where, mIoU by distance, and sweeps of tau and n (section 4)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch

from amvnet.data.datasets.base import Dataset, ScanRecord
from amvnet.data.taxonomy import Taxonomy
from amvnet.errors import InputError
from amvnet.evaluation import scoring as jobs
from amvnet.evaluation.metrics import Evaluation, metrics
from amvnet.inference.segmenter import Segmenter, check_scan, expand_labels, expand_to_scan
from amvnet.models.amvnet import ENSEMBLES, merge, refine
from amvnet.models.assertions import Disagreement, cosine_similarity
from amvnet.models.views.points import PointBatch
from amvnet.scan import Scan

BINS = 100  # of the cosine similarity, which is in [0, 1]
SWEPT = 98  # bins of the lower similarities for which the head is asked: tau is swept up to 0.98


@dataclass(frozen=True)
class Swept:
    """AMVNet with one value of a swept parameter: share of uncertain points, mIoU and accuracy as fractions."""

    value: float
    uncertain: float
    miou: float
    accuracy: float

    @classmethod
    def of(cls, value: float, uncertain: float, matrix: np.ndarray, taxonomy: Taxonomy) -> Swept:
        """From a (K + 1, K + 1) confusion matrix."""
        reached = metrics(matrix, taxonomy)
        return cls(value, uncertain, reached["miou"] or 0.0, reached["accuracy"] or 0.0)


@dataclass
class Analysis:
    """Counts over some scans.

    Attributes:
        evaluation: every method that the weights have, the three ensembles among them.
        tau: of the weights.
        points: (BINS,) how many points have which similarity, labelled or not.
        ensemble: (BINS, K + 1, K + 1) confusion of the geometric mean by the points' similarity.
        head: (SWEPT, K + 1, K + 1) the same of the point head.
    """

    evaluation: Evaluation
    tau: float
    points: np.ndarray
    ensemble: np.ndarray
    head: np.ndarray

    @property
    def taxonomy(self) -> Taxonomy:
        return self.evaluation.taxonomy

    def sweep(self) -> list[Swept]:
        """AMVNet for each tau from 0 to 0.98, with the head as it is."""
        found = []
        for bins in range(SWEPT + 1):
            matrix = self.head[:bins].sum(axis=0) + self.ensemble[bins:].sum(axis=0)
            share = float(self.points[:bins].sum() / max(self.points.sum(), 1))
            found.append(Swept.of(bins / BINS, share, matrix, self.taxonomy))
        return found


def analyze(
    dataset: Dataset,
    records: Sequence[ScanRecord],
    segmenter: Segmenter,
    progress: jobs.Progress = lambda done, total: None,
) -> Analysis:
    """Score some labelled scans once by every method, and by the head wherever a swept tau would ask it.

    Raises:
        InputError: where the weights lack a part, or a scan has no labels.
    """
    assertion = segmenter.model.assertion
    if segmenter.method != "amvnet" or not isinstance(assertion, Disagreement):
        raise InputError(
            "expected weights with both networks, a head and the disagreement assertion; train these"
        )
    size = dataset.taxonomy.size + 1
    found = Analysis(
        Evaluation(dataset.taxonomy),
        assertion.tau,
        np.zeros(BINS, dtype=np.int64),
        np.zeros((BINS, size, size), dtype=np.int64),
        np.zeros((SWEPT, size, size), dtype=np.int64),
    )
    for _, scan in jobs.read_labelled(dataset, records, progress):
        _add(found, check_scan(scan), segmenter)
    return found


@torch.inference_mode()
def _add(found: Analysis, scan: Scan, segmenter: Segmenter) -> None:
    model, batch = segmenter.model, PointBatch.of([scan]).to(segmenter.device)
    f, g = model.score_range_view(batch), model.score_polar_view(batch)
    uncertain = model.assertion(f, g, batch.points)
    place = (cosine_similarity(f, g) * BINS).ceil().long().clamp(
        1, BINS
    ) - 1  # in (place, place + 1] / BINS
    asked = (place < SWEPT) | uncertain
    assert model.point_head is not None
    h = refine(model.point_head, batch.points, f, g, asked)
    scores = {"rv": f, "bev": g, **{name: mean(f, g) for name, mean in ENSEMBLES.items()}}
    scores["amvnet"] = merge(f, g, uncertain, h[uncertain[asked]])
    scores["head"] = merge(f, g, asked, h)
    ids = {name: expand_labels(values, scan.valid) for name, values in scores.items()}
    head = ids.pop("head")
    assert scan.labels is not None
    truth, size = scan.labels, len(found.ensemble[0])
    found.evaluation.add(scan.points, truth, ids, expand_to_scan(uncertain, scan.valid))
    # Points that no network has seen count as agreed on, with id 0, whatever tau is.
    bins = np.where(scan.valid, expand_to_scan(place, scan.valid), BINS - 1)
    found.points += np.bincount(bins, minlength=BINS)
    found.ensemble += _by_bin(bins, truth, ids["ensemble"], BINS, size)
    swept = bins < SWEPT
    found.head += _by_bin(bins[swept], truth[swept], head[swept], SWEPT, size)


def _by_bin(
    bins: np.ndarray, truth: np.ndarray, ids: np.ndarray, count: int, size: int
) -> np.ndarray:
    """(count, size, size) confusion matrices of points by their bin."""
    place = (bins * size + truth) * size + ids
    return np.bincount(place, minlength=count * size * size).reshape(count, size, size)
