"""The verbs that train, or show what training gave: train, analyze, ablate."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import Any, Literal

from amvnet.cli.console import on_terminal, say
from amvnet.cli.options import (
    describe_records,
    join_processes,
    open_data,
    parse_names,
    parse_scores,
)


def train(
    recipe: Any,
    data: str,
    out: Path,
    stage: Literal["rv", "bev", "head", "all"] = "all",
    init: str | None = None,
    resume: bool = False,
    train_sequences: str | None = None,
    val_sequences: str | None = None,
    with_val: bool = False,
    dry_run: bool = False,
    taxonomy: Path | None = None,
    scores_a: Path | None = None,
    scores_b: Path | None = None,
    key_a: str | None = None,
    key_b: str | None = None,
    logits: Literal["a", "b", "both"] | None = None,
) -> None:
    """Train the two networks and the point head.

    Args:
        recipe: what to train; a built-in recipe's name or a YAML file.
        data: the data set: semantickitti:PATH, nuscenes:PATH, or a path whose layout says which.
        out: folder of the run.
        stage: which part to train; `all` trains one after the other.
        init: weights to begin with; parts that are not trained are taken from them.
        resume: go on where an earlier run in the folder stopped.
        train_sequences: sequences or scenes to train on, with commas; default: the official split.
        val_sequences: sequences or scenes to validate on, with commas; default: the official split.
        with_val: learn from these too, as for an entry to a benchmark; then nothing is validated.
        dry_run: only take two steps of each network, and say what they cost and the whole training would.
        taxonomy: a semantic-kitti.yaml with other classes.
        scores_a: with --stage head: a folder of another model's scores, to train a head for it and --scores-b.
        scores_b: a folder of the other model's scores.
        key_a: which array of each .npz in --scores-a.
        key_b: which array of each .npz in --scores-b.
        logits: which of the two are scores before softmax.
    """
    from amvnet.data.datasets.select import split_records
    from amvnet.distributed import device_of
    from amvnet.training.run import Run
    from amvnet.weights import file as weights

    _calm_lightning()
    processes = join_processes(device_of(recipe.training.accelerator) == "cuda")
    dataset = open_data(data, taxonomy)
    learnt, val = split_records(
        dataset, parse_names(train_sequences), parse_names(val_sequences), with_val
    )
    say(f"training on {describe_records(learnt)}; validating on {describe_records(val)}")
    given = None if init is None else weights.load(init)
    pair = parse_scores(scores_a, scores_b, key_a, key_b, logits)
    run = Run(recipe, dataset, learnt, val, out, resume, say, on_terminal(), processes, pair)
    if dry_run:
        for trial in run.trials(stage):
            say(trial)
        return
    say(f"weights in {run.stages(stage, given)}")


def _calm_lightning() -> None:
    for name in (
        "lightning.pytorch",
        "lightning.fabric",
    ):  # which set their levels when they are imported
        logging.getLogger(name).setLevel(logging.ERROR)
