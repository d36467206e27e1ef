"""Points in, labels out: a NumPy face on the torch core."""

from __future__ import annotations

import copy
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from amvnet.data.taxonomy import Taxonomy
from amvnet.errors import InputError
from amvnet.inference.methods import COMPARED, METHODS, NEEDED, Method
from amvnet.memory import keep_freed_memory
from amvnet.models.amvnet import ENSEMBLES, AMVNet, Scores, merge
from amvnet.models.layers import fold_batch_norms
from amvnet.models.precision import InPrecision, Precision, check_precision
from amvnet.models.streams import SideBySide
from amvnet.models.views.points import PointBatch
from amvnet.models.views.range_view import RangeView
from amvnet.scan import Scan
from amvnet.weights.file import Weights, load

MOST_AT_ONCE = 4  # scans, so that their memory is bounded on a processor of many cores


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
        method: "amvnet", or to compare "rv" or "bev" alone, and "ensemble" (geometric mean), "arithmetic" or "maximum".
        precision: of the two networks: "float32", "bfloat16", or on a GPU "float16"; all else is float32.

    Raises:
        InputError: where the weights lack a part that the method needs, or there is no such device or precision.
    """

    def __init__(
        self,
        weights: Weights | Path | str,
        device: str = "cpu",
        method: Method = "amvnet",
        precision: Precision = "float32",
    ) -> None:
        self.weights = weights if isinstance(weights, Weights) else load(weights)
        self.method = _checked_method(method, self.weights)
        if self.weights.model.assertion.name == "loss":
            raise InputError(
                "expected an assertion that needs no labels, found loss; train the head with another one"
            )
        self.engine = "torch"
        self.device, self.precision = _checked_device(device), precision
        check_precision(precision, device)
        if device == "cpu":
            keep_freed_memory()
        self.model = self.weights.build().to(device).to(memory_format=torch.channels_last)  # type: ignore[call-overload]
        fold_batch_norms(self.model)
        _arrange(self.model, device, precision)

    @property
    def at_once(self) -> int:
        """How many scans are best segmented side by side, each by its share of torch's threads."""
        return (
            min(torch.get_num_threads(), MOST_AT_ONCE)
            if self.device == "cpu" and self.engine == "torch"
            else 1
        )

    @property
    def taxonomy(self) -> Taxonomy:
        """The classes."""
        return self.weights.taxonomy

    def __call__(self, points: np.ndarray | Scan) -> Segmentation:
        """Segment one scan: (N, 4) x, y, z in metres and intensity in [0, 1], or a `Scan`.

        Raises:
            InputError: where there is no finite point, or the model needs a ring index and there is none.
        """
        return self.many([points])[0]

    def many(self, scans: Sequence[np.ndarray | Scan]) -> list[Segmentation]:
        """Segment some scans in one pass of the networks, which suits a GPU; the rest is as for one.

        Raises:
            InputError: where one of them cannot be segmented; segment them one by one to see which.
        """
        checked = [check_scan(points) for points in scans]
        batch = self._batch(checked)
        labels, found = _fetched(self._scores(batch))
        places = batch.slices()
        return [
            _segmentation(one.valid, labels, found, place)
            for one, place in zip(checked, places, strict=True)
        ]

    def by_ring(self) -> Segmenter:
        """The same for scans whose `ring` is the row of each point, 0 the lowest, whatever rows the weights have."""
        other = copy.copy(self)
        other.model = copy.copy(self.model)
        other.model.range_view = RangeView(replace(self.model.range_view.config, rows="ring"))
        return other

    def by_method(
        self, scan: Scan, methods: Sequence[str] = COMPARED
    ) -> tuple[dict[str, np.ndarray], np.ndarray | None]:
        """The (N,) train ids by each method that the weights have the parts for, and which points are uncertain."""
        found, uncertain = self.scores_by_method(scan, methods)
        labels = {name: expand_labels(found[name], scan.valid) for name in methods if name in found}
        return labels, None if uncertain is None else expand_to_scan(uncertain, scan.valid)

    @torch.inference_mode()
    def scores_by_method(
        self, scan: Scan, methods: Sequence[str] = COMPARED
    ) -> tuple[dict[str, Tensor], Tensor | None]:
        """The same for the P valid points of a scan alone: (P, K) scores by each method, and (P,) bool."""
        model, parts, batch = self.model, self.weights.parts, self._batch([scan])
        found: dict[str, Tensor] = {}
        if "range_net" in parts:
            found["rv"] = model.score_range_view(batch)
        if "polar_net" in parts:
            found["bev"] = model.score_polar_view(batch)
        if len(found) < 2:
            return found, None
        f, g = found["rv"], found["bev"]
        uncertain = model.assertion(f, g, batch.points)
        found |= {name: mean(f, g) for name, mean in ENSEMBLES.items() if name in methods}
        if "point_head" in parts and "amvnet" in methods:
            found["amvnet"] = merge(f, g, uncertain, model.refine(batch, f, g, uncertain))
        return found, uncertain

    def _batch(self, scans: Sequence[Scan]) -> PointBatch:
        batch = PointBatch.of(scans)
        return (batch.pin_memory() if _on_gpu(self.device) else batch).to(self.device)

    @torch.inference_mode()
    def _scores(self, batch: PointBatch) -> Scores:
        model = self.model
        if self.method == "amvnet":
            return model(batch)
        none = torch.zeros(len(batch.points), dtype=torch.bool, device=batch.points.device)
        if self.method == "rv":
            f = model.score_range_view(batch)
            return Scores(f, none, f, None)
        if self.method == "bev":
            g = model.score_polar_view(batch)
            return Scores(g, none, None, g)
        f, g = model.run(model.score_range_view, model.score_polar_view, batch)
        return Scores(ENSEMBLES[self.method](f, g), model.assertion(f, g, batch.points), f, g)


