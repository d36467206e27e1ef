"""The verb `analyze`."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from amvnet.cli.console import progress, say
from amvnet.cli.options import Split, make_segmenter, parse_names, parse_numbers, parse_taus
from amvnet.errors import InputError
from amvnet.models.methods import EngineName, Precision
from amvnet.progress import counted


def analyze(
    data: str,
    weights: str,
    out: Path,
    split: Split = "val",
    sequences: str | None = None,
    neighbours: str | None = None,
    taus: str | None = None,
    recipe: str | None = None,
    train_sequences: str | None = None,
    device: str = "auto",
    engine: EngineName = "auto",
    precision: Precision = "auto",
    at_once: int | None = None,
) -> None:
    """Draw the paper's figures: agreement, mIoU by distance, sweeps, tables by class and by method.

    Args:
        data: the dataset, with labels.
        weights: a weights file, or the name of a built-in one.
        out: folder for the figures (PNG), and the same figures as CSV and Markdown.
        split: the official split to score.
        sequences: sequences or scenes, separated by commas, to score instead.
        neighbours: also train a head for each of these numbers of neighbours, separated by commas;
            needs a recipe.
        taus: also train a head for each of these values of tau, separated by commas (Fig. 8a; 1
            makes all points uncertain); needs a recipe.
        recipe: how these heads are trained: a built-in recipe's name or a YAML file.
        train_sequences: sequences or scenes, separated by commas, that these heads learn from;
            default: the official split.
        device: cpu, cuda, cuda:1, ..., or auto: cuda if there is a GPU.
        engine: what runs the networks: torch, compile (starts slowly), onnx (ONNX Runtime), int8
            (the same in 8-bit integers, calibrated once; a few labels change), or auto, the fastest
            here that changes none.
        precision: of the networks; float16 on a GPU only; auto: bfloat16 on a GPU, else float32.
        at_once: scans that are segmented at the same time on a CPU; default: one per
            core, if the memory suffices.
    """
    from amvnet.config.recipes import load_recipe
    from amvnet.data.datasets.base import choose_records
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
    segmenter = make_segmenter(loaded, device, engine, precision, at_once, method="amvnet")
    records = choose_records(dataset, parse_names(sequences), split)
    records = dataset.labelled(records)

    # Before any scan is scored, so that no time is wasted if the study cannot be made.
    studies: list[tuple[HeadStudy, Sequence[float]]] = []
    if recipe is not None:
        loaded_recipe = load_recipe(recipe)
        names = parse_names(train_sequences) or dataset.sequences("train")
        scans = TrainingScans(dataset, dataset.labelled(dataset.records(names)), records)
        if taus is not None:
            study = HeadStudy("taus", loaded_recipe, loaded, scans, out)
            studies.append((study, parse_taus(taus)))
        if neighbours is not None:
            study = HeadStudy("neighbours", loaded_recipe, loaded, scans, out)
            studies.append((study, parse_numbers(str(neighbours))))
        for study, _ in studies:
            study.check()

    make_folder(out)
    with progress("scoring") as step:
        analysis = analyze_records(dataset, records, segmenter, step)
    written = charts.write_all(analysis, data, out)

    for study, values in studies:
        sweep = list(study.sweep(values, say, device))
        used = analysis.tau if study.name == "taus" else loaded.model.point_head.neighbours
        title = "tau, a head for each" if study.name == "taus" else "neighbours"
        written += charts.write_sweep(sweep, title, used, data, out / study.name)
    say(f"{counted(len(written), 'file')} in {out}")
