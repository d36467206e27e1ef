"""Points in, labels out: a NumPy face on the torch core."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np
import torch
from torch import Tensor

from amvnet.config import AssertionConfig
from amvnet.data.labels import Taxonomy
from amvnet.errors import InputError
from amvnet.models.amvnet import Scores, geometric_mean, merge, refine
from amvnet.models.assertions import Assertion, Disagreement, build_assertion
from amvnet.models.point_head import PointHead
from amvnet.scan import Scan
from amvnet.views.points import PointBatch
from amvnet.weights import Weights, load

Method = Literal["rv", "bev", "ensemble", "amvnet"]
METHODS: tuple[Method, ...] = get_args(Method)
NEEDED: dict[str, tuple[str, ...]] = {
    "rv": ("range_net",),
    "bev": ("polar_net",),
    "ensemble": ("range_net", "polar_net"),
    "amvnet": ("range_net", "polar_net", "point_head"),
}


@dataclass(frozen=True)
class Segmentation:
    """What is known of the N points of a scan, in their order.

    A point that is not finite has id 0, is not uncertain, and has scores of 0.

    Attributes:
        labels: (N,) uint8 train ids, 1..K; 0 where a point is not finite.
        uncertain: (N,) bool: where the two networks disagree; all False for a single network.
        scores: (N, K) float32 that the labels are the largest of; column c belongs to id c + 1. Of the geometric
            mean, and so of the ensemble and of the certain points, a row does not sum to 1.
        rv, bev: (N, K) float32 class probabilities of the two networks, or None where it was not asked.
    """

    labels: np.ndarray
    uncertain: np.ndarray
    scores: np.ndarray
    rv: np.ndarray | None = None
    bev: np.ndarray | None = None


class Segmenter:
    """Gives every point of a scan its class.

    Args:
        weights: trained weights, or the name or path of a weights file.
        device: where to compute: "cpu", "cuda", ...
        method: "amvnet", or to compare "ensemble" (geometric mean), "rv" or "bev" alone.

    Raises:
        InputError: where the weights lack a part that the method needs, or there is no such device.
    """

    def __init__(self, weights: Weights | str, device: str = "cpu", method: Method = "amvnet") -> None:
        self.weights = load(weights) if isinstance(weights, str) else weights
        self.method = _checked_method(method, self.weights)
        try:
            self.model = self.weights.build().to(device)
        except (RuntimeError, AssertionError) as error:
            if isinstance(error, InputError):
                raise
            raise InputError(f"expected a device of this machine, found {device!r}; use cpu") from None
        self.device = device

    @property
    def taxonomy(self) -> Taxonomy:
        """The classes."""
        return self.weights.taxonomy

    def __call__(self, points: np.ndarray | Scan) -> Segmentation:
        """Segment one scan: (N, 4) x, y, z in metres and intensity in [0, 1], or a `Scan`.

        Raises:
            InputError: where there is no finite point, or the model needs a ring index and there is none.
        """
        scan = checked_scan(points)
        scores = self._scores(PointBatch.of([scan]).to(self.device))
        return _in_place(scan.valid, scores)

    def by_method(self, scan: Scan) -> tuple[dict[str, np.ndarray], np.ndarray | None]:
        """The (N,) train ids by each method that the weights have the parts for, and which points are uncertain."""
        parts = self.weights.parts
        methods = [m for m in METHODS if set(NEEDED[m]) <= set(parts)]
        found = dict.fromkeys(methods, self) if len(methods) == 1 else {}
        if found:
            return {m: s(scan).labels for m, s in found.items()}, None
        result = self(scan)
        assert result.rv is not None
        assert result.bev is not None
        scores = {"rv": result.rv, "bev": result.bev, "ensemble": np.sqrt(result.rv * result.bev)}
        if "amvnet" in methods:
            scores["amvnet"] = result.scores
        return {name: _labels(values, scan.valid) for name, values in scores.items()}, result.uncertain

    @torch.inference_mode()
    def _scores(self, batch: PointBatch) -> Scores:
        model = self.model
        if self.method == "amvnet":
            return model(batch)
        none = torch.zeros(len(batch.points), dtype=torch.bool, device=batch.points.device)
        if self.method == "rv":
            f = model.score_range_view(batch)
            return Scores(f, f, f, none)
        g = model.score_polar_view(batch)
        if self.method == "bev":
            return Scores(g, g, g, none)
        f = model.score_range_view(batch)
        return Scores(f, g, geometric_mean(f, g), model.assertion(f, g, batch.points))


def fuse(
    points: np.ndarray,
    f: np.ndarray,
    g: np.ndarray,
    head: PointHead | Weights | str | None = None,
    tau: float | None = None,
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
        InputError: where the shapes do not fit.
    """
    scan = checked_scan(points)
    if f.shape != g.shape or f.ndim != 2 or len(f) != len(scan):
        raise InputError(
            f"expected two arrays of scores of shape ({len(scan)}, K), found {f.shape} and {g.shape}; "
            "give both models' scores of this scan"
        )
    module, assertion = _head(head, tau)
    classes = None if module is None else module.fc[-1].out_features
    if classes not in (None, f.shape[1]):
        raise InputError(f"expected scores of the head's {classes} classes, found {f.shape[1]}; use a head for them")
    with torch.inference_mode():
        x, a, b = (torch.from_numpy(np.asarray(v, dtype=np.float32)[scan.valid]) for v in (scan.points, f, g))
        uncertain = assertion(a, b, x)
        h = None if module is None else refine(module, x, a, b, uncertain)
        return _in_place(scan.valid, Scores(a, b, merge(a, b, uncertain, h), uncertain)).labels


