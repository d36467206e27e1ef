"""The late fusion alone: fuse any two models' scores (sections 3.2 and 3.3 of the paper)."""

from __future__ import annotations

import copy
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch

from amvnet.data.recordings import ScanFile
from amvnet.data.taxonomy import Taxonomy
from amvnet.errors import InputError
from amvnet.inference.listing import Inputs
from amvnet.inference.pipeline import OutputOptions, Pipeline, check_faults, check_output
from amvnet.inference.scores import LEAST_PROBABILITY, ScorePair, as_probabilities, have_opinion
from amvnet.inference.segmentation import Segmentation, fetch, unpack
from amvnet.models.amvnet import LateFusion, Scores
from amvnet.models.assertion import Disagreement
from amvnet.models.point_head import PointHead
from amvnet.models.views.points import PointBatch
from amvnet.progress import Progress, no_progress
from amvnet.scan import AnyArray, Scan, as_array
from amvnet.sensors.expectation import Expectation
from amvnet.sensors.lidars import Sensor
from amvnet.sensors.normalise import Normaliser
from amvnet.sensors.reading import checked_scan
from amvnet.weights.file import Weights, load

Head = PointHead | Weights | Path | str | None


class Fusion:
    """Fuses two models' scores of scans; `head` and `tau` are as for `fuse`.

    Raises:
        InputError: if the weights hold no head.
    """

    def __init__(self, head: Head = None, tau: float | None = None) -> None:
        if isinstance(head, str | Path):
            head = load(head)
        self.expects = Expectation()
        lead = 0.0
        if isinstance(head, Weights):
            self.expects = head.expects  # the head also sees the intensities
            tau = head.model.assertion.threshold if tau is None else tau
            lead = head.model.assertion.lead
            head = head.build_head()

        assertion = Disagreement() if tau is None else Disagreement(tau)
        point_head = None if head is None else copy.deepcopy(head).cpu().eval()
        self.model = LateFusion(assertion, point_head, lead)

    def __call__(self, points: AnyArray | Scan, f: AnyArray, g: AnyArray) -> Segmentation:
        """Fuse two models' scores of one scan's N points.

        Args:
            points: as `Segmenter.__call__` takes them, but no path.
            f, g: (N, K) class probabilities of each model. A row of zeros says that the model has
                no opinion of this point, and counts as 1/K.

        Raises:
            InputError: if the shapes do not fit, or the scores are not probabilities.
        """
        scan = self.expects.prepare(checked_scan(points, self.expects.intensity))
        f_all = as_array(f, "scores f").astype(np.float32, copy=False)
        g_all = as_array(g, "scores g").astype(np.float32, copy=False)
        self._check_shapes(scan, f_all, g_all)

        f_valid = as_probabilities(f_all[scan.valid], "f", "apply softmax")
        g_valid = as_probabilities(g_all[scan.valid], "g", "apply softmax")

        with torch.inference_mode():
            scores = self.model.fuse(
                PointBatch.of([scan]),
                torch.from_numpy(f_valid).clamp_min(LEAST_PROBABILITY),
                torch.from_numpy(g_valid).clamp_min(LEAST_PROBABILITY),
            )

        labels, fused = fetch(Scores(scores.merged, scores.uncertain, rv=None, bev=None))
        return unpack(scan.valid, labels, fused, points=slice(None))

    def _check_shapes(self, scan: Scan, f: np.ndarray, g: np.ndarray) -> None:
        if f.shape != g.shape or f.ndim != 2 or len(f) != len(scan):
            raise InputError(
                f"expected two arrays of scores of shape ({len(scan)}, K), "
                f"found {f.shape} and {g.shape}; give both models' scores of this scan"
            )

        if self.model.point_head is None:
            return

        classes = self.model.point_head.classes
        if classes != f.shape[1]:
            raise InputError(
                f"expected scores of the head's {classes} classes, found {f.shape[1]}; "
                "use a head for them"
            )


def fuse(
    points: AnyArray, f: AnyArray, g: AnyArray, head: Head = None, tau: float | None = None
) -> np.ndarray:
    """Label points by the late fusion of two models' scores (sections 3.2 and 3.3 of the paper).

    Args:
        points: (N, 4) x, y, z in metres and intensity in [0, 1].
        f: (N, K) class probabilities of one model. A row of zeros says that it has no opinion of
            this point, and counts as 1/K.
        g: (N, K) class probabilities of the other model.
        head: a trained point head, or weights that hold one. Without a head, the labels are the
            ensemble's.
        tau: the threshold of the assertion, in [0, 1]: points whose scores have a cosine similarity
            of at most `tau` are uncertain. By default the threshold that the weights were trained
            with; without weights, the threshold of the paper.

    Returns:
        (N,) uint8 train ids 1..K; 0 for points that are not finite.

    Raises:
        InputError: if the shapes do not fit, the scores are not probabilities, the weights hold no
            head, or `tau` is out of range.
    """
    return Fusion(head, tau)(points, f, g).labels


class Fused(NamedTuple):
    """The result of `fuse_files`.

    Attributes:
        uncertain: the share of the points on which the two models disagree, in [0, 1].
        silent: by side ("a" or "b"), the share of the points without an opinion of its model, in
            [0, 1].
    """

    files: int
    uncertain: float
    silent: dict[str, float]


def fuse_files(
    inputs: Inputs,
    pair: ScorePair,
    output: OutputOptions,
    *,
    head: Weights | None = None,
    tau: float | None = None,
    taxonomy: Taxonomy | None = None,
    progress: Progress = no_progress,
) -> Fused:
    """Fuse two models' scores of scans, and write the labels as `predict` writes them.

    Args:
        head, tau: as for `fuse`; `head` is weights that have a point head.
        taxonomy: the classes if there is no head; by default the classes of the inputs.

    Raises:
        InputError: before anything is written, if scores of a scan are missing or a file of the
            user would be replaced; at the end, if the scores of all scans are broken.
        SomeBroken: at the end, if the scores of some scans are broken.
    """
    fusion = Fusion(head, tau)
    if head is not None:
        taxonomy = head.taxonomy
    normaliser = Normaliser(fusion.expects, Sensor(keep_own=True))  # the other models label it
    scans, taxonomy = inputs.scans(taxonomy, normaliser)
    scores = []
    for scan in scans:  # raises before anything is written
        scores += [pair.a.find(scan.scores_path), pair.b.find(scan.scores_path)]
    output = replace(output, also_read=[*output.also_read, *scores])
    check_output(scans, output)

    silent: Counter[str] = Counter()  # by side, the points without an opinion of the model

    def segment(inputs: Sequence[ScanFile], loaded: Sequence[Scan]) -> list[Segmentation]:
        results = []
        for scan_input, scan in zip(inputs, loaded, strict=True):
            f, g = pair.read(scan_input.scores_path, scan, taxonomy.size)
            results.append(fusion(scan, f, g))
            for side, values in (("a", f), ("b", g)):
                silent[side] += int(np.count_nonzero(~have_opinion(values[scan.valid])))
        return results

    pipeline = Pipeline(scans, segment, output)
    entries, faults = pipeline.run({"fused": repr(pair)}, progress)
    check_faults(faults, len(scans))

    points = 0
    uncertain = 0
    for entry in entries:
        points += entry.points
        uncertain += entry.uncertain
    total = max(points, 1)
    return Fused(
        len(scans),
        uncertain=uncertain / total,
        silent={side: count / total for side, count in silent.items()},
    )
