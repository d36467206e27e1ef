"""The verb `rank`."""

from __future__ import annotations

from pathlib import Path

from amvnet.cli.console import progress, say
from amvnet.cli.options import ComputeChoice, Split, labelled_scans
from amvnet.progress import counted


def rank(
    data: str,
    weights: str,
    out: Path,
    compute: ComputeChoice,
    split: Split = "all",
    sequences: str | None = None,
    overwrite: bool = False,
) -> None:
    """Rank clusters of points, and scans, whose labels both views contradict, to check them.

    Args:
        data: the dataset, with labels.
        weights: a weights file with both networks, or the name of a built-in one.
        out: the table of the clusters, FILE.csv; that of the scans is FILE-scans.csv.
        compute: where and how the networks are computed.
        split: the official split.
        sequences: sequences or scenes instead, separated by commas.
        overwrite: replace files that amvnet did not write, too.
    """
    from amvnet.files import make_folder
    from amvnet.inference.reading import open_for_weights
    from amvnet.ranking.label_errors import rank as rank_records
    from amvnet.ranking.label_errors import scans_path, write_ranking
    from amvnet.weights.file import load
    from amvnet.written import protecting

    # Before any scan is scored, so that no time is wasted.
    make_folder(out.parent)
    with protecting([out, scans_path(out)], overwrite):
        loaded = load(weights)
        dataset = open_for_weights(data, loaded)
        records = labelled_scans(dataset, sequences, split)
        segmenter = compute.segmenter(loaded, "ensemble")

        with progress("scoring") as step:
            ranking = rank_records(dataset, records, segmenter, step)
        scans = write_ranking(ranking, dataset.taxonomy, out)
        clusters = counted(len(ranking.clusters), "cluster")
        say(f"{clusters} in {out}, {counted(len(records), 'scan')} in {scans}")
