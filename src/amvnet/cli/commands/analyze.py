"""The verb `analyze`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from amvnet.cli.console import progress, say
from amvnet.cli.options import LabelledChoice
from amvnet.config.bounds import Range
from amvnet.errors import InputError
from amvnet.models.methods import Compute
from amvnet.progress import counted

Neighbours = Annotated[int, Range(1, 1000)]


def analyze(
    data: str,
    /,
    weights: str,
    out: Path,
    choice: LabelledChoice,
    compute: Compute,
    neighbours: tuple[Neighbours, ...] | None = None,
    recipe: str | None = None,
    train_sequences: tuple[str, ...] | None = None,
) -> None:
    """Draw the paper's figures: agreement, mIoU by distance, sweeps, tables by class and by method.

    Args:
        data: the dataset, with labels.
        weights: a weights file, or the name of a built-in one.
        out: folder for the figures (PNG), and the same figures as CSV.
        choice: which scans to score.
        compute: where and how the networks are computed.
        neighbours: also train a head for each of these numbers of neighbours, separated by commas
            (Fig. 8b); needs a recipe.
        recipe: how these heads are trained: a built-in recipe's name or a YAML file.
        train_sequences: sequences or scenes, separated by commas, that these heads learn from;
            default: the official split.
    """
    from amvnet.config.recipes import load_recipe
    from amvnet.data.datasets.select import TrainingScans
    from amvnet.evaluation import charts
    from amvnet.evaluation.analysis import analyze as analyze_records
    from amvnet.export.engines import make_segmenter
    from amvnet.files import make_folder
    from amvnet.inference.reading import open_for_weights
    from amvnet.training.ablation import sweep_neighbours
    from amvnet.training.plan import Plan
    from amvnet.weights.file import load

    if (neighbours is None) != (recipe is None):
        raise InputError(
            "expected --neighbours together with --recipe, found only one of them; "
            "give both or neither"
        )
    loaded = load(weights)
    dataset = open_for_weights(data, loaded)
    segmenter = make_segmenter(loaded, "amvnet", compute, say=say)
    records = choice.records(dataset)

    # Before any scan is scored, so that no time is wasted if the study cannot be made.
    counts: list[int] = []
    plan = None
    if neighbours is not None and recipe is not None:
        counts = sorted(set(neighbours))
        names = train_sequences or dataset.sequences("train")
        scans = TrainingScans(dataset, dataset.labelled(dataset.records(names)), records)
        folder = out / "neighbours"
        plan = Plan(load_recipe(recipe), scans, folder, resume=True, say=say)

    make_folder(out)
    with progress("scoring") as step:
        analysis = analyze_records(dataset, records, segmenter, step)
    written = charts.write_all(analysis, data, out)

    if plan is not None:
        sweep = list(sweep_neighbours(plan, counts, loaded, segmenter.device))
        used = loaded.model.point_head.neighbours
        written += charts.write_sweep(sweep, "neighbours", used, data, out / "neighbours")
    say(f"{counted(len(written), 'file')} in {out}")
