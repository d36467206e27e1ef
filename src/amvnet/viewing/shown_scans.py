"""Prepare scans for viewing, with their ground truth, labels by method and uncertain points."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from amvnet.data.class_maps import ClassMap
from amvnet.data.recordings import ScanFile
from amvnet.data.taxonomy import Taxonomy
from amvnet.errors import InputError
from amvnet.inference.journal import read_journals
from amvnet.inference.scan_stream import stream_scans
from amvnet.inference.segmentation import (
    Origin,
    Segmentation,
    expand_labels,
    expand_to_scan,
    scores_by_method,
)
from amvnet.inference.segmenter import Segmenter
from amvnet.models.amvnet import Scores
from amvnet.models.assertion import cosine_similarity
from amvnet.progress import Progress, no_progress
from amvnet.scan import Scan, check_scan

# Colours for a dark background, RGB in 0..255.
CORRECT = (78, 92, 112)
UNSCORED = (40, 47, 58)

NEAR = 200.0  # largest distance from the origin to the middle of a map that stays there, metres


@dataclass(frozen=True)
class ShownScan:
    """One scan, with all that the page can show of its N points.

    Attributes:
        name: the scan's short name, for people.
        points: (N, 4) float32 x, y, z in metres and intensity in [0, 1].
        truth: (N,) train ids of the ground truth; None if there is no ground truth.
        labels: (N,) train ids by method; the key of labels from files is "labels".
        probabilities: (N,) float32 in [0, 1] by method, the probability of the method's own label.
        second: (N,) train ids of the class that the segmenter's method finds second most probable;
            None without a segmenter.
        second_probability: (N,) float32 in [0, 1], the probability of `second`.
        uncertain: (N,) bool, the points on which the two networks disagree (section 3.2 of the
            paper); None without two networks.
        disagreement: (N,) float32 in [0, 1], 1 - the cosine similarity of the two networks' class
            probabilities; None without two networks.
        corrected: the place of the scan's corrected labels, relative to the folder of the dataset;
            its ending names their form. Empty if the scan has no such place.
        origin: (3,) the place of the points' origin in the file, metres; not 0 for maps that lie
            elsewhere.
    """

    name: str
    points: np.ndarray
    valid: np.ndarray
    truth: np.ndarray | None = None
    labels: dict[str, np.ndarray] = field(default_factory=dict)
    probabilities: dict[str, np.ndarray] = field(default_factory=dict)
    second: np.ndarray | None = None
    second_probability: np.ndarray | None = None
    uncertain: np.ndarray | None = None
    disagreement: np.ndarray | None = None
    corrected: str = ""
    origin: tuple[float, ...] = (0.0, 0.0, 0.0)


def check_labels(labels: Path, count: int, classes: ClassMap | None = None) -> None:
    """Check that labels are there, for `count` scans, with the classes of a map if there is one.

    Raises:
        InputError: if no labels exist there, a label file stands for several scans, or the journal
            of `predict` says that it wrote other classes.
    """
    if not labels.exists():
        raise InputError(
            f"{labels}: expected a file or a folder of labels, found none; check the path"
        )
    if labels.is_file() and count > 1:
        raise InputError(
            f"{labels}: expected a folder of labels for {count} scans, found a file; give a folder"
        )
    mapped = None if classes is None else repr(classes)
    for settings in read_journals(labels if labels.is_dir() else labels.parent).settings:
        written = settings.get("classes")
        if written != mapped:
            found = "classes that a map made" if written else "classes that no map made"
            advice = "give the --classes of predict" if written else "leave out --classes"
            expected = f"of {classes.target.name}" if classes is not None else "of the inputs"
            raise InputError(
                f"{labels}: expected labels with the classes {expected}, found {found}; {advice}"
            )


def show_scans(
    scans: Sequence[ScanFile],
    segmenter: Segmenter | None = None,
    labels: Path | None = None,
    progress: Progress = no_progress,
    classes: ClassMap | None = None,
) -> Iterator[ShownScan]:
    """Yield scans for viewing, in order; each is read and labelled when it is needed.

    Args:
        segmenter: labels the scans; the labels of its networks are shown with its own.
        labels: without a segmenter, a folder of predictions as `predict` writes them, or the label
            file of a single scan; by default, the labels that files of `predict` and `map` hold.
        classes: maps the classes of the truth and of the segmenter to those that are shown, which
            `labels` already have.

    Raises:
        InputError: if a file is broken or missing.
    """

    def load(scan_input: ScanFile) -> Scan:
        return scan_input.load(labels=True)

    def show(scan_input: ScanFile, loaded: Scan) -> ShownScan:
        scan = check_scan(loaded)
        if segmenter is not None:
            result = segmenter(scan)
            assert result.origin is not None
            shown = shown_scan(result, result.origin)
            shown = replace(shown, name=scan_input.title, corrected=scan_input.corrected)
            return _mapped(shown, scan_input, classes, segmenter.taxonomy)

        shown = ShownScan(
            scan_input.title,
            scan.points,
            scan.valid,
            truth=scan.labels,
            corrected=scan_input.corrected,
        )
        if labels is not None:
            target = None if classes is None else classes.target
            ids = scan_input.dataset.read_prediction(scan_input, labels, len(scan), target)
        elif (stored := scan_input.dataset.stored_labels(scan_input, len(scan))) is not None:
            ids = stored
            shown = _near_the_middle(shown)
        else:
            return _mapped(shown, scan_input, classes)
        shown = replace(shown, labels={"labels": ids})
        of_labels = None if labels is not None else scan_input.dataset.taxonomy
        return _mapped(shown, scan_input, classes, of_labels)

    at_once = 1 if segmenter is None else segmenter.at_once
    return stream_scans(scans, load, show, at_once, progress)


def _mapped(
    shown: ShownScan,
    scan_input: ScanFile,
    classes: ClassMap | None,
    of_labels: Taxonomy | None = None,
) -> ShownScan:
    """Return a scan with the classes of a map: its truth, and its labels if these have others.

    The networks give no probabilities of these classes, and no file holds corrected labels.
    """
    if classes is None:
        return shown
    truth = shown.truth
    if truth is not None and shown.labels and not classes.names_any(scan_input.dataset.taxonomy):
        truth = None  # the labels can be seen without it
    elif truth is not None:
        truth = classes.table(scan_input.dataset.taxonomy)[truth]
    labels = shown.labels
    if of_labels is not None:
        table = classes.table(of_labels)
        labels = {method: table[ids] for method, ids in labels.items()}
    return replace(
        shown,
        truth=truth,
        labels=labels,
        probabilities={},
        second=None,
        second_probability=None,
        corrected="",
    )


def _near_the_middle(shown: ShownScan) -> ShownScan:
    """Return a map with its middle at the origin, unless it is near: the page is of one place."""
    middle = np.median(shown.points[shown.valid, :3], axis=0).round()
    if np.abs(middle).max() <= NEAR:
        return shown
    points = shown.points.copy()
    points[:, :3] -= middle
    return replace(shown, points=points, origin=tuple(middle.tolist()))


def short_name(scan: Scan) -> str:
    """Return the name of a scan for people, without folders."""
    return Path(scan.name).name or "scan"


def shown_scan(result: Segmentation, origin: Origin) -> ShownScan:
    """Return what the page shows of a segmented scan.

    It shows the labels of the result, the labels of each network and, if there are two networks,
    the labels of their ensemble, each with its probability.
    """
    scan = origin.scan
    valid = torch.from_numpy(scan.valid)
    fetched = Scores(
        merged=torch.from_numpy(result.scores)[valid],
        uncertain=torch.from_numpy(result.uncertain)[valid],
        rv=None if result.rv is None else torch.from_numpy(result.rv)[valid],
        bev=None if result.bev is None else torch.from_numpy(result.bev)[valid],
    )
    names = dict.fromkeys(("rv", "bev", "ensemble", origin.method))
    scores = scores_by_method(fetched, origin.method, names)

    labels = {}
    probabilities = {}
    for name, values in scores.items():
        labels[name] = expand_labels(values, scan.valid)
        probabilities[name] = expand_to_scan(_shares(values).amax(dim=1), scan.valid)
    labels[origin.method] = result.labels

    second_probability, second = _shares(scores[origin.method]).topk(2, dim=1)
    shown = ShownScan(
        short_name(scan),
        scan.points,
        scan.valid,
        truth=scan.labels,
        labels=labels,
        probabilities=probabilities,
        second=expand_to_scan(second[:, 1] + 1, scan.valid),
        second_probability=expand_to_scan(second_probability[:, 1], scan.valid),
    )
    if not result.has_two_networks:
        return shown

    similarity = cosine_similarity(scores["rv"], scores["bev"])
    disagreement = expand_to_scan((1 - similarity).clamp(0, 1), scan.valid)
    return replace(shown, uncertain=result.uncertain, disagreement=disagreement)


def _shares(scores: Tensor) -> Tensor:
    """Scale the rows of scores (P, K) of valid points as `Segmentation.probabilities` does."""
    sums = scores.sum(dim=1, keepdim=True)
    # Two networks that are wholly sure of different classes leave a score of 0 for every class.
    return torch.where(sums > 0, scores / sums, torch.tensor(1 / max(scores.shape[1], 1)))
