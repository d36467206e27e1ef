"""Confusion matrices, and the official formulas of both benchmarks on them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any

import numpy as np

from amvnet.data.taxonomy import Taxonomy
from amvnet.errors import InputError

EDGES = (
    0.0,
    10.0,
    20.0,
    30.0,
    40.0,
    50.0,
)  # metres; those of SemanticKITTI's evaluation by distance


def confusion(truth: np.ndarray, prediction: np.ndarray, size: int) -> np.ndarray:
    """Count how often each true class was given each class.

    Args:
        truth: (N,) ids in 0..K.
        prediction: (N,) ids in 0..K.
        size: K, the number of classes.

    Returns:
        (K + 1, K + 1) int64; the row is the true id, the column the predicted one.

    Raises:
        InputError: where the two differ in length or an id is outside 0..K.
    """
    truth, prediction = np.asarray(truth), np.asarray(prediction)
    if truth.shape != prediction.shape or truth.ndim != 1:
        raise InputError(
            f"expected one predicted id for each of the {truth.shape} true ids, found {prediction.shape}; "
            "give the prediction of this scan"
        )
    for kind, ids in (("true", truth), ("predicted", prediction)):
        if ids.size and not 0 <= ids.min() <= ids.max() <= size:
            raise InputError(
                f"expected {kind} ids 0..{size}, found {ids.min()}..{ids.max()}; map raw labels to train ids first"
            )
    cells = truth.astype(np.int64) * (size + 1) + prediction
    return np.bincount(cells, minlength=(size + 1) ** 2).reshape(size + 1, size + 1)


def metrics(matrix: np.ndarray, taxonomy: Taxonomy) -> dict[str, Any]:
    """Apply the benchmark's formulas to a confusion matrix.

    Points whose truth is ignored (row 0) never count. A labelled point that was predicted as
    ignored (column 0) counts as missed for its class, and is left out of the accuracy, as in
    SemanticKITTI's tool; nuScenes' tool does not allow such predictions.

    Args:
        matrix: (K + 1, K + 1) counts, truth by prediction.
        taxonomy: its `counts_absent` says what a class counts that is in neither of them.

    Returns:
        "miou" (official), "miou_present" (over the classes in the truth), "accuracy", "fwiou"
        (IoU weighted by the frequency in the truth) and "iou" {class: value}, fractions; None
        where nothing was there to count.
    """
    counted = matrix[1:].astype(np.float64)  # (K, K + 1): the points whose truth is a class
    hit = np.diagonal(counted[:, 1:])
    true, predicted = counted.sum(axis=1), counted[:, 1:].sum(axis=0)
    union = true + predicted - hit
    iou = np.divide(hit, union, out=np.zeros_like(hit), where=union > 0)
    averaged = np.full(len(iou), True) if taxonomy.counts_absent else union > 0
    return {
        "miou": _ratio(iou[averaged].sum(), averaged.sum()),
        "miou_present": _ratio(iou[true > 0].sum(), (true > 0).sum()),
        "accuracy": _ratio(hit.sum(), predicted.sum()),
        "fwiou": _ratio((true * iou).sum(), true.sum()),
        "iou": {
            name: float(iou[c]) if union[c] else None for c, name in enumerate(taxonomy.classes)
        },
    }


def _ratio(part: float, whole: float) -> float | None:
    return float(part / whole) if whole else None


@dataclass
class Evaluation:
    """Counts of any number of scans for any number of methods.

    Attributes:
        taxonomy: the classes.
        edges: distances from the sensor in metres; between each two of them is one bin, both
            ends open, as in SemanticKITTI's tool.
        matrices: method -> (bins + 1, K + 1, K + 1) counts; the first is over all distances.
        scans: how many scans were added.
        points: how many points these scans have, labelled or not.
        uncertain: how many of the points of `asked` were uncertain.
        asked: how many points the uncertainty was given for.
    """

    taxonomy: Taxonomy
    edges: Sequence[float] = EDGES
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
            predictions: method -> (N,) train ids.
            uncertain: (N,) bool, or None where no method says so.

        Raises:
            InputError: where the shapes do not fit or an id is outside 0..K.
        """
        masks = self._masks(points)
        size = self.taxonomy.size
        counts = {
            method: np.stack(
                [confusion(truth, ids, size), *(confusion(truth[m], ids[m], size) for m in masks)]
            )
            for method, ids in predictions.items()
        }
        self._count(counts)
        self.scans += 1
        self.points += len(points)
        if uncertain is not None:
            self.uncertain += int(np.count_nonzero(uncertain))
            self.asked += len(uncertain)

    def merge(self, other: Evaluation) -> None:
        """Add the counts of another evaluation of other scans.

        Raises:
            InputError: where its classes or its bins are other ones.
        """
        if (self.taxonomy.classes, tuple(self.edges)) != (
            other.taxonomy.classes,
            tuple(other.edges),
        ):
            raise InputError(
                f"expected an evaluation of {self.taxonomy.name} with edges {tuple(self.edges)}, "
                f"found {other.taxonomy.name} with {tuple(other.edges)}; merge equal ones"
            )
        self._count(other.matrices)
        self.scans += other.scans
        self.points += other.points
        self.uncertain += other.uncertain
        self.asked += other.asked

    def __add__(self, other: Evaluation) -> Evaluation:
        """A new evaluation with the counts of both; raises as `merge`."""
        total = Evaluation(self.taxonomy, self.edges)
        total.merge(self)
        total.merge(other)
        return total

    def report(self, dataset: str) -> dict[str, Any]:
        """All figures as JSON types; `dataset` is what the user named the data."""
        return {
            "dataset": dataset,
            "scans": self.scans,
            "points": self.points,
            "uncertain_fraction": _ratio(self.uncertain, self.asked),
            "methods": {method: self._figures(stack) for method, stack in self.matrices.items()},
        }

    def _figures(self, stack: np.ndarray) -> dict[str, Any]:
        bins = [
            {
                "from_m": float(near),
                "to_m": float(far),
                "points": int(matrix.sum()),
                **metrics(matrix, self.taxonomy),
            }
            for (near, far), matrix in zip(pairwise(self.edges), stack[1:], strict=True)
        ]
        return {**metrics(stack[0], self.taxonomy), "by_distance": bins}

    def _masks(self, points: np.ndarray) -> list[np.ndarray]:
        distance = np.linalg.norm(points[:, :3], axis=1)
        return [(distance > near) & (distance < far) for near, far in pairwise(self.edges)]

    def _count(self, counts: Mapping[str, np.ndarray]) -> None:
        for method, stack in counts.items():
            self.matrices[method] = self.matrices.get(method, 0) + stack
