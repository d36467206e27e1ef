"""Scans to look at, with their ground truth, labels by method and uncertain points."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import closing
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import torch

from amvnet.data.spacing import evenly_spaced
from amvnet.data.taxonomy import Taxonomy
from amvnet.errors import InputError
from amvnet.inference.listing import InputScan, LoadedScan
from amvnet.inference.scan_stream import stream_scans
from amvnet.inference.segmentation import Origin, Segmentation, expand_labels, expand_to_scan
from amvnet.inference.segmenter import Segmenter
from amvnet.models.assertion import cosine_similarity
from amvnet.models.methods import geometric_mean
from amvnet.progress import Progress, no_progress
from amvnet.scan import check_scan

# Colours for a dark background, RGB in 0..255. The official colour of points without a class is
# black, which would hide them.
UNLABELLED = (128, 136, 148)
RIGHT = (78, 92, 112)
UNSCORED = (40, 47, 58)


@dataclass(frozen=True)
class ShownScan:
    """One scan and what is known about its N points.

    Attributes:
        name: the scan's short name, for people.
        points: (N, 4) float32 x, y, z in metres and intensity in [0, 1].
        valid: (N,) bool, the points that have a position.
        truth: (N,) train ids of the ground truth, or None if there is none.
        labels: (N,) train ids by method; the method of labels from files is "labels".
        uncertain: (N,) bool, the points on which the two networks disagree; None without two
            networks.
        disagreement: (N,) float32 in [0, 1], 1 - the cosine similarity of the two networks' class
            probabilities; None without two networks.
    """

    name: str
    points: np.ndarray
    valid: np.ndarray
    truth: np.ndarray | None = None
    labels: dict[str, np.ndarray] = field(default_factory=dict)
    uncertain: np.ndarray | None = None
    disagreement: np.ndarray | None = None


@dataclass(frozen=True)
class ShownScans:
    """Scans to look at; each is read and labelled when it is needed.

    Attributes:
        taxonomy: the classes of the ids.
        scans: the scans, in order.
        segmenter: labels the scans by every method, or None.
        labels: a folder of predictions as `predict` writes them, or the label file of one scan, or
            None.

    Raises:
        InputError: if the labels do not exist, or one file is named for several scans.
    """

    taxonomy: Taxonomy
    scans: Sequence[InputScan]
    segmenter: Segmenter | None = None
    labels: Path | None = None

    def __post_init__(self) -> None:
        if self.labels is None:
            return

        if not self.labels.exists():
            raise InputError(
                f"{self.labels}: expected a file or a folder of labels, found none; check the path"
            )

        if self.labels.is_file() and len(self.scans) > 1:
            raise InputError(
                f"{self.labels}: expected a folder of labels for {len(self.scans)} scans, found a "
                "file; give a folder"
            )

    def __len__(self) -> int:
        return len(self.scans)

    def spaced(self, count: int) -> ShownScans:
        """Return at most `count` of the scans, evenly spaced.

        Raises:
            InputError: if `count` is below 1.
        """
        if count < 1:
            raise InputError(f"expected a number of scans from 1, found {count}; say --scans 5")
        return replace(self, scans=evenly_spaced(self.scans, count))

    def each(self, progress: Progress = no_progress) -> Iterator[ShownScan]:
        """Yield the scans in order, and report the progress.

        Raises:
            InputError: if a file is broken or missing.
        """
        at_once = 1 if self.segmenter is None else self.segmenter.at_once

        progress(0, len(self))
        scans = stream_scans(self.scans, _load_with_labels, self._show, at_once)
        with closing(scans):
            for done, shown in enumerate(scans, start=1):
                yield shown
                progress(done, len(self))

    def _show(self, scan_input: InputScan, loaded: LoadedScan) -> ShownScan:
        scan = check_scan(loaded.scan)
        shown = ShownScan(scan_input.title, scan.points, scan.valid, scan.labels)

        if self.labels is not None:
            ids = scan_input.read_labels(self.labels, len(scan), self.taxonomy)
            shown = replace(shown, labels={"labels": ids})

        segmenter = self.segmenter
        if segmenter is not None:
            if scan_input.is_normalised:
                segmenter = segmenter.by_ring()
            result = segmenter(scan)
            assert result.origin is not None
            shown = replace(shown_scan(result, result.origin), name=shown.name)
        return shown


def _load_with_labels(scan: InputScan) -> LoadedScan:
    return scan.load(labels=True)


def shown_scan(result: Segmentation, origin: Origin) -> ShownScan:
    """Return what is shown of a scan that was segmented.

    It has the labels of the result, of each network, and of the ensemble if there are two.
    """
    scan = origin.scan
    valid = torch.from_numpy(scan.valid)
    probabilities = {}
    for name, values in (("rv", result.rv), ("bev", result.bev)):
        if values is not None:
            probabilities[name] = torch.from_numpy(values)[valid]  # (P, K)
    has_two = len(probabilities) == 2
    if has_two:
        probabilities["ensemble"] = geometric_mean(probabilities["rv"], probabilities["bev"])

    labels = {name: expand_labels(values, scan.valid) for name, values in probabilities.items()}
    labels[origin.method] = result.labels
    shown = ShownScan(Path(scan.name).name or "scan", scan.points, scan.valid, scan.labels, labels)
    if not has_two:
        return shown

    similarity = cosine_similarity(probabilities["rv"], probabilities["bev"])
    disagreement = expand_to_scan((1 - similarity).clamp(0, 1), scan.valid)
    return replace(shown, uncertain=result.uncertain, disagreement=disagreement)
