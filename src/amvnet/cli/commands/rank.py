"""The command `rank`."""

from __future__ import annotations

from pathlib import Path

from amvnet.cli.console import progress, report
from amvnet.cli.options import LabelledChoice, load_segmenter
from amvnet.engines.compute import Compute
from amvnet.progress import counted


def rank(
    data: str,
    /,
    weights: str,
    out: Path,
    choice: LabelledChoice,
    compute: Compute,
    overwrite: bool = False,
) -> None:
    """Rank clusters of points whose labels both views contradict, so that you can check them.

    Args:
        data: the dataset, with labels.
        weights: a weights file with both networks, or the name of built-in weights.
        out: the file of the table, FILE.csv.
        choice: which scans to rank.
        compute: where and how the networks are computed.
        overwrite: replace the table if it exists.
    """
    from amvnet.data.datasets.open import open_dataset
    from amvnet.evaluation.label_errors import TABLE, write_clusters
    from amvnet.evaluation.label_errors import rank as rank_records
    from amvnet.files import make_folder
    from amvnet.outputs import check_outputs
    from amvnet.sensors.normalise import Normaliser, normalised
    from amvnet.weights.file import load

    # Check this before any scan is scored, so that no time is wasted.
    check_outputs({out: TABLE}, [data, weights], overwrite)
    make_folder(out.parent)
    loaded = load(weights)
    dataset = normalised(open_dataset(data, loaded.taxonomy), Normaliser(loaded.expects))
    records = choice.records(dataset, "all")
    segmenter = load_segmenter(loaded, "ensemble", compute)

    with progress("scoring") as step:
        clusters = rank_records(dataset, records, segmenter, step)
    write_clusters(clusters, records, dataset.taxonomy, out)
    report(f"{counted(len(clusters), 'cluster')} in {counted(len(records), 'scan')}; see {out}")
