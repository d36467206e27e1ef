"""The command `fuse`."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from amvnet.cli.console import progress, report
from amvnet.cli.options import ScanChoice, ScoresChoice
from amvnet.config.bounds import Share
from amvnet.errors import InputError, counted


def fuse(
    inputs: list[str],
    /,
    out: Path,
    models: ScoresChoice,
    choice: ScanChoice,
    head: str | None = None,
    tau: Share | None = None,
    taxonomy: Literal["semantickitti", "nuscenes"] | None = None,
    overwrite: bool = False,
) -> None:
    """Fuse the scores of any two models into labels, by the point head or by the ensemble.

    Args:
        inputs: datasets, scan files, or folders of scans.
        out: folder for the labels.
        models: the scores of the two models.
        choice: which scans of the inputs to label.
        head: weights with a point head, trained on the scores of these two models or on the scores
            of two networks; default: the ensemble, without a head.
        tau: a point is uncertain if the cosine similarity of the two models' scores is at
            most this value, in [0, 1]; default: the value in the head's weights, or 0.85 without a
            head.
        taxonomy: the classes; default: the classes of the head or of the inputs.
        overwrite: replace files that exist.
    """
    from amvnet.data.taxonomy import TAXONOMIES
    from amvnet.inference.fuse import fuse_files
    from amvnet.inference.pipeline import OutputOptions
    from amvnet.weights.file import load

    pair = models.parse()
    if pair is None:
        raise InputError(
            "expected --scores-a and --scores-b, found none; give the scores of two models"
        )
    weights = None if head is None else load(head)
    if weights is not None and taxonomy is not None:
        raise InputError(
            "expected no --taxonomy together with --head, which defines its classes; leave it out"
        )
    classes = None if taxonomy is None else TAXONOMIES[taxonomy]

    with progress("fusing") as step:
        fused = fuse_files(
            choice.find(inputs),
            pair,
            OutputOptions(out, overwrite=overwrite, also_read=(*inputs, head)),
            head=weights,
            tau=tau,
            taxonomy=classes,
            progress=step,
        )
    for side, share in fused.silent.items():
        if share:
            folder = models.scores_a if side == "a" else models.scores_b
            report(f"{folder} ({side}): no opinion on {share:.1%} of the points")
    files = counted(fused.files, "label file")
    report(f"{files} in {out}; the two models disagree on {fused.uncertain:.1%} of the points")
