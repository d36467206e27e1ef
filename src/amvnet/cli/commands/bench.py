"""The verb that times a machine: bench."""

from __future__ import annotations

from json import dumps
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Literal

from amvnet.cli.console import console, progress
from amvnet.cli.options import parse_names

PrecisionName = Literal["float32", "bfloat16", "float16"]


def bench(
    weights: str = "sim-hdl64e",
    recipe: str | None = None,
    scan: Path | None = None,
    runs: int = 10,
    uncertain: float | None = None,
    engines: str = "torch",
    device: str = "cpu",
    precision: PrecisionName = "float32",
    json: Path | None = None,
) -> None:
    """Time the stages from a scan's file to its labels on this machine, and compare the networks with its limit.

    Args:
        weights: a weights file, or the name of a built-in one.
        recipe: the name of a recipe, or a YAML file, whose networks are timed with random weights instead.
        scan: the scan to time with; by default a simulated one.
        runs: how often, after two that warm up; medians are shown, and between what half of the runs lie.
        uncertain: the share of the points that counts as uncertain; by default as the weights find, 0.1 with --recipe.
        engines: torch, compile, onnx, or several with commas, which are timed in turn.
        device: cpu, cuda, cuda:1, ...
        precision: of the networks; float16 on a GPU only.
        json: also write the figures to this file.
    """
    from amvnet.cli.tables import timing_table
    from amvnet.config.recipes import load_recipe
    from amvnet.data.scan_files import read_scan, write_labels
    from amvnet.export.engines import use_engine
    from amvnet.files import atomic_write
    from amvnet.inference.segmenter import Segmenter
    from amvnet.inference.timing import UNCERTAIN, Job, time_jobs, untrained
    from amvnet.simulation import simulate as write

    given = untrained(load_recipe(recipe)) if recipe is not None else weights
    share = UNCERTAIN if recipe is not None and uncertain is None else uncertain
    with TemporaryDirectory() as folder:
        if scan is None:
            write(Path(folder), scans=1)
        path, labels = (
            scan or Path(folder) / "sequences/00/velodyne/000000.bin",
            Path(folder) / "labels.label",
        )
        jobs = []
        for engine in parse_names(engines) or []:
            segmenter = Segmenter(given, device, precision=precision)
            name = use_engine(segmenter, engine)
            name = name if precision == "float32" else f"{name}, {precision}"
            jobs.append(
                Job(
                    segmenter,
                    lambda: read_scan(path),
                    lambda ids: write_labels(labels, ids),
                    name,
                    share,
                )
            )
        with progress("timing") as step:
            reports = time_jobs(jobs, runs, step)
    console.print(*(timing_table(report) for report in reports), sep="\n")
    if json is not None:
        with atomic_write(json) as part:
            part.write_text(dumps(reports, indent=1))
