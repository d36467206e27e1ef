"""The verb `analyze`."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from amvnet.cli.console import progress, say
from amvnet.cli.options import (
    NEIGHBOURS,
    ComputeChoice,
    Split,
    labelled_scans,
    parse_names,
    parse_numbers,
)
from amvnet.config.bounds import Range
from amvnet.errors import InputError
from amvnet.progress import counted


def analyze(
    data: str,
    weights: str,
    out: Path,
    compute: ComputeChoice,
    split: Split = "val",
    sequences: str | None = None,
    neighbours: str | None = None,
    taus: str | None = None,
    recipe: str | None = None,
    train_sequences: str | None = None,
) -> None:
    """Draw the paper's figures: agreement, mIoU by distance, sweeps, tables by class and by method.

    Args:
        data: the dataset, with labels.
        weights: a weights file, or the name of a built-in one.
        out: folder for the figures (PNG), and the same figures as CSV and Markdown.
        compute: where and how the networks are computed.
        split: the official split to score.
        sequences: sequences or scenes, separated by commas, to score instead.
        neighbours: also train a head for each of these numbers of neighbours, separated by commas;
            needs a recipe.
        taus: also train a head for each of these values of tau, separated by commas (Fig. 8a; 1
            makes all points uncertain); needs a recipe.
        recipe: how these heads are trained: a built-in recipe's name or a YAML file.
        train_sequences: sequences or scenes, separated by commas, that these heads learn from;
            default: the official split.
    """
    from amvnet.config.recipes import load_recipe
    from amvnet.data.datasets.select import TrainingScans
    from amvnet.evaluation import charts
    from amvnet.evaluation.analysis import analyze as analyze_records
    from amvnet.files import make_folder
    from amvnet.inference.reading import open_for_weights
    from amvnet.training.ablation import HeadStudy
    from amvnet.weights.file import load

    if (neighbours is None and taus is None) != (recipe is None):
        raise InputError(
            "expected --neighbours or --taus together with --recipe, found only one of them; "
            "give both or neither"
        )
    loaded = load(weights)
    dataset = open_for_weights(data, loaded)
    segmenter = compute.segmenter(loaded, "amvnet")
    records = labelled_scans(dataset, sequences, split)

    # Before any scan is scored, so that no time is wasted if the study cannot be made.
    studies: list[tuple[HeadStudy, Sequence[float]]] = []
    if recipe is not None:
        loaded_recipe = load_recipe(recipe)
        names = parse_names(train_sequences) or dataset.sequences("train")
        scans = TrainingScans(dataset, dataset.labelled(dataset.records(names)), records)
        if taus is not None:
            study = HeadStudy("taus", loaded_recipe, loaded, scans, out)
            studies.append((study, parse_numbers(taus, float, Range(0, 1), "0.7,0.85,1")))
        if neighbours is not None:
            study = HeadStudy("neighbours", loaded_recipe, loaded, scans, out)
            studies.append((study, parse_numbers(neighbours, int, NEIGHBOURS, "5,10,15")))
        for study, _ in studies:
            study.check()

    make_folder(out)
    with progress("scoring") as step:
        analysis = analyze_records(dataset, records, segmenter, step)
    written = charts.write_all(analysis, data, out)

    for study, values in studies:
        sweep = list(study.sweep(values, say, segmenter.device))
        used = analysis.tau if study.name == "taus" else loaded.model.point_head.neighbours
        title = "tau, a head for each" if study.name == "taus" else "neighbours"
        written += charts.write_sweep(sweep, title, used, data, out / study.name)
    say(f"{counted(len(written), 'file')} in {out}")
