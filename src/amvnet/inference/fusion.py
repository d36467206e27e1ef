"""The late fusion alone, for the scores of any two models (section 3.2 of the paper)."""

from __future__ import annotations

import copy
from pathlib import Path

import numpy as np
import torch

from amvnet.config.schema import AssertionConfig
from amvnet.errors import InputError
from amvnet.inference.score_files import SURE, check_probabilities
from amvnet.inference.segmenter import Segmentation, check_scan, segmentation
from amvnet.models.amvnet import Scores, merge, refine
from amvnet.models.assertions import Assertion, Disagreement, build_assertion
from amvnet.models.point_head import PointHead
from amvnet.scan import Scan
from amvnet.weights.file import Weights, load

Head = PointHead | Weights | Path | str | None


class Fusion:
    """Fuses two models' scores of scans.

    Args:
        head: a trained point head, or weights that hold one; None gives the ensemble.
        tau: points whose scores have a cosine similarity of at most this are uncertain; by default the
            threshold that weights were trained with, or else the paper's.

    Raises:
        InputError: where the weights hold no head.
    """

    def __init__(self, head: Head = None, tau: float | None = None) -> None:
        self.head, self.assertion = _head(head, tau)

    def __call__(self, points: np.ndarray | Scan, f: np.ndarray, g: np.ndarray) -> Segmentation:
        """Fuse (N, K) class probabilities of one scan's N points; raises InputError where they are none."""
        scan = check_scan(points)
        self._check_shapes(scan, f, g)
        x, a, b = (np.asarray(v, dtype=np.float32)[scan.valid] for v in (scan.points, f, g))
        for name, values in (("f", a), ("g", b)):
            check_probabilities(values, name, "apply softmax")
        with torch.inference_mode():
            return segmentation(scan.valid, self._merged(*map(torch.from_numpy, (x, a, b))))

    def _merged(self, points: torch.Tensor, f: torch.Tensor, g: torch.Tensor) -> Scores:
        """Of the P valid points, whose scores are (P, K)."""
        f, g = f.clamp_min(SURE), g.clamp_min(SURE)
        uncertain = self.assertion(f, g, points)
        h = None if self.head is None else refine(self.head, points, f, g, uncertain)
        return Scores(merge(f, g, uncertain, h), uncertain, None, None)

    def _check_shapes(self, scan: Scan, f: np.ndarray, g: np.ndarray) -> None:
        if f.shape != g.shape or f.ndim != 2 or len(f) != len(scan):
            raise InputError(
                f"expected two arrays of scores of shape ({len(scan)}, K), found {f.shape} and {g.shape}; "
                "give both models' scores of this scan"
            )
        classes = None if self.head is None else self.head.fc[-1].out_features
        if classes not in (None, f.shape[1]):
            raise InputError(
                f"expected scores of the head's {classes} classes, found {f.shape[1]}; use a head for them"
            )


def fuse(
    points: np.ndarray, f: np.ndarray, g: np.ndarray, head: Head = None, tau: float | None = None
) -> np.ndarray:
    """The late fusion alone, for any two models' scores (section 3.2 of the paper).

    Args:
        points: (N, 4) x, y, z in metres and intensity in [0, 1].
        f, g: (N, K) class probabilities of the two models.
        head: a trained point head, or weights that hold one; None gives the ensemble.
        tau: points whose scores have a cosine similarity of at most this are uncertain; by default the
            threshold that weights were trained with, or else the paper's.

    Returns:
        (N,) uint8 train ids, 1..K; 0 where a point is not finite.

    Raises:
        InputError: where the shapes do not fit, or the scores are not probabilities.
    """
    return Fusion(head, tau)(points, f, g).labels


def _head(head: Head, tau: float | None) -> tuple[PointHead | None, Assertion]:
    """The head, and the assertion that chooses its points."""
    if isinstance(head, str | Path):
        head = load(head)
    config = AssertionConfig()
    if isinstance(head, Weights):
        config, head = head.model.assertion, head.build_head()
    if tau is None and config.name == "loss":
        raise InputError(
            "expected an assertion that needs no labels, found loss; train the head with another one"
        )
    assertion = build_assertion(config) if tau is None else Disagreement(tau)
    return None if head is None else copy.deepcopy(head).cpu().eval(), assertion
