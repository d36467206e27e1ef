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
    pictures: Path | None = None,
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
        pictures: folder for drawings of the first clusters from above.
        overwrite: replace files that amvnet did not write, too.
    """
    from amvnet.files import make_folder
    from amvnet.inference.reading import open_for_weights
    from amvnet.ranking.label_errors import rank as rank_records
    from amvnet.ranking.label_errors import scans_path, write_ranking
    from amvnet.ranking.pictures import draw, possible_files
    from amvnet.weights.file import load
    from amvnet.written import protecting

    # Before any scan is scored, so that no time is wasted.
    make_folder(out.parent)
    files = [out, scans_path(out)]
    if pictures is not None:
        make_folder(pictures)
        files += possible_files(pictures)

    with protecting(files, overwrite):
        loaded = load(weights)
        dataset = open_for_weights(data, loaded)
        records = labelled_scans(dataset, sequences, split)
        segmenter = compute.segmenter(loaded, "ensemble")

        with progress("scoring") as step:
            ranking = rank_records(dataset, records, segmenter, step)
        scans = write_ranking(ranking, dataset.taxonomy, out)
        clusters = counted(len(ranking.clusters), "cluster")
        say(f"{clusters} in {out}, {counted(len(records), 'scan')} in {scans}")
        if pictures is not None:
            drawn = draw(ranking, dataset, segmenter, pictures)
            say(f"{counted(len(drawn), 'picture')} in {pictures}")
