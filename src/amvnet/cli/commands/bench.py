"""The verb `bench`."""

from __future__ import annotations

from json import dumps
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING

from amvnet.cli.console import progress, show
from amvnet.cli.options import WEIGHTS, make_segmenter, parse_names
from amvnet.models.methods import Precision

if TYPE_CHECKING:
    from amvnet.inference.segmenter import Segmenter
    from amvnet.inference.timing import Job


def bench(
    weights: str = WEIGHTS,
    recipe: str | None = None,
    scan: Path | None = None,
    runs: int = 10,
    uncertain: float | None = None,
    tau: float | None = None,
    engines: str = "torch",
    device: str = "auto",
    precision: Precision = "auto",
    json: Path | None = None,
) -> None:
    """Time each stage from a scan's file to its labels, and the networks against a matrix product.

    Args:
        weights: a weights file, or the name of a built-in one.
        recipe: the name of a recipe, or a YAML file, whose networks are timed with random weights
            instead.
        scan: the scan to time with; by default a simulated one.
        runs: the number of timed runs, after two warm-up runs; medians and quartiles are shown.
        uncertain: the share of the points that counts as uncertain; default: the share that the
            networks disagree on, or 0.1 with --recipe.
        tau: the cosine similarity of the two networks' probabilities up to which points are
            uncertain, in [0, 1]; default: that of the weights.
        engines: torch, compile, onnx, int8, or several separated by commas, which are timed in
            turn.
        device: cpu, cuda, cuda:1, ..., or auto: cuda if there is a GPU.
        precision: of the networks; float16 on a GPU only; auto: bfloat16 on a GPU, else float32.
        json: also write the figures to this file.
    """
    from amvnet.cli.tables import timing_table
    from amvnet.config.recipes import load_recipe
    from amvnet.data.datasets.simulated import simulate
    from amvnet.files import atomic_write
    from amvnet.inference.timing import UNCERTAIN, time_jobs, untrained
    from amvnet.weights.file import load

    timed_weights = load(weights) if recipe is None else untrained(load_recipe(recipe))
    if recipe is not None and uncertain is None:
        uncertain = UNCERTAIN

    with TemporaryDirectory() as temporary:
        folder = Path(temporary)
        if scan is None:
            simulate(folder, scans=1)
            scan = folder / "sequences/00/velodyne/000000.bin"

        jobs = []
        for engine in parse_names(engines) or []:
            segmenter = make_segmenter(
                timed_weights,
                device,
                engine,  # type: ignore[arg-type]  # checked there
                precision,
                None,
                method="amvnet",
                tau=tau,
            )
            name = segmenter.engine
            if segmenter.precision != "float32":
                name = f"{name}, {segmenter.precision}"
            jobs.append(_job(segmenter, scan, folder, name, uncertain))

        with progress("timing") as step:
            reports = time_jobs(jobs, runs, step)

    for report in reports:
        show(timing_table(report))
    if json is not None:
        with atomic_write(json) as part:
            part.write_text(dumps(reports, indent=1))


def _job(segmenter: Segmenter, scan: Path, folder: Path, name: str, share: float | None) -> Job:
    """Return a job that reads a scan's file and writes its labels into a folder."""
    from amvnet.data.formats.registry import read_cloud
    from amvnet.data.labels.ids import write_ids
    from amvnet.inference.timing import Job

    return Job(
        segmenter,
        read=lambda: read_cloud(scan).to_scan(),
        write=lambda ids: write_ids(folder / "labels.label", ids),
        name=name,
        share=share,
    )