def check_scan(points: np.ndarray | Scan) -> Scan:
    """A scan that holds something to work on.

    Raises:
        InputError: where it has no point, or no finite one.
    """
    scan = points if isinstance(points, Scan) else Scan(np.asarray(points, dtype=np.float32))
    if not scan.valid.any():
        found = "none finite" if len(scan) else "none"
        raise InputError(
            f"{scan.name or 'scan'}: expected points to segment, found {found}; leave the scan out"
        )
    return scan


def _checked_method(method: Method, weights: Weights) -> Method:
    if method not in NEEDED:
        raise InputError(
            f"expected a method of {', '.join(METHODS)}, found {method!r}; use one of them"
        )
    missing = [part for part in NEEDED[method] if part not in weights.parts]
    if missing:
        raise InputError(
            f"expected weights with {', '.join(NEEDED[method])} for the method {method}, found no {missing[0]}; "
            "train that part, or choose a method without it"
        )
    return method


def _checked_device(name: str) -> str:
    """The name of a device of this machine."""
    try:
        torch.zeros(1, device=name).item()
    except (RuntimeError, AssertionError, NotImplementedError):
        raise InputError(f"expected a device of this machine, found {name!r}; use cpu") from None
    return name


def segmentation(valid: np.ndarray, scores: Scores) -> Segmentation:
    """Put what was found for the valid points back among all points."""
    return _segmentation(valid, *_fetched(scores), slice(None))


def _fetched(scores: Scores) -> tuple[Tensor, Scores]:
    """The labels (P,), and the scores, in the processor's memory; a GPU is waited for once."""
    on_gpu = scores.merged.is_cuda

    def fetch(values: Tensor) -> Tensor:
        return values.to("cpu", non_blocking=on_gpu)  # to pinned memory then

    labels = fetch(label_ids(scores.merged))
    rv, bev = (None if values is None else fetch(values) for values in (scores.rv, scores.bev))
    found = Scores(fetch(scores.merged), fetch(scores.uncertain), rv, bev)
    if on_gpu:
        torch.cuda.current_stream(scores.merged.device).synchronize()
    return labels, found


def _segmentation(valid: np.ndarray, labels: Tensor, scores: Scores, place: slice) -> Segmentation:
    """Of the scan whose valid points stand at this place of a batch."""
    rv, bev = (
        None if values is None else expand_to_scan(values[place], valid)
        for values in (scores.rv, scores.bev)
    )
    uncertain, merged = (
        expand_to_scan(scores.uncertain[place], valid),
        expand_to_scan(scores.merged[place], valid),
    )
    return Segmentation(expand_to_scan(labels[place], valid), uncertain, merged, rv, bev)


def _on_gpu(device: str) -> bool:
    return torch.device(device).type == "cuda"


def _arrange(model: AMVNet, device: str, precision: Precision) -> None:
    """Let the two networks compute in a precision, and on a GPU side by side."""
    if _on_gpu(device):
        model.run = SideBySide(device)
    if precision != "float32" or _on_gpu(device):
        model.range_net = InPrecision(model.range_net, device, precision)
        model.polar_net = InPrecision(model.polar_net, device, precision)


def expand_to_scan(values: Tensor, valid: np.ndarray) -> np.ndarray:
    """(P, ...) of the valid points -> (N, ...) of all, zeros for the others."""
    found = values.cpu().numpy()
    if valid.all():
        return found
    out = np.zeros((len(valid), *found.shape[1:]), dtype=found.dtype)
    out[valid] = found
    return out


def expand_labels(scores: Tensor, valid: np.ndarray) -> np.ndarray:
    """(P, K) scores of the valid points -> (N,) uint8 train ids of all, 0 where a point is not valid."""
    return expand_to_scan(label_ids(scores), valid)


def label_ids(scores: Tensor) -> Tensor:
    """(P, K) scores -> (P,) uint8 train ids 1..K, of the largest, or the first of these."""
    # On a CPU by NumPy, in half of torch's time.
    best = (
        torch.from_numpy(scores.numpy().argmax(axis=1)) if scores.is_cpu else scores.argmax(dim=1)
    )
    return (best + 1).to(torch.uint8)
