"""Measure the method on a GPU in one call, and print the tables of docs/gpu.md.

    python benchmarks/gpu.py [--scan FILE]

It takes about five minutes. For networks of the paper's size and of the compact size, the tables
show the scans per second from points to labels, one by one and in batches, with kernels that are
launched one by one and with CUDA graphs. They also show the number of launched kernels, the time
that the GPU is busy, the memory, the time of each stage, the places where the processor waits, and
the rates of `predict` from disk and of training with its loaders.

Without a GPU, check that the benchmark itself works:

    python benchmarks/gpu.py --device cpu --quick
"""

from __future__ import annotations

import argparse
import contextlib
import os
import time
import warnings
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from statistics import median
from tempfile import TemporaryDirectory
from typing import Any

import torch
import yaml
from torch.autograd import DeviceType
from torch.profiler import ProfilerActivity, profile

from amvnet import load
from amvnet import read as read_scan
from amvnet.cli.main import main as amvnet
from amvnet.config.nested import to_dict
from amvnet.config.recipes import load_recipe
from amvnet.config.schema import (
    PARTS,
    ModelConfig,
    PolarNetConfig,
    PolarViewConfig,
    RangeNetConfig,
    RangeViewConfig,
    Recipe,
)
from amvnet.data.taxonomy import TAXONOMIES
from amvnet.inference.segmenter import Segmenter
from amvnet.inference.timing import STAGES, run_once
from amvnet.models.amvnet import build_amvnet
from amvnet.models.assertion import Disagreement, cosine_similarity
from amvnet.scan import Scan
from amvnet.weights.file import Weights, part_state, save
from lidarstreets import simulate

TINY = ModelConfig(
    RangeViewConfig(height=16, width=64),
    PolarViewConfig(radial=12, angular=16, vertical=4),
    RangeNetConfig(stem=8, widths=(8,) * 7, blocks=(1,) * 7, decoder=8, head=8),
    PolarNetConfig(point_widths=(8, 8), pillar=8, widths=(8, 8)),
)
SIZES = {"paper": "semantickitti", "compact": "semantickitti-compact"}
UNCERTAIN = 0.1  # share of uncertain points, as in the paper
WARM_UP = 3  # number of runs that do not count; the first one captures the graphs
# The training that is measured:
STEP = 8  # number of scans in a step
WORKERS = 6  # number of processes that load scans
EPOCHS = (1, 3)  # a run of one epoch and a run of three; their times are subtracted


class Options(argparse.Namespace):
    device: str
    scan: Path | None
    precision: str
    batch: str
    runs: int
    quick: bool


