"""The command `rank`."""

from __future__ import annotations

from pathlib import Path

from amvnet.cli.console import progress, report
from amvnet.cli.options import LabelledChoice, load_dataset, load_segmenter
from amvnet.engines.compute import Compute
from amvnet.errors import counted
from amvnet.sensors.lidars import AUTO


def rank(
    data: str,
    /,
    out: Path,
    choice: LabelledChoice,
    compute: Compute,
    weights: str = AUTO,
    overwrite: bool = False,
) -> None:
    """Rank clusters of points whose labels both views contradict, so that you can check them.

    Args:
        data: the dataset, with labels.
        out: the file of the table, FILE.csv.
        choice: which scans to rank.
        compute: where and how the networks are computed.
        weights: a weights file with both networks, the name of built-in weights, or auto, for the
            built-in weights that suit the lasers.
        overwrite: replace the table if it exists.
    """
    from amvnet.evaluation.label_errors import TABLE, write_clusters
    from amvnet.evaluation.label_errors import rank as rank_records
    from amvnet.files import check_outputs, make_folder

    # Check the output before any scan is scored, so that no time is wasted.
    check_outputs({out: TABLE}, [data, weights], overwrite)
    make_folder(out.parent)
    _, loaded, dataset = load_dataset(data, weights)
    records = choice.records(dataset, "all")
    segmenter = load_segmenter(loaded, "ensemble", compute)

    with progress("scoring") as step:
        clusters = rank_records(dataset, records, segmenter, step)
    write_clusters(clusters, records, dataset.taxonomy, out)
    report(f"{counted(len(clusters), 'cluster')} in {counted(len(records), 'scan')}; see {out}")
