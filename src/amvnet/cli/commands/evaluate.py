"""The verb `evaluate`."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from amvnet.cli.commands.predict import PrecisionName
from amvnet.cli.console import console, progress
from amvnet.cli.options import join_processes, open_data, parse_methods, parse_names
from amvnet.errors import InputError

if TYPE_CHECKING:
    from amvnet.data.taxonomy import Taxonomy
    from amvnet.evaluation.metrics import Evaluation


def evaluate(
    data: str,
    weights: str | None = None,
    predictions: Path | None = None,
    split: Literal["train", "val", "test", "all"] = "val",
    sequences: str | None = None,
    methods: str = "rv,bev,ensemble,amvnet",
    json: Path | None = None,
    pictures: Path | None = None,
    taxonomy: Path | None = None,
    device: str = "cpu",
    precision: PrecisionName = "float32",
) -> None:
    """Score weights, or predictions of any tool, by the benchmark's official formulas.

    Args:
        data: the data set.
        weights: a weights file, or the name of a built-in one: all methods are scored.
        predictions: a folder of predictions in the benchmark's layout, instead of weights.
        split: the official split to score.
        sequences: sequences or scenes to score instead, with commas.
        methods: what to score of weights, with commas; arithmetic and maximum are the other ensembles.
        json: file for all figures.
        pictures: folder for drawings of some scans from above.
        taxonomy: a semantic-kitti.yaml with other classes.
        device: cpu, cuda, cuda:1, ...
        precision: of the networks; float16 on a GPU only.
    """
    from amvnet.data.datasets.select import choose_records, custom_taxonomy
    from amvnet.evaluation import scoring as jobs
    from amvnet.files import make_folder
    from amvnet.inference.methods import widest_method
    from amvnet.inference.segmenter import Segmenter
    from amvnet.weights.file import load

    if (weights is None) == (predictions is None):
        raise InputError(
            "expected either --weights or --predictions, found both or neither; give one of them"
        )
    processes = join_processes()
    given = None if weights is None else load(weights)
    dataset = open_data(data, taxonomy, None if given is None else custom_taxonomy(given.taxonomy))
    records = choose_records(dataset, parse_names(sequences), split)
    if given is not None:
        segmenter = Segmenter(given, processes.device(device), widest_method(given), precision)
        label = jobs.label_by_weights(dataset, segmenter, parse_methods(methods))
    else:
        label = jobs.label_from_files(dataset, Path(str(predictions)))
    for path in (json, pictures):  # so that nothing is scored in vain
        if path is not None:
            make_folder(path.parent)
    with progress("scoring") as step:
        found = jobs.evaluate(dataset, records, label, pictures, step, processes)
    if processes.first:
        show_evaluation(found, data, dataset.taxonomy, json)


def show_evaluation(
    evaluation: Evaluation, dataset: str, taxonomy: Taxonomy, path: Path | None
) -> None:
    """Print the table, and write the same figures as JSON."""
    from amvnet.cli.tables import evaluation_table
    from amvnet.files import atomic_write

    figures = evaluation.report(dataset)
    console.print(evaluation_table(figures, taxonomy))
    if path is not None:
        with atomic_write(path) as part:
            part.write_text(json.dumps(figures, indent=1))
