"""The result for one scan: labels, scores and uncertain points, with ways to use and save them."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from amvnet.data.labels.writers import KINDS, SIGNATURES, write_scan_labels
from amvnet.data.taxonomy import Taxonomy, class_colors
from amvnet.errors import InputError, did_you_mean
from amvnet.files import check_outputs
from amvnet.models.amvnet import Scores
from amvnet.models.methods import METHODS
from amvnet.scan import Scan
from amvnet.weights.verdict import Verdict

SHOWN_CLASSES = 3  # largest number of classes that the short description of a result names
SMALLEST = 1e-12  # probability whose logarithm stands for that of 0


@dataclass(frozen=True)
class Origin:
    """The scan of a result, and what labelled it.

    Attributes:
        scan: the scan, normalised to the weights.
        usual_uncertain: the share of uncertain points in the validation of the weights, in [0, 1];
            None if it is not known for this tau.
        path: the file of the scan; None if the scan was in memory.
    """

    scan: Scan
    taxonomy: Taxonomy
    method: str
    usual_uncertain: float | None
    path: Path | None = None


@dataclass(frozen=True, repr=False)
class Segmentation:
    """The result for the N points of a scan, in their order.

    A point that is not valid (see `Scan.valid`) has id 0, is not uncertain, and has scores of 0.

    Attributes:
        labels: (N,) uint8 train ids 1..K; 0 for points that are not valid.
        uncertain: (N,) bool, the points on which the two networks disagree (section 3.2 of the
            paper); all False for a single network.
        scores: (N, K) float32; the label of a point is c + 1 for its largest column c. Where the
            scores are a geometric mean (in the ensemble, and for AMVNet's certain points), rows do
            not sum to 1, as in the paper; the rows of `probabilities` do.
        rv, bev: (N, K) float32 class probabilities by each network; None if it did not run.
        origin: the scan and what labelled it; None for the late fusion alone.
    """

    labels: NDArray[np.uint8]
    uncertain: NDArray[np.bool_]
    scores: NDArray[np.float32]
    rv: NDArray[np.float32] | None = None
    bev: NDArray[np.float32] | None = None
    origin: Origin | None = None

    def __len__(self) -> int:
        return len(self.labels)

    def __repr__(self) -> str:
        parts = [f"<Segmentation of {len(self):,} points"]
        if self.origin is not None and len(self):
            shown = list(self.counts().items())[:SHOWN_CLASSES]
            shares = [f"{count / len(self):.0%} {name}" for name, count in shown]
            parts.append(f": {', '.join(shares)}")
        if self.verdict is not None:
            what = "uncertain" if self.has_two_networks else "mean entropy"
            parts.append(f"; {self.verdict.share:.1%} {what}")
            if self.verdict.is_doubtful:
                parts.append(", not to be relied on")

        return "".join([*parts, ">"])

    def counts(self) -> dict[str, int]:
        """Return the number of points of each class that occurs, by its name, most first."""
        counts = np.bincount(self.labels, minlength=len(self.class_names))
        order = np.argsort(-counts, kind="stable")
        return {self.class_names[index]: int(counts[index]) for index in order if counts[index]}

    def mask(self, *names: str | Iterable[str]) -> NDArray[np.bool_]:
        """Return (N,) bool: which points have one of these classes, such as "car".

        Args:
            names: names of classes, and lists of names.

        Raises:
            InputError: if there is no such class.
        """
        wanted: list[str] = []
        for entry in names:
            wanted.extend([entry] if isinstance(entry, str) else entry)
        for name in wanted:
            if name not in self.class_names:
                advice = f"name one of {', '.join(self.class_names)}"
                raise InputError(
                    f"expected a class of the result, found {name!r}"
                    + did_you_mean(str(name), self.class_names, advice)
                )
        return np.isin(self.labels, [self.class_names.index(name) for name in wanted])

    @property
    def has_two_networks(self) -> bool:
        """Whether both networks ran; only then can points be uncertain."""
        return self.rv is not None and self.bev is not None

    @property
    def probabilities(self) -> NDArray[np.float32]:
        """(N, K) class probabilities: the scores, scaled so that rows of valid points sum to 1."""
        sums = self.scores.sum(axis=1, keepdims=True)
        is_scoreless = sums[:, 0] == 0
        sums[is_scoreless] = 1
        shares: NDArray[np.float32] = self.scores / sums
        # Two networks that are wholly sure of different classes leave a score of 0 for every class.
        shares[is_scoreless & (self.labels > 0)] = 1 / max(shares.shape[1], 1)
        return shares

    @property
    def confidence(self) -> NDArray[np.float32]:
        """(N,) probability of each point's label, in [0, 1]; 0 for points that are not valid."""
        largest: NDArray[np.float32] = self.probabilities.max(axis=1, initial=0)
        return largest

    @property
    def points(self) -> NDArray[np.floating]:
        """(N, 3) x, y, z of the points, as in the scan's file or in the array that was given."""
        origin = self.require_origin()
        scan = origin.scan
        return scan.points[:, :3] if scan.file_xyz is None else scan.file_xyz

    @property
    def class_names(self) -> tuple[str, ...]:
        """K + 1 names of the classes, by id; the name of id 0 is "unlabelled"."""
        return self.require_origin().taxonomy.names

    @property
    def colors(self) -> NDArray[np.uint8]:
        """(K + 1, 3) RGB colours of the classes in 0..255, by id: `colors[labels]` is (N, 3)."""
        return np.asarray(class_colors(self.require_origin().taxonomy), dtype=np.uint8)

    @property
    def raw_ids(self) -> NDArray[np.uint32]:
        """(N,) the labels as ids of the benchmark's files (a car of SemanticKITTI is 10)."""
        raw: NDArray[np.uint32] = self.require_origin().taxonomy.to_raw(self.labels)
        return raw

    @property
    def verdict(self) -> Verdict | None:
        """The verdict on how sure the labels are, compared with those of usual scans.

        None for the late fusion alone.
        """
        if self.origin is None:
            return None
        return Verdict.of(self.origin.method, self.doubt, self.origin.usual_uncertain)

    @property
    def doubt(self) -> float:
        """The share of the valid points that are uncertain, in [0, 1].

        For a single network, the mean entropy of its probabilities, divided by the largest one.
        """
        network = self.bev if self.rv is None else self.rv
        is_valid = self.labels > 0 if self.origin is None else self.origin.scan.valid
        count = max(int(np.count_nonzero(is_valid)), 1)
        if network is None or self.has_two_networks:
            return int(np.count_nonzero(self.uncertain)) / count
        probabilities = network.astype(np.float64)
        entropy = -(probabilities * np.log(np.maximum(probabilities, SMALLEST))).sum()
        return float(entropy / count / np.log(max(network.shape[1], 2)))

    @property
    def assumed(self) -> str:
        """The assumptions about the sensor for normalising the scan; empty if it was in memory."""
        return "" if self.origin is None else self.origin.scan.assumed

    def save(self, path: Path | str) -> Path:
        """Write the labels, in the format that the path's ending names; replace earlier labels.

        `.label` and `.npy` hold the raw ids. `.ply`, `.pcd`, `.las` and `.laz` hold the points,
        coloured by class, with their `points` as coordinates; `.csv` holds a table of them.
        `write_scan_labels` describes the formats.

        Returns:
            The path.

        Raises:
            InputError: if the format is unknown, the path names the scan's own file or a file that
                holds no labels, or it cannot be written.
        """
        origin = self.require_origin()
        path = Path(path)
        kind = path.suffix.removeprefix(".")
        if kind not in KINDS:
            raise InputError(
                f"{path}: expected a name that ends in .{', .'.join(KINDS)}, "
                f"found {path.suffix or 'no ending'}; rename it"
            )
        read = [origin.path, origin.scan.name]  # the name of a scan of `amvnet.read` is its path
        check_outputs({path: SIGNATURES[path.suffix]}, read, overwrite=True)

        return write_scan_labels(
            path.with_suffix(""),
            kind,
            self.points,
            self.labels,
            origin.taxonomy,
            uncertain=self.uncertain if self.has_two_networks else None,
        )

    def require_origin(self) -> Origin:
        """Return the origin; raise InputError if there is none."""
        if self.origin is None:
            raise InputError(
                "expected the result of a Segmenter, which knows its classes and points, "
                "found a result of the late fusion alone; use its labels"
            )
        return self.origin


def fetch(scores: Scores) -> tuple[Tensor, Scores]:
    """Return the labels, (P,) uint8, and the scores, in CPU memory; wait for a GPU only once."""
    on_gpu = scores.merged.is_cuda

    def copy(values: Tensor) -> Tensor:
        return values.to("cpu", non_blocking=on_gpu)  # from a GPU, into pinned memory

    labels = copy(label_ids(scores.merged))
    fetched = Scores(
        merged=copy(scores.merged),
        uncertain=copy(scores.uncertain),
        rv=None if scores.rv is None else copy(scores.rv),
        bev=None if scores.bev is None else copy(scores.bev),
    )
    if on_gpu:
        torch.cuda.current_stream(scores.merged.device).synchronize()
    return labels, fetched


def unpack(valid: np.ndarray, labels: Tensor, scores: Scores, points: slice) -> Segmentation:
    """Return the result for one scan of a batch.

    `valid` (N,) says which points of the scan are valid; these are `points` of the batch.
    """
    return Segmentation(
        labels=expand_to_scan(labels[points], valid),
        uncertain=expand_to_scan(scores.uncertain[points], valid),
        scores=expand_to_scan(scores.merged[points], valid),
        rv=None if scores.rv is None else expand_to_scan(scores.rv[points], valid),
        bev=None if scores.bev is None else expand_to_scan(scores.bev[points], valid),
    )


def scores_by_method(
    scores: Scores,
    method: str,
    names: Iterable[str],
    vote: Callable[[Tensor], Tensor] | None = None,
) -> dict[str, Tensor]:
    """Return the scores (P, K) by a method and by the methods that it includes.

    AMVNet and the ensembles include all ensembles and each single network. `vote` returns the
    scores by rv-knn, given those of the range view.
    """
    f = scores.rv
    g = scores.bev
    found: dict[str, Tensor | None] = {}
    for name in names:
        ensemble = METHODS[name].ensemble
        if name == method:
            found[name] = scores.merged
        elif ensemble is not None:
            found[name] = None if f is None or g is None else ensemble(f, g)
        elif name == "rv-knn":
            found[name] = None if f is None or vote is None else vote(f)
        else:
            found[name] = {"rv": f, "bev": g}.get(name)
    return {name: values for name, values in found.items() if values is not None}


def expand_to_scan(values: Tensor, valid: np.ndarray) -> np.ndarray:
    """Return (N, ...) values, given the (P, ...) values of the valid points; others are 0."""
    valid_values = values.cpu().numpy()
    if valid.all():
        return valid_values
    expanded = np.zeros((len(valid), *valid_values.shape[1:]), dtype=valid_values.dtype)
    expanded[valid] = valid_values
    return expanded


def expand_labels(scores: Tensor, valid: np.ndarray) -> np.ndarray:
    """Return (N,) uint8 train ids for the (P, K) scores of the valid points; others are 0."""
    return expand_to_scan(label_ids(scores), valid)


def label_ids(scores: Tensor) -> Tensor:
    """Return (P,) uint8 train ids 1..K: the first column of the largest score of (P, K)."""
    if scores.is_cpu:  # NumPy takes half as long as torch
        best = torch.from_numpy(scores.numpy().argmax(axis=1))
    else:
        best = scores.argmax(dim=1)
    return (best + 1).to(torch.uint8)