def checked_scan(points: np.ndarray | Scan) -> Scan:
    """A scan that holds something to work on.

    Raises:
        InputError: where it has no point, or no finite one.
    """
    scan = points if isinstance(points, Scan) else Scan(np.asarray(points, dtype=np.float32))
    if not scan.valid.any():
        found = "none finite" if len(scan) else "none"
        raise InputError(f"{scan.name or 'scan'}: expected points to segment, found {found}; leave the scan out")
    return scan


def _head(head: PointHead | Weights | str | None, tau: float | None) -> tuple[PointHead | None, Assertion]:
    """The head, and the assertion that chooses its points."""
    if isinstance(head, str):
        head = load(head)
    config = AssertionConfig()
    if isinstance(head, Weights):
        if "point_head" not in head.parts:
            raise InputError("expected weights with a point head, found none; train one with --stage head")
        config, head = head.model.assertion, head.build().point_head
    assertion = build_assertion(config) if tau is None else Disagreement(tau)
    return None if head is None else head.eval(), assertion


def _checked_method(method: Method, weights: Weights) -> Method:
    if method not in NEEDED:
        raise InputError(f"expected a method of {', '.join(METHODS)}, found {method!r}; use one of them")
    missing = [part for part in NEEDED[method] if part not in weights.parts]
    if missing:
        raise InputError(
            f"expected weights with {', '.join(NEEDED[method])} for the method {method}, found no {missing[0]}; "
            "train that part, or choose a method without it"
        )
    return method


def _in_place(valid: np.ndarray, scores: Scores) -> Segmentation:
    """Put what was found for the valid points back among all points."""

    def full(values: Tensor) -> np.ndarray:
        if valid.all():
            return values.cpu().numpy()
        out = np.zeros((len(valid), *values.shape[1:]), dtype=values.cpu().numpy().dtype)
        out[valid] = values.cpu().numpy()
        return out

    merged = full(scores.merged)
    return Segmentation(
        _labels(merged, valid), full(scores.uncertain), merged, rv=full(scores.rv), bev=full(scores.bev)
    )


def _labels(scores: np.ndarray, valid: np.ndarray) -> np.ndarray:
    """(N, K) -> (N,) uint8 train ids, 0 where a point is not valid."""
    return np.where(valid, scores.argmax(axis=1) + 1, 0).astype(np.uint8)
