"""The command `analyze`."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Annotated

from amvnet.cli.console import progress, report
from amvnet.cli.options import LabelledChoice, load_dataset, load_segmenter
from amvnet.config.bounds import Range, Share
from amvnet.engines.compute import Compute
from amvnet.errors import InputError, counted
from amvnet.sensors.lidars import AUTO

Neighbours = Annotated[int, Range(1, 1000)]


def analyze(
    data: str,
    /,
    out: Path,
    choice: LabelledChoice,
    compute: Compute,
    weights: str = AUTO,
    neighbours: tuple[Neighbours, ...] | None = None,
    taus: tuple[Share, ...] | None = None,
    recipe: str | None = None,
    train_sequences: tuple[str, ...] | None = None,
    overwrite: bool = False,
) -> None:
    """Draw the paper's figures: agreement, mIoU by distance, sweeps, tables by class and by method.

    Args:
        data: the dataset, with labels.
        out: folder for the diagrams (PNG), and the numbers that they show (CSV).
        choice: which scans to score.
        compute: where and how the networks are computed.
        weights: a weights file, the name of built-in weights, or auto, for the built-in weights
            that suit the lasers.
        neighbours: numbers of neighbours, separated by commas; a head is trained for each of them
            (Fig. 8b); needs --recipe.
        taus: thresholds, separated by commas; a head is trained for each of them (Fig. 8a); with
            the threshold 1, the head learns from all points; needs --recipe.
        recipe: the recipe that trains these heads: the name of a built-in recipe, or a YAML file.
        train_sequences: sequences or scenes that these heads learn from, separated by commas;
            default: the official split.
        overwrite: replace files that exist.
    """
    from amvnet.config.recipes import load_recipe
    from amvnet.data.datasets.base import choose_records
    from amvnet.data.datasets.training_data import Source, TrainingData
    from amvnet.evaluation import charts
    from amvnet.evaluation.analysis import analyze as analyze_records
    from amvnet.files import check_outputs, make_folder
    from amvnet.training.ablation import sweep_heads, with_neighbours, with_tau
    from amvnet.training.plan import Plan

    is_sweep = neighbours is not None or taus is not None
    if is_sweep != (recipe is not None):
        raise InputError(
            "expected --neighbours or --taus together with --recipe, found only one of them; "
            "give both or neither"
        )
    weights, loaded, dataset = load_dataset(data, weights)
    records = choice.records(dataset)
    model = loaded.model
    by_count = {count: with_neighbours(model, count) for count in sorted(set(neighbours or ()))}
    by_tau = {tau: with_tau(model, tau) for tau in sorted(set(taus or ()))}
    # The name of an option, of its axis, the value in the weights, and a model for each new value.
    sweeps = (
        ("neighbours", "neighbours", model.point_head.neighbours, by_count),
        ("taus", "tau", model.assertion.threshold, by_tau),
    )

    # Check the outputs and the training scans first: scoring takes long, and would be for nothing
    # if a head could not be trained or a file could not be written.
    swept = [option for option, _, _, models in sweeps if models]
    outputs = charts.files_of(out, (*charts.FIGURES, *swept), charts.TABLES)
    check_outputs(outputs, [data, weights, recipe], overwrite)
    plan = None
    if recipe is not None:
        train = dataset.labelled(choose_records(dataset, train_sequences, "train"))
        scans = TrainingData([Source(dataset, train, records)])
        plan = Plan(load_recipe(recipe), scans, out, stage="head", resume=True, report=report)

    segmenter = load_segmenter(loaded, "amvnet", compute)
    make_folder(out)
    with progress("scoring") as step:
        analysis = analyze_records(dataset, records, segmenter, step)
    written = charts.write_all(analysis, data, out)

    if plan is not None:
        for option, axis, value_in_weights, models in sweeps:
            if models:
                sweep_plan = replace(plan, out=out / option)
                rows = list(sweep_heads(sweep_plan, models, loaded, segmenter.device))
                written += charts.write_sweep(rows, axis, value_in_weights, data, out / option)
    report(f"{counted(len(written), 'file')} in {out}")
