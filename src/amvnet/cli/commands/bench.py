"""The command `bench`."""

from __future__ import annotations

from pathlib import Path

from amvnet.cli.console import progress, show
from amvnet.cli.options import load_for, load_segmenter
from amvnet.config.bounds import Count, Share
from amvnet.engines.compute import Compute
from amvnet.sensors.lidars import AUTO


def bench(
    compute: Compute,
    weights: str = AUTO,
    scan: Path | None = None,
    runs: Count = 10,
    tau: Share | None = None,
    json: Path | None = None,
    overwrite: bool = False,
) -> None:
    """Time each stage from a scan's file to its labels.

    Args:
        compute: where and how the networks are computed; one scan is timed at a time.
        weights: a weights file, the name of built-in weights, or auto, for the built-in weights
            that suit the lasers.
        scan: the file of the scan; default: a simulated scan.
        runs: the number of timed runs, after two warm-up runs; the table shows medians and
            quartiles.
        tau: a point is uncertain if the cosine similarity of the two networks' probabilities is at
            most this value, in [0, 1]; default: the value in the weights.
        json: also write the results to this file.
        overwrite: replace the file of --json if it exists.
    """
    from amvnet.cli.tables import timing_table
    from amvnet.data.datasets.simulated import simulate
    from amvnet.data.formats.find import read_cloud
    from amvnet.data.labels.ids import write_ids
    from amvnet.files import check_outputs, temporary_folder, write_json
    from amvnet.inference.listing import find_inputs
    from amvnet.inference.timing import FIGURES, time_runs

    if json is not None:
        check_outputs({json: FIGURES}, [weights, scan], overwrite)
    if scan is not None:
        read_cloud(scan)  # reports a broken scan before the networks are loaded

    with temporary_folder() as folder:
        if scan is None:
            simulate(folder, scans=1)
            scan = folder / "sequences/00/velodyne/000000.bin"
        _, loaded = load_for(find_inputs([str(scan)]), weights)
        segmenter = load_segmenter(loaded, "amvnet", compute, tau)

        with progress("timing") as step:
            report = time_runs(
                segmenter,
                read=lambda: read_cloud(scan).to_scan(),
                write=lambda ids: write_ids(folder / "labels.label", ids),
                runs=runs,
                progress=step,
            )

    show(timing_table(report))
    if json is not None:
        write_json(json, report)
