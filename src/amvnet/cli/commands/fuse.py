"""The verbs that build on how two models agree: fuse, rank."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Literal

from amvnet.cli.console import progress, say
from amvnet.cli.options import parse_names, parse_scores
from amvnet.errors import InputError

if TYPE_CHECKING:
    from amvnet.data.taxonomy import Taxonomy
    from amvnet.weights.file import Weights


def fuse(
    inputs: list[str],
    scores_a: Path,
    scores_b: Path,
    out: Path,
    head: str | None = None,
    tau: float | None = None,
    key_a: str | None = None,
    key_b: str | None = None,
    logits: Literal["a", "b", "both"] | None = None,
    split: Literal["train", "val", "test", "all"] = "all",
    sequences: str | None = None,
    taxonomy: str | None = None,
    topic: str | None = None,
) -> None:
    """Fuse the scores of any two models: labels by the point head, or by the ensemble.

    Args:
        inputs: data sets, scan files, or folders of scans.
        scores_a: folder of one model's class probabilities, an .npz or .npy of shape (N, K) for each scan, where
            predict --scores writes its own.
        scores_b: folder of the other model's.
        out: folder for the labels.
        head: weights with a point head: of a training with these scores, or of networks; without, the ensemble.
        tau: points whose scores have a cosine similarity of at most this are uncertain; default: the head's.
        key_a: which array of each .npz in --scores-a; not needed where there is one.
        key_b: which array of each .npz in --scores-b.
        logits: which of the two are scores before softmax.
        split: of data sets, the official split.
        sequences: of data sets, which sequences or scenes instead, with commas.
        taxonomy: semantickitti, nuscenes, or a semantic-kitti.yaml with other classes; default: the head's or data's.
        topic: of bags, the topic of the scans; default: the only one with PointCloud2.
    """
    from amvnet.inference.fuse_files import fuse_files as run
    from amvnet.weights.file import load

    pair = parse_scores(scores_a, scores_b, key_a, key_b, logits)
    assert pair is not None
    given = None if head is None else load(head)
    classes = _classes(inputs, taxonomy, given)
    with progress("fusing") as step:
        written, uncertain = run(
            inputs, pair, given, classes, out, parse_names(sequences), step, split, tau, topic
        )
    say(f"{written} label files in {out}; the two models disagree on {uncertain:.1%} of the points")


def _classes(inputs: list[str], text: str | None, head: Weights | None) -> Taxonomy:
    """The classes: the head's, or those that are named, or those of the first input."""
    from amvnet.data.datasets.open import is_dataset, open_dataset
    from amvnet.data.scan_files import find_scans
    from amvnet.data.taxonomy import NUSCENES, SEMANTICKITTI, TAXONOMIES, taxonomy_from_yaml

    if head is not None and text is not None:
        raise InputError(
            "expected no --taxonomy beside --head, which says its classes; leave it out"
        )
    if head is not None:
        return head.taxonomy
    if text is not None:
        return TAXONOMIES[text] if text in TAXONOMIES else taxonomy_from_yaml(text)
    if is_dataset(inputs[0]):
        return open_dataset(inputs[0]).taxonomy
    return NUSCENES if find_scans(inputs[0])[0].name.lower().endswith(".pcd.bin") else SEMANTICKITTI
