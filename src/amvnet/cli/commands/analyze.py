"""The verb `analyze`."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from amvnet.cli.commands.train import _calm_lightning
from amvnet.cli.console import progress, say
from amvnet.cli.options import open_data, parse_names, parse_numbers
from amvnet.errors import InputError

if TYPE_CHECKING:
    from amvnet.evaluation.analysis import Swept


def analyze(
    data: str,
    weights: str,
    out: Path,
    split: Literal["train", "val", "test", "all"] = "val",
    sequences: str | None = None,
    neighbours: str | None = None,
    recipe: str | None = None,
    train_sequences: str | None = None,
    device: str = "cpu",
) -> None:
    """Draw what the paper shows of the method: agreement, mIoU by distance, sweeps, tables by class and by method.

    Args:
        data: the data set, with labels.
        weights: a weights file, or the name of a built-in one.
        out: folder for the figures (PNG), and the same figures as CSV and Markdown.
        split: the official split to score.
        sequences: sequences or scenes to score instead, with commas.
        neighbours: also train a head for each of these numbers of neighbours, with commas; needs a recipe.
        recipe: what says how these heads are trained: a built-in recipe's name or a YAML file.
        train_sequences: sequences or scenes that these heads learn from, with commas; default: the official split.
        device: cpu, cuda, cuda:1, ...
    """
    from amvnet.config.recipes import load_recipe
    from amvnet.data.datasets.select import check_classes, choose_records, custom_taxonomy
    from amvnet.evaluation import charts
    from amvnet.evaluation.analysis import analyze as score
    from amvnet.files import make_folder
    from amvnet.inference.segmenter import Segmenter
    from amvnet.training.run import Run
    from amvnet.training.studies import sweep_neighbours
    from amvnet.weights.file import load

    if (neighbours is None) != (recipe is None):
        raise InputError(
            "expected --neighbours and --recipe together, found one of them; give both or neither"
        )
    given = load(weights)
    dataset = open_data(data, None, custom_taxonomy(given.taxonomy))
    segmenter = Segmenter(given, device)
    check_classes(dataset, given.taxonomy)
    records = choose_records(dataset, parse_names(sequences), split)
    heads: Iterable[Swept] = ()
    if recipe is not None:
        _calm_lightning()
        learnt = dataset.records(parse_names(train_sequences) or dataset.sequences("train"))
        chosen, counts = load_recipe(recipe), parse_numbers(str(neighbours))
        Run(chosen, dataset, learnt, records, out)  # so that nothing is scored in vain
        heads = sweep_neighbours(chosen, given, dataset, learnt, records, counts, out, say, device)
    make_folder(out)
    with progress("scoring") as step:
        found = score(dataset, records, segmenter, step)
    written = charts.write_all(found, data, out)
    if swept := list(heads):
        used = given.model.point_head.neighbours
        written += charts.write_sweep(swept, "neighbours", used, data, out / "neighbours")
    say(f"{len(written)} files in {out}")
