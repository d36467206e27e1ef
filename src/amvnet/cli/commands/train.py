"""The command `train`."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from amvnet.cli import options
from amvnet.cli.console import on_terminal, report
from amvnet.config.schema import BOTH_NETWORKS, Recipe


def train(
    recipe: Recipe,
    /,
    data: list[str],
    out: Path,
    choice: options.TrainingChoice,
    models: options.ScoresChoice,
    stage: Literal["rv", "bev", "head", "all"] = "all",
    init: str | None = None,
    resume: bool = False,
    with_val: bool = False,
) -> None:
    """Train the two networks and the point head.

    Args:
        recipe: the name of a built-in recipe, or a YAML file.
        data: the dataset: semantickitti:PATH, nuscenes:PATH, or a path with one of these layouts;
            a YAML file that describes scans and classes of your own (docs/own_data.md);
            simulated-NAME:FOLDER, with a known sensor or any, for streets that are simulated during
            the training and cached in the folder. If several are given, the first one is split and
            validated, and the training scans of the others are mixed in: all of them, or as many as
            --training.others says.
        out: folder of the run.
        choice: which scans to train on and to validate with.
        models: with --stage head, the scores of two other models to train a head on.
        stage: which part to train; all trains the parts that the recipe lists under stages, one
            after the other.
        init: weights to begin with; parts that are not trained are copied. From weights with other
            classes, all layers except the last ones are copied. Stages that the folder has finished
            keep the weights of the folder.
        resume: continue an earlier run in the folder.
        with_val: also train on the validation scans, and skip the validation, as for an entry to a
            benchmark.
    """
    from amvnet.runtime.distributed import device_of
    from amvnet.training.plan import Plan
    from amvnet.training.run import train as train_stages
    from amvnet.training.run_folder import RunFolder
    from amvnet.weights.file import load

    if not resume:
        # Refuse a folder with another run now, because reading all scans takes long.
        for name in recipe.stages if stage == "all" else (stage,):
            RunFolder(out).stages[name].check_begun()
    processes = options.join_processes(device_of(recipe.training.accelerator) == "cuda")
    plan = Plan.open(
        recipe,
        data,
        out,
        choose=lambda dataset: choice.source(dataset, with_val),
        init=None if init is None else load(init),
        stage=stage,
        report=report,
        resume=resume,
        bars=on_terminal(),
        processes=processes,
        scores=models.parse(),
        also_read=(*data, init),
    )
    for other in plan.data.sources[1:]:  # `choose` has reported on the first one
        options.report_unused(other, f"{other.dataset.spec}: ")
    trained_on = options.describe_records(plan.data.train)
    report(f"training on {trained_on}; validating on {options.describe_records(plan.data.val)}")

    trained = train_stages(plan)
    line = f"weights in {trained}"
    parts = load(trained).parts
    if stage != "head" and set(BOTH_NETWORKS) <= set(parts) and "point_head" not in parts:
        line += "; they have no point head yet: train it by the same command with --stage head"
    report(line)
