"""The verb `rank`."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from amvnet.cli.console import progress, say
from amvnet.cli.options import open_data, parse_names


def rank(
    data: str,
    weights: str,
    out: Path,
    by: Literal["disagreement", "labels"] = "disagreement",
    split: Literal["train", "val", "test", "all"] = "all",
    sequences: str | None = None,
    pictures: Path | None = None,
    device: str = "cpu",
) -> None:
    """Say which clusters of points, and which scans, to look at next: to label them, or to correct their labels.

    Args:
        data: the data set.
        weights: a weights file with both networks, or the name of a built-in one.
        out: the table of the clusters, FILE.csv; that of the scans is written beside it, FILE-scans.csv.
        by: what is doubted: disagreement of the two views (what to label next), or labels that both contradict.
        split: the official split.
        sequences: sequences or scenes instead, with commas.
        pictures: folder for drawings of the first clusters from above.
        device: cpu, cuda, cuda:1, ...
    """
    from amvnet.data.datasets.select import choose_records, custom_taxonomy
    from amvnet.files import make_folder
    from amvnet.inference.methods import widest_method
    from amvnet.inference.segmenter import Segmenter
    from amvnet.ranking import rank as ranking
    from amvnet.ranking.pictures import draw
    from amvnet.weights.file import load

    given = load(weights)
    dataset = open_data(data, None, custom_taxonomy(given.taxonomy))
    records = choose_records(dataset, parse_names(sequences), split)
    segmenter = Segmenter(given, device, widest_method(given))
    for folder in (
        out.parent,
        *([] if pictures is None else [pictures]),
    ):  # so that nothing is scored in vain
        make_folder(folder)
    with progress("scoring") as step:
        found = ranking.rank(dataset, records, segmenter, by, step)
    scans = ranking.write_ranking(found, dataset.taxonomy, out)
    say(f"{len(found.clusters)} clusters in {out}, {len(records)} scans in {scans}")
    if pictures is not None:
        say(f"{len(draw(found, dataset, segmenter, by, pictures))} pictures in {pictures}")