def main() -> None:
    """Measure, and print the tables."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--device", default="cuda")
    parser.add_argument("--scan", type=Path, help="a scan of an HDL-64E; default: a simulated one")
    parser.add_argument("--precision", default="bfloat16,float32")
    parser.add_argument("--batch", default="1,4,8", help="scans at a time")
    parser.add_argument("--runs", type=int, default=20, help="the median is shown")
    parser.add_argument("--quick", action="store_true", help="tiny networks and data, one run")
    options = parser.parse_args(namespace=Options())
    if options.quick:
        options.runs = 1
        options.batch = "1"
        options.precision = "float32"

    with TemporaryDirectory() as temporary:
        folder = Path(temporary)
        simulate(folder / "city", sequences=4, scans=1 if options.quick else 12)
        scan = read_scan(options.scan or folder / "city/sequences/00/velodyne/000000.bin")
        print_machine(options, scan)

        models = {name: load_recipe(recipe).model for name, recipe in SIZES.items()}
        if options.quick:
            models = {"tiny": TINY}
        for size, model in models.items():
            recipe = replace(load_recipe("semantickitti"), model=model)
            torch.manual_seed(0)
            measure_size(size, untrained(recipe), scan, options)
            measure_predict(size, untrained(recipe), folder, options)
        measure_training(folder, options)


def untrained(recipe: Recipe) -> Weights:
    """Return random weights of networks and a head with the sizes of a recipe."""
    taxonomy = TAXONOMIES[recipe.taxonomy]
    model = build_amvnet(recipe.model, taxonomy.size)
    tensors: dict[str, torch.Tensor] = {}
    for part in PARTS:
        tensors |= part_state(part, getattr(model, part).state_dict())
    return Weights(recipe.model, taxonomy, recipe.sensor, tensors=tensors)


def print_machine(options: Options, scan: Scan) -> None:
    is_gpu = options.device != "cpu"
    name = torch.cuda.get_device_name(options.device) if is_gpu else "CPU"
    n = 8192 if is_gpu else 512
    a, b = torch.randn(2, n, n, device=options.device).bfloat16()
    limit = 2 * n**3 / median_seconds(lambda: a @ b, options) / 1e12
    print(
        f"{name}, {os.cpu_count()} cores, torch {torch.__version__}; matrix products of bfloat16:"
    )
    print(f"{limit:.2f} TFLOP/s. {scan.valid.sum():,} points, {UNCERTAIN:.0%} uncertain.")


# ---- points to labels


def measure_size(size: str, weights: Weights, scan: Scan, options: Options) -> None:
    """Print the tables of one size of the networks."""
    rows = []
    stages: dict[str, dict[str, float]] = {}
    waits: Counter[str] = Counter()
    for precision in options.precision.split(","):
        for graphs in (False, True):
            segmenter = make_segmenter(weights, scan, precision, graphs, options)
            variant = f"{precision}, {'graphs' if graphs else 'one by one'}"
            for batch in map(int, options.batch.split(",")):
                rows.append([variant, batch, *time_batch(segmenter, [scan] * batch, options)])
            stages[variant] = time_stages(segmenter, scan, options)
            waits = count_waits(segmenter, scan)  # the table has the waits of the last variant

    header = ["networks", "at a time", "scans/s", "ms a scan", "launches", "kernels", "busy, ms"]
    header.append("memory, GiB")
    print_table(f"{size}: points to labels", header, rows)
    header = ["stage, ms, synchronised", *stages]
    table = [[stage, *(f"{times[stage]:.1f}" for times in stages.values())] for stage in STAGES]
    print_table(f"{size}: stages", header, table)
    places = ", ".join(f"{place} ({count})" for place, count in waits.items())
    print(f"\nWaits of the processor, one scan: {places or 'none'}")


def make_segmenter(
    weights: Weights, scan: Scan, precision: str, graphs: bool, options: Options
) -> Segmenter:
    """Return a segmenter for which the share `UNCERTAIN` of the scan's points is uncertain.

    Random networks disagree on more or fewer points than trained networks do. The threshold of the
    assertion is therefore set by the similarities in this scan.
    """
    segmenter = load(
        weights,
        options.device,
        precision=precision,  # type: ignore[arg-type]
        graphs=graphs,
    )
    result = segmenter(scan)
    assert result.rv is not None
    assert result.bev is not None
    f = torch.from_numpy(result.rv[scan.valid])
    g = torch.from_numpy(result.bev[scan.valid])
    similarity = cosine_similarity(f, g).sort().values
    tau = float(similarity[int(UNCERTAIN * (len(similarity) - 1))])
    segmenter.model.assertion = Disagreement(tau)
    return segmenter


def time_batch(segmenter: Segmenter, scans: Sequence[Scan], options: Options) -> list[str]:
    """Return one row of the table: the columns after the networks and the batch.

    The columns are the scans per second; the milliseconds, launches and kernels of each scan; the
    milliseconds that the GPU is busy with a scan; and the largest memory. A graph is one launch of
    many kernels. On a CPU, operators count as kernels.
    """
    is_gpu = options.device != "cpu"
    memory = ""
    busy = ""
    if is_gpu:
        torch.cuda.reset_peak_memory_stats(options.device)
    seconds = median_seconds(lambda: segmenter.many(scans), options) / len(scans)

    activity = ProfilerActivity.CUDA if is_gpu else ProfilerActivity.CPU
    with profile(activities=[activity]) as profiler:
        segmenter.many(scans)
    events = profiler.events() or []
    launches = sum("Launch" in event.name for event in events)
    kind = DeviceType.CUDA if is_gpu else DeviceType.CPU
    kernels = [event for event in events if event.device_type == kind]

    if is_gpu:
        busy_ms = sum(event.self_device_time_total for event in kernels) / 1e3
        busy = f"{busy_ms / len(scans):.1f}"
        memory = f"{torch.cuda.max_memory_allocated(options.device) / 2**30:.1f}"
    counts = [str(count // len(scans)) for count in (launches, len(kernels))]
    return [f"{1 / seconds:.1f}", f"{seconds * 1e3:.1f}", *counts, busy, memory]


def time_stages(segmenter: Segmenter, scan: Scan, options: Options) -> dict[str, float]:
    """Return the median time of each stage, milliseconds, in the order of the stages."""
    timings = []
    for _ in range(WARM_UP + options.runs):
        timings.append(run_once(segmenter, read=lambda: scan, write=lambda labels: None))
    return {
        stage: median(timing.seconds[stage] for timing in timings[WARM_UP:]) * 1e3
        for stage in STAGES
    }


def count_waits(segmenter: Segmenter, scan: Scan) -> Counter[str]:
    """Return the lines of code at which the processor waits for the GPU, and how often it waits."""
    if segmenter.device == "cpu":
        return Counter()
    torch.cuda.set_sync_debug_mode("warn")
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        segmenter(scan)
    torch.cuda.set_sync_debug_mode("default")
    messages = [warning for warning in caught if "synchronizing" in str(warning.message)]
    return Counter(f"{Path(each.filename).name}:{each.lineno}" for each in messages)


# ---- commands


def measure_predict(size: str, weights: Weights, folder: Path, options: Options) -> None:
    """Print the scans per second of `predict` from disk, without the time of its start.

    The start takes the same time for few scans as for all scans, and is subtracted.
    """
    path = save(weights, folder / f"{size}.safetensors")
    city = folder / "city"
    scans = len(list(city.glob("sequences/*/velodyne/*")))
    few = len(list(city.glob("sequences/00/velodyne/*")))

    rows = []
    for batch in map(int, options.batch.split(",")):
        common = ["--weights", path, "--device", options.device, "--batch", batch]
        out = folder / f"{size}-{batch}"
        few_seconds = run_amvnet(
            "predict", city, *common, "--sequences", "00", "--out", f"{out}-few"
        )
        all_seconds = run_amvnet("predict", city, *common, "--out", out)
        rows.append([batch, rate_of(scans - few, all_seconds - few_seconds)])
    print_table(f"{size}: predict from disk", ["at a time", "scans/s"], rows)


def measure_training(folder: Path, options: Options) -> None:
    """Print the scans per second of training with loaders, after the first epoch.

    Two trainings differ only in the number of epochs, and their times are subtracted.
    """
    batch, workers, epochs = (2, 0, (1, 2)) if options.quick else (STEP, WORKERS, EPOCHS)
    networks = ("rv",) if options.quick else ("rv", "bev")
    recipe: Path | str = "simulated-compact"
    if options.quick:
        recipe = folder / "tiny.yaml"
        recipe.write_text(yaml.safe_dump({"base": "simulated-compact", "model": to_dict(TINY)}))
    accelerator = "cpu" if options.device == "cpu" else "gpu"

    rows = []
    for stage in networks:
        seconds = []
        for count in epochs:
            seconds.append(
                run_amvnet(
                    *("train", recipe, "--data", folder / "city"),
                    *("--out", folder / f"run-{stage}-{count}", "--stage", stage),
                    *("--train-sequences", "00,01,02", "--val-sequences", "03"),
                    *(f"--training.{stage}.epochs", count, f"--training.{stage}.batch", batch),
                    *(f"--training.{stage}.accumulate", 1, "--training.workers", workers),
                    *("--training.accelerator", accelerator),
                )
            )

        scans = len(list((folder / "city").glob("sequences/0[012]/velodyne/*")))
        rows.append([stage, rate_of((epochs[1] - epochs[0]) * scans, seconds[1] - seconds[0])])

    title = (
        f"training and validation of {Path(recipe).stem}, {batch} scans a step, {workers} workers"
    )
    print_table(title, ["network", "scans/s"], rows)


def run_amvnet(*words: object) -> float:
    """Run a command of amvnet in this process, and hide its output; return the seconds it took."""
    started = time.perf_counter()
    with Path(os.devnull).open("w") as nowhere, contextlib.redirect_stdout(nowhere):
        code = amvnet([str(word) for word in words])
    if code:
        raise SystemExit(code)
    return time.perf_counter() - started


def rate_of(count: int, seconds: float) -> str:
    return f"{count / seconds:.1f}" if seconds > 0 else "too short to tell"


# ---- tables


def median_seconds(work: Callable[[], object], options: Options) -> float:
    """Return the median time of `options.runs` runs, after runs that only warm up."""
    times = []
    for _ in range(WARM_UP + options.runs):
        started = time.perf_counter()
        work()
        if options.device != "cpu":
            torch.cuda.synchronize(options.device)
        times.append(time.perf_counter() - started)
    return median(times[WARM_UP:])


def print_table(title: str, header: Sequence[str], rows: Sequence[Sequence[Any]]) -> None:
    print(f"\n{title}\n")
    print(f"| {' | '.join(header)} |")
    print("|---" * len(header) + "|")
    for row in rows:
        print(f"| {' | '.join(map(str, row))} |")


if __name__ == "__main__":
    main()
