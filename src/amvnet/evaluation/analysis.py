"""Analyse weights as the paper's section 4.4 does: agreement, mIoU by distance, sweep of tau."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from amvnet.data.datasets.base import Dataset
from amvnet.data.recordings import ScanFile
from amvnet.data.taxonomy import Taxonomy
from amvnet.errors import InputError
from amvnet.evaluation.metrics import Evaluation, metrics
from amvnet.evaluation.scoring import stream_labelled
from amvnet.inference.segmentation import expand_labels, expand_to_scan, scores_by_method
from amvnet.inference.segmenter import Segmenter
from amvnet.models.amvnet import replace_rows
from amvnet.models.assertion import Disagreement, cosine_similarity, disputed_points
from amvnet.models.methods import METHODS
from amvnet.progress import Progress, no_progress
from amvnet.scan import Scan, check_scan

BINS = 100  # number of equal bins of the cosine similarity, which lies in [0, 1]
SWEPT_BINS = 98  # number of bins that the head classifies at the largest tau, 0.98

# AMVNet's figures for one value of a parameter: the value; and the share of uncertain points, the
# mIoU and the accuracy, each in percent.
SweptRow = tuple[float, float, float, float]


@dataclass
class Analysis:
    """Counts over some scans.

    Attributes:
        evaluation: the evaluation of every method that the weights have, including the three
            ensembles.
        points: (BINS,) number of points by similarity, labelled or not.
        ensemble: (BINS, K + 1, K + 1) confusion matrices of the geometric mean, by similarity.
        head: (SWEPT_BINS, K + 1, K + 1) confusion matrices of the point head, by similarity.
    """

    evaluation: Evaluation
    tau: float
    points: np.ndarray
    ensemble: np.ndarray
    head: np.ndarray

    def add(self, other: Analysis) -> None:
        """Add the counts over other scans."""
        self.evaluation += other.evaluation
        self.points += other.points
        self.ensemble += other.ensemble
        self.head += other.head

    def sweep(self) -> list[SweptRow]:
        """Return AMVNet's figures for each tau from 0 to 0.98. The head is not trained again."""
        sweep = []
        for bins in range(SWEPT_BINS + 1):
            matrix = self.head[:bins].sum(axis=0) + self.ensemble[bins:].sum(axis=0)
            share = float(self.points[:bins].sum() / max(self.points.sum(), 1))
            sweep.append(swept_row(bins / BINS, share, matrix, self.evaluation.taxonomy))
        return sweep


def swept_row(value: float, uncertain: float, matrix: np.ndarray, taxonomy: Taxonomy) -> SweptRow:
    """Return the row of one value of a parameter.

    Args:
        uncertain: share of uncertain points, in [0, 1].
        matrix: (K + 1, K + 1) confusion matrix of AMVNet.
    """
    figures = metrics(matrix, taxonomy)
    return value, 100 * uncertain, 100 * (figures["miou"] or 0), 100 * (figures["accuracy"] or 0)


def analyze(
    dataset: Dataset,
    records: Sequence[ScanFile],
    segmenter: Segmenter,
    progress: Progress = no_progress,
) -> Analysis:
    """Score labelled scans by every method, and by the head on all points that some tau selects.

    Args:
        segmenter: segments the scans; its method is "amvnet".

    Raises:
        InputError: if the weights lack a part, or a scan has no true labels.
    """
    assertion = segmenter.model.assertion
    if segmenter.method != "amvnet" or not isinstance(assertion, Disagreement):
        raise InputError(
            "expected weights with both networks and a head, found others; train the missing parts"
        )

    size = dataset.taxonomy.size + 1
    total = Analysis(
        Evaluation(dataset.taxonomy),
        assertion.tau,
        points=np.zeros(BINS, dtype=np.int64),
        ensemble=np.zeros((BINS, size, size), dtype=np.int64),
        head=np.zeros((SWEPT_BINS, size, size), dtype=np.int64),
    )

    def analyze_one(record: ScanFile, scan: Scan) -> Analysis:
        return _analyze_scan(check_scan(scan), segmenter, assertion)

    for analysis in stream_labelled(dataset, records, analyze_one, segmenter.at_once, progress):
        total.add(analysis)
    return total


@torch.inference_mode()
def _analyze_scan(scan: Scan, segmenter: Segmenter, assertion: Disagreement) -> Analysis:
    """Score a scan by every method, and by the head on all points that some tau selects."""
    batch = segmenter.batch([scan])
    scores = segmenter.engine.score(batch)
    f = scores.rv
    g = scores.bev
    assert f is not None
    assert g is not None

    # Compute the labels of every method.
    by_method = scores_by_method(scores, segmenter.method, METHODS)
    ids = {name: expand_labels(values, scan.valid) for name, values in by_method.items()}
    uncertain = expand_to_scan(scores.uncertain, scan.valid)

    # Compute the head's labels of all points that some tau selects.
    more = (_bins(f, g) < SWEPT_BINS) & ~scores.uncertain
    more = disputed_points(f, g, more, segmenter.model.lead)
    h = segmenter.model.refine(batch, f, g, more)
    assert h is not None
    head = expand_labels(replace_rows(scores.merged, more, h), scan.valid)

    # The networks agree on points that they do not see (id 0), whatever tau is.
    bins = np.where(scan.valid, expand_to_scan(_bins(f, g), scan.valid), BINS - 1)

    truth = scan.labels
    assert truth is not None
    evaluation = Evaluation(segmenter.taxonomy)
    evaluation.add(scan.points, truth, ids, uncertain=uncertain)
    size = segmenter.taxonomy.size + 1
    return Analysis(
        evaluation,
        assertion.tau,
        points=np.bincount(bins, minlength=BINS),
        ensemble=_confusions(bins, truth, ids["ensemble"], size),
        head=_confusions(bins, truth, head, size)[:SWEPT_BINS],
    )


def _bins(f: Tensor, g: Tensor) -> Tensor:
    """Return the (P,) bin of each point's similarity. Bin b holds (b / BINS, (b + 1) / BINS]."""
    return (cosine_similarity(f, g) * BINS).ceil().long().clamp(1, BINS) - 1


def _confusions(bins: np.ndarray, truth: np.ndarray, ids: np.ndarray, size: int) -> np.ndarray:
    """Return the confusion matrix of the points in each bin, (BINS, size, size)."""
    cells = (bins * size + truth) * size + ids
    return np.bincount(cells, minlength=BINS * size * size).reshape(BINS, size, size)
