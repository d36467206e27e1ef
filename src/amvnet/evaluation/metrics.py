"""Count confusion matrices, and apply the official formulas of both benchmarks to them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any

import numpy as np

from amvnet.data.taxonomy import Taxonomy
from amvnet.errors import InputError
from amvnet.files import Signature

REPORT = Signature("figures of evaluate", rb'\{\s*"dataset": ')
# Edges of the bins in SemanticKITTI's evaluation by distance, metres.
EDGES = (0.0, 10.0, 20.0, 30.0, 40.0, 50.0)

# Titles of the figures over all classes, in the order of the rows of tables.
OVERALL = {
    "miou": "mIoU",
    "miou_present": "mIoU, classes present",
    "accuracy": "accuracy",
    "fwiou": "fwIoU",
}


def confusion(truth: np.ndarray, prediction: np.ndarray, size: int) -> np.ndarray:
    """Count how often each true class was predicted as each class, ids (N,) in 0..K = `size`.

    Returns:
        (K + 1, K + 1) int64. The row is the true id, the column the predicted id.

    Raises:
        InputError: if the arrays differ in length, or an id is outside 0..K.
    """
    truth = np.asarray(truth)
    prediction = np.asarray(prediction)
    if truth.shape != prediction.shape or truth.ndim != 1:
        raise InputError(
            "expected true and predicted ids of one shape (N,), "
            f"found {truth.shape} and {prediction.shape}; give the prediction of this scan"
        )
    _check_ids(truth, "true", size)
    _check_ids(prediction, "predicted", size)

    cells = truth.astype(np.int64) * (size + 1) + prediction
    counts = np.bincount(cells, minlength=(size + 1) ** 2)
    return counts.reshape(size + 1, size + 1)


def _check_ids(ids: np.ndarray, kind: str, size: int) -> None:
    if len(ids) and not 0 <= ids.min() <= ids.max() <= size:
        raise InputError(
            f"expected {kind} ids 0..{size}, found {ids.min()}..{ids.max()}; "
            "map raw labels to train ids first"
        )


def metrics(matrix: np.ndarray, taxonomy: Taxonomy) -> dict[str, Any]:
    """Apply the benchmark's formulas to a confusion matrix.

    Points without a true class (row 0) never count. A labelled point whose predicted id is 0
    (column 0) is wrong, as one whose predicted class a map does not name. SemanticKITTI's tool
    alone leaves it out of the accuracy; nuScenes' tool does not allow such predictions.

    Args:
        matrix: (K + 1, K + 1) counts, truth by prediction.
        taxonomy: the classes. Its `counts_absent` says whether the rules of SemanticKITTI's tool
            hold: a class that is neither in the truth nor predicted counts in the mIoU, as 0.

    Returns:
        Figures in [0, 1], or None where no point counts: "miou" (official), "miou_present" (the
        mIoU over the classes in the truth), "accuracy" and "fwiou" (the IoU weighted by the
        frequency in the truth). "iou" is a dictionary with the IoU of each class by its name.
    """
    labelled = matrix[1:].astype(np.float64)  # (K, K + 1)
    correct = np.diagonal(labelled[:, 1:])
    true_counts = labelled.sum(axis=1)
    predicted_counts = labelled[:, 1:].sum(axis=0)
    union = true_counts + predicted_counts - correct
    iou = np.divide(correct, union, out=np.zeros_like(correct), where=union > 0)

    present = true_counts > 0
    averaged = union > 0
    judged = true_counts
    if taxonomy.counts_absent:
        averaged = np.full(len(iou), True)
        judged = predicted_counts

    iou_by_class: dict[str, float | None] = {}
    for index, name in enumerate(taxonomy.classes):
        iou_by_class[name] = float(iou[index]) if union[index] > 0 else None

    return {
        "miou": _ratio(iou[averaged].sum(), averaged.sum()),
        "miou_present": _ratio(iou[present].sum(), present.sum()),
        "accuracy": _ratio(correct.sum(), judged.sum()),
        "fwiou": _ratio((true_counts * iou).sum(), true_counts.sum()),
        "iou": iou_by_class,
    }


def _ratio(part: float, whole: float) -> float | None:
    return float(part / whole) if whole else None


@dataclass
class Evaluation:
    """The confusion counts of any number of scans, for any number of methods.

    Attributes:
        matrices: (bins + 1, K + 1, K + 1) counts by method. The first matrix counts all points.
            Each of the others counts the points between two `EDGES`. Points exactly on an edge are
            in no bin, as in SemanticKITTI's tool.
        points: number of points in these scans, labelled or not.
        asked: number of points for which it is known whether they are uncertain.
    """

    taxonomy: Taxonomy
    matrices: dict[str, np.ndarray] = field(default_factory=dict)
    scans: int = 0
    points: int = 0
    uncertain: int = 0
    asked: int = 0

    def add(
        self,
        points: np.ndarray,
        truth: np.ndarray,
        predictions: Mapping[str, np.ndarray],
        uncertain: np.ndarray | None = None,
    ) -> None:
        """Count one scan.

        Args:
            points: (N, 3 or more) x, y, z in metres.
            truth: (N,) train ids.
            predictions: (N,) train ids by method.
            uncertain: (N,) bool, or None if it is not known which points are uncertain.

        Raises:
            InputError: if the ids do not fit (`confusion`). The scan is then not counted at all.
        """
        size = self.taxonomy.size
        distances = np.linalg.norm(points[:, :3], axis=1)
        counts = {}
        for method, ids in predictions.items():
            matrices = [confusion(truth, ids, size)]
            for near, far in pairwise(EDGES):
                is_between = (near < distances) & (distances < far)
                matrices.append(confusion(truth[is_between], ids[is_between], size))
            counts[method] = np.stack(matrices)
        self._add_counts(counts)

        self.scans += 1
        self.points += len(points)

        if uncertain is not None:
            self.uncertain += int(np.count_nonzero(uncertain))
            self.asked += len(uncertain)

    def __add__(self, other: Evaluation) -> Evaluation:
        """Return the evaluation of the scans of both evaluations, which must have equal classes."""
        total = Evaluation(self.taxonomy)
        for part in (self, other):
            total._add_counts(part.matrices)
            total.scans += part.scans
            total.points += part.points
            total.uncertain += part.uncertain
            total.asked += part.asked
        return total

    def report(self, dataset: str) -> dict[str, Any]:
        """Return all metrics, over all points and by distance, as a dictionary for JSON."""
        methods = {}
        for method, matrices in self.matrices.items():
            bins = []
            for (near, far), matrix in zip(pairwise(EDGES), matrices[1:], strict=True):
                extent = {"from_m": float(near), "to_m": float(far), "points": int(matrix.sum())}
                bins.append({**extent, **metrics(matrix, self.taxonomy)})
            methods[method] = {**metrics(matrices[0], self.taxonomy), "by_distance": bins}

        return {
            "dataset": dataset,
            "scans": self.scans,
            "points": self.points,
            "uncertain_fraction": _ratio(self.uncertain, self.asked),
            "methods": methods,
        }

    def _add_counts(self, counts: Mapping[str, np.ndarray]) -> None:
        for method, matrices in counts.items():
            self.matrices[method] = self.matrices.get(method, 0) + matrices
