"""The verb `analyze`."""

from __future__ import annotations

from pathlib import Path

from amvnet.cli.console import progress, say
from amvnet.cli.options import Split, make_segmenter, parse_names, parse_numbers
from amvnet.errors import InputError
from amvnet.models.methods import EngineName, Precision


def analyze(
    data: str,
    weights: str,
    out: Path,
    split: Split = "val",
    sequences: str | None = None,
    neighbours: str | None = None,
    recipe: str | None = None,
    train_sequences: str | None = None,
    device: str = "cpu",
    engine: EngineName = "auto",
    precision: Precision = "float32",
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
        recipe: how these heads are trained: a built-in recipe's name or a YAML file.
        train_sequences: sequences or scenes, separated by commas, that these heads learn from;
            default: the official split.
        device: cpu, cuda, cuda:1, ...
        engine: what runs the networks: torch, compile (starts slowly), onnx (ONNX Runtime), or
            auto, the fastest here.
        precision: of the networks; float16 on a GPU only.
        at_once: scans that are segmented at the same time on a CPU; default: one per thread, at
            most 4.
    """
    from amvnet.config.recipes import load_recipe
    from amvnet.data.datasets.base import choose_records
    from amvnet.data.datasets.select import TrainingScans, labelled_records
    from amvnet.evaluation import charts
    from amvnet.evaluation.analysis import analyze as analyze_records
    from amvnet.files import make_folder
    from amvnet.inference.inputs import open_for_weights
    from amvnet.training.fit import quiet_lightning
    from amvnet.training.studies import NeighbourStudy
    from amvnet.weights.file import load

    if (neighbours is None) != (recipe is None):
        raise InputError(
            "expected --neighbours and --recipe together, found one of them; give both or neither"
        )
    loaded = load(weights)
    dataset = open_for_weights(data, loaded)
    segmenter = make_segmenter(loaded, device, engine, precision, at_once, method="amvnet")
    records = choose_records(dataset, parse_names(sequences), split)
    records = labelled_records(dataset, records)

    # Before any scan is scored, so that no time is wasted if the study cannot be made.
    study = None
    counts: list[int] = []
    if recipe is not None:
        counts = parse_numbers(str(neighbours))
        quiet_lightning()
        names = parse_names(train_sequences) or dataset.sequences("train")
        scans = TrainingScans(dataset, labelled_records(dataset, dataset.records(names)), records)
        study = NeighbourStudy(load_recipe(recipe), loaded, scans, out)
        study.check()

    make_folder(out)
    with progress("scoring") as step:
        analysis = analyze_records(dataset, records, segmenter, step)
    written = charts.write_all(analysis, data, out)

    if study is not None:
        sweep = list(study.sweep(counts, say, device))
        used = loaded.model.point_head.neighbours
        written += charts.write_sweep(sweep, "neighbours", used, data, out / "neighbours")
    say(f"{len(written)} files in {out}")
