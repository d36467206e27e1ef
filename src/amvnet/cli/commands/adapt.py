"""The command `adapt`."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

from amvnet.cli import options
from amvnet.cli.console import on_terminal, progress, report
from amvnet.config.bounds import Count, Seed, Share
from amvnet.engines.compute import Compute, resolved
from amvnet.errors import InputError
from amvnet.sensors.lidars import AUTO

if TYPE_CHECKING:
    from amvnet.data.datasets.base import Dataset
    from amvnet.inference.segmenter import Segmenter
    from amvnet.training.plan import Plan
    from amvnet.weights.file import Weights


def adapt(
    inputs: list[str],
    /,
    out: Path,
    choice: options.ScanChoice,
    sensor_choice: options.SensorChoice,
    compute: Compute,
    weights: str = AUTO,
    poses: Path | None = None,
    loose: bool = False,
    epochs: Count | None = None,
    streets: Share = 0.5,
    seed: Seed | None = None,
    val: str | None = None,
    val_sequences: tuple[str, ...] | None = None,
    resume: bool = False,
) -> None:
    """Teach weights by an unlabelled drive: by the consensus of their own labels over time.

    Args:
        inputs: the scans of one or several drives: datasets, bags, folders or patterns.
        out: folder of the run; it then holds the adapted weights.
        choice: which scans of the inputs to use.
        sensor_choice: what is known about the sensor of scan files.
        compute: where and how the networks are computed.
        weights: the weights that label the drive, and that the training begins with: a weights
            file with both networks, the name of built-in weights, or auto, for the built-in
            weights that suit the lasers.
        poses: the poses of the LiDAR, as predict takes them; default: the dataset's, or estimated
            by KISS-ICP.
        loose: the scans are no drive; each teaches by its own labels.
        epochs: number of epochs; default: 5.
        streets: share of simulated streets in an epoch, which keep the networks from forgetting
            classes that the drive lacks; 0 for none.
        seed: the seed of the training; default: 0.
        val: a dataset with labels, which score the weights before and after, and so decide which
            are kept; default: figures that need no labels decide.
        val_sequences: sequences or scenes of --val, separated by commas; default: all with labels.
        resume: continue an earlier run in the folder.
    """
    from amvnet.data.datasets.base import choose_records
    from amvnet.data.datasets.simulated import SimulatedStreets
    from amvnet.data.datasets.training_data import Source, TrainingData, to_mix_in
    from amvnet.inference.drive import find_poses
    from amvnet.models.methods import check_method
    from amvnet.training.adapt import adapt as adapt_weights
    from amvnet.training.adapt import recipe_for
    from amvnet.training.plan import Plan

    if loose and poses:
        raise InputError("--poses: expected no --loose, whose scans are no drive; leave one out")
    if val_sequences and not val:
        raise InputError("--val-sequences: expected --val, found none; add it")
    found, weights, loaded = options.open_inputs(inputs, choice, sensor_choice, weights)
    check_method("amvnet", loaded.parts)
    scans = found.for_weights(loaded, report)
    request = options.LabelChoice().parse(loaded, found.reading, resolved(compute))
    recipe = recipe_for(loaded, epochs, streets, seed)
    drives = None
    if not loose:
        with progress("poses") as step:
            drives = find_poses(scans, poses, progress=step, report=report)

    def make_segmenter(chosen: Weights) -> Segmenter:
        return options.load_segmenter(chosen, "amvnet", compute)

    def make_plan(dataset: Dataset) -> Plan:
        sources = [Source(dataset, choose_records(dataset, None, "all"))]
        if streets:
            sources.append(to_mix_in(SimulatedStreets(out / "streets", loaded.sensor)))
        return Plan(
            recipe,
            TrainingData(sources, recipe.training.others),
            out,
            init=loaded,
            resume=resume,
            report=report,
            bars=on_terminal(),
            also_read=(*inputs, weights, poses, val),
            expects=loaded.expects,  # to which the scans are normalised
        )

    score = None if val is None else _score_on(val, val_sequences, loaded)
    path = adapt_weights(
        scans,
        drives,
        loaded,
        make_segmenter,
        make_plan,
        score,
        request=request.digest_of(scans, drives),
        progress=progress,
    )
    report(f"weights in {path}")


def _score_on(
    val: str, sequences: tuple[str, ...] | None, weights: Weights
) -> Callable[[Segmenter], float]:
    """Return a function that returns the mIoU of a segmenter on labelled scans, in [0, 1]."""
    from amvnet.data.datasets.open import open_dataset
    from amvnet.evaluation.scoring import evaluate, label_by_weights
    from amvnet.sensors.normalise import Normaliser, normalised

    dataset = normalised(open_dataset(val, weights.taxonomy), Normaliser(weights.expects))
    records = options.LabelledChoice("all", sequences).records(dataset)

    def score(segmenter: Segmenter) -> float:
        labeller = label_by_weights(segmenter, ["amvnet"])
        with progress("scoring") as step:
            evaluation = evaluate(dataset, records, labeller, progress=step)
        miou: float = evaluation.report(val)["methods"]["amvnet"]["miou"]
        return miou

    return score
