"""Measure the whole method on a GPU at the paper's size: scans/s, TFLOP/s, memory and waits.

python benchmarks/gpu.py [--scan FILE] [--precision bfloat16,float32] [--batch 1,4] [--part 8]
                         [--compile]

Without a GPU, check that the benchmark itself works:

python benchmarks/gpu.py --device cpu --size tiny --runs 1
"""

from __future__ import annotations

import argparse
import time
import warnings
from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from statistics import median
from tempfile import TemporaryDirectory

import torch
from torch.utils.flop_counter import FlopCounterMode

from amvnet import read as read_scan
from amvnet.config.recipes import load_recipe
from amvnet.config.schema import (
    ModelConfig,
    PolarNetConfig,
    PolarViewConfig,
    RangeNetConfig,
    RangeViewConfig,
    Recipe,
)
from amvnet.data.taxonomy import SEMANTICKITTI
from amvnet.inference.segmenter import Segmenter
from amvnet.models.amvnet import build_amvnet
from amvnet.models.assertion import Disagreement, cosine_similarity
from amvnet.models.neighbours import nearest_others
from amvnet.models.neighbours_gpu import nearest_others_by_blocks
from amvnet.models.views.points import PointBatch
from amvnet.scan import Scan
from amvnet.training.stages import NetworkStage, PolarStage, RangeStage
from amvnet.weights.file import Weights, part_state
from lidarstreets import simulate

CLASSES = SEMANTICKITTI.size
TINY = ModelConfig(
    RangeViewConfig(height=16, width=64),
    PolarViewConfig(radial=12, angular=16, vertical=4),
    RangeNetConfig(stem=8, widths=(8,) * 7, blocks=(1,) * 7, decoder=8, head=8),
    PolarNetConfig(point_widths=(8, 8), pillar=8, widths=(8, 8)),
)
RECIPES = {
    "paper": "semantickitti",
    "compact": "semantickitti-compact",
    "tiny": "semantickitti-compact",
}
WARM_UP = 2


def recipe_of(size: str) -> Recipe:
    recipe = load_recipe(RECIPES[size])
    return replace(recipe, model=TINY) if size == "tiny" else recipe


def median_seconds(work: Callable[[], object], runs: int, device: str) -> float:
    """Return the median time of some runs, after others that only warm up."""
    times = []
    for _ in range(WARM_UP + runs):
        started = time.perf_counter()
        work()
        if device != "cpu":
            torch.cuda.synchronize(device)
        times.append(time.perf_counter() - started)

    return median(times[WARM_UP:])


def matrix_limit(device: str, runs: int) -> float:
    """Return the FLOP/s of a large product in bfloat16, the most that the device reaches."""
    n = 512 if device == "cpu" else 8192
    a, b = torch.randn(2, n, n, device=device).bfloat16()
    return 2 * n**3 / median_seconds(lambda: a @ b, max(runs, 10), device)


def count_flops(work: Callable[[], object]) -> int:
    with FlopCounterMode(display=False) as counter:
        work()
    return counter.get_total_flops()


def untrained_weights(config: ModelConfig) -> Weights:
    """Return untrained weights.

    Times do not depend on the weights, except on how many points are uncertain.
    """
    torch.manual_seed(0)
    model = build_amvnet(config, CLASSES)

    tensors: dict[str, torch.Tensor] = {}
    for name in ("range_net", "polar_net", "point_head"):
        tensors |= part_state(name, getattr(model, name))
    return Weights(config, SEMANTICKITTI, "hdl64e", tensors)


def make_segmenter(weights: Weights, scan: Scan, precision: str, options: Options) -> Segmenter:
    """Return a segmenter for which the given share of the scan's points is uncertain.

    Untrained networks would disagree on another share than trained ones.
    """
    segmenter = Segmenter(weights, options.device, precision=precision)  # type: ignore[arg-type]

    segmentation = segmenter(scan)
    assert segmentation.rv is not None
    assert segmentation.bev is not None
    f = torch.from_numpy(segmentation.rv[scan.valid])
    g = torch.from_numpy(segmentation.bev[scan.valid])

    similarity = cosine_similarity(f, g).sort().values
    tau = similarity[int(options.uncertain * (len(similarity) - 1))]
    segmenter.model.assertion = Disagreement(float(tau))
    return segmenter


def peak_memory(device: str) -> str:
    """Return the most memory that was in use since the last call."""
    if device == "cpu":
        return "not measured"

    peak = torch.cuda.max_memory_allocated(device)
    torch.cuda.reset_peak_memory_stats(device)
    return f"{peak / 2**30:.1f} GiB"


def time_segmentation(segmenter: Segmenter, scan: Scan, batch: int, runs: int) -> None:
    seconds = median_seconds(lambda: segmenter.many([scan] * batch), runs, segmenter.device)
    print(
        f"points to labels, {segmenter.precision}, {batch} at a time: "
        f"{batch / seconds:.1f} scans/s ({seconds / batch * 1e3:.1f} ms a scan), "
        f"memory {peak_memory(segmenter.device)}"
    )


@torch.inference_mode()
def time_networks(segmenter: Segmenter, scan: Scan, batch: int, runs: int, limit: float) -> None:
    model = segmenter.model
    points = PointBatch.of([scan] * batch).to(segmenter.device)
    image = model.range_view.project(points).image
    grid = model.polar_view.project(points)

    for name, net, view in (("RV", model.range_net, image), ("BEV", model.polar_net, grid)):
        forward = partial(net, view)
        flops = count_flops(forward)
        rate = flops / median_seconds(forward, runs, segmenter.device)
        share = f"{rate / 1e12:.2f} TFLOP/s, {rate / limit:.0%} of the limit"
        print(f"  {name}: {flops / batch / 1e9:.2f} GFLOP a scan, {share}")


@torch.inference_mode()
def time_neighbour_search(segmenter: Segmenter, scan: Scan, runs: int) -> None:
    model = segmenter.model
    device = segmenter.device
    assert model.point_head is not None
    n = model.point_head.config.neighbours

    xyz = scan.points[scan.valid][:, :3].copy()
    uncertain = segmenter(scan).uncertain[scan.valid].nonzero()[0]
    device_xyz = torch.from_numpy(xyz).to(device)
    device_uncertain = torch.from_numpy(uncertain).to(device)

    blocks = median_seconds(
        lambda: nearest_others_by_blocks(device_xyz, device_uncertain, n), runs, device
    )
    tree = median_seconds(lambda: nearest_others(xyz, uncertain, n), runs, "cpu")
    print(
        f"neighbours of {len(uncertain)} points: {blocks * 1e3:.1f} ms by blocks, "
        f"{tree * 1e3:.1f} ms by the tree on the CPU"
    )


def print_waits(segmenter: Segmenter, scan: Scan) -> None:
    """Print where the CPU waits for the GPU in one pass."""
    torch.cuda.set_sync_debug_mode("warn")
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        segmenter(scan)
    torch.cuda.set_sync_debug_mode("default")

    counts: Counter[str] = Counter()
    for warning in caught:
        if "synchronizing" in str(warning.message):
            counts[f"{Path(warning.filename).name}:{warning.lineno}"] += 1
    places = ", ".join(f"{place} ({count})" for place, count in counts.items())
    print("waits for the GPU in a scan:", places or "none")


def time_training(stage: NetworkStage, scan: Scan, limit: float, options: Options) -> None:
    """Time a step of AdamW over a batch in parts, as `amvnet train` takes it with bf16-mixed."""
    device = options.device
    batch = stage.config.batch
    part = min(options.part, batch)

    stage.to(device).train()
    optimizer = torch.optim.AdamW(stage.trained.parameters(), lr=1e-4)
    points = PointBatch.of([scan] * part).to(device)
    labels = torch.randint(1, CLASSES + 1, (len(points.points),), device=device)

    def backward() -> None:
        with torch.autocast(torch.device(device).type, torch.bfloat16):
            logits, truth, _ = stage.logits(points, labels)
            losses = [stage.loss(*pair) for pair in zip(logits, truth, strict=True)]
            loss = torch.stack(losses).mean()
        loss.backward()

    def step() -> None:
        for _ in range(batch // part):
            backward()
        optimizer.step()
        optimizer.zero_grad()

    flops = count_flops(backward) * (batch // part)
    if options.compile:  # after counting: compiled networks cannot be counted
        stage.trained.compile()

    peak_memory(device)  # forget the peak so far
    seconds = median_seconds(step, options.runs, device)
    rate = flops / seconds
    print(
        f"training {stage.name}, bfloat16, {batch} scans in parts of {part}: "
        f"{seconds:.3g} s a step, {batch / seconds:.3g} scans/s, {rate / 1e12:.2f} TFLOP/s, "
        f"{rate / limit:.0%} of the limit, memory {peak_memory(device)}"
    )


class Options(argparse.Namespace):
    device: str
    size: str
    scan: Path | None
    precision: str
    batch: str
    part: int
    uncertain: float
    runs: int
    compile: bool


def parse_options() -> Options:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--device", default="cuda")
    parser.add_argument("--size", choices=list(RECIPES), default="paper")
    parser.add_argument("--scan", type=Path, help="a scan of an HDL-64E; default: a simulated one")
    parser.add_argument("--precision", default="bfloat16,float32")
    parser.add_argument("--batch", default="1,2,4,8", help="scans at a time")
    parser.add_argument("--part", type=int, default=8, help="scans of a training batch at a time")
    parser.add_argument(
        "--uncertain", type=float, default=0.1, help="share of the points; the paper's"
    )
    parser.add_argument("--runs", type=int, default=10, help="the median is shown")
    parser.add_argument("--compile", action="store_true", help="compile the networks for training")
    return parser.parse_args(namespace=Options())


def load_scan(path: Path | None) -> Scan:
    """Read a scan, or simulate one if no path is given."""
    if path is not None:
        return read_scan(path)

    with TemporaryDirectory() as folder:
        simulate(Path(folder), scans=1)
        return read_scan(Path(folder) / "sequences/00/velodyne/000000.bin")


def main() -> None:
    options = parse_options()
    device = options.device
    runs = options.runs
    recipe = recipe_of(options.size)
    scan = load_scan(options.scan)

    limit = matrix_limit(device, runs)
    name = "CPU" if device == "cpu" else torch.cuda.get_device_name(device)
    print(
        f"{name}, torch {torch.__version__}: "
        f"{limit / 1e12:.2f} TFLOP/s in a bfloat16 matrix product"
    )
    print(f"{options.size} size, {scan.valid.sum()} points, {options.uncertain:.0%} uncertain")

    weights = untrained_weights(recipe.model)
    for precision in options.precision.split(","):
        segmenter = make_segmenter(weights, scan, precision, options)
        for batch in map(int, options.batch.split(",")):
            time_segmentation(segmenter, scan, batch, runs)
            time_networks(segmenter, scan, batch, runs, limit)

    time_neighbour_search(segmenter, scan, runs)
    if device != "cpu":
        print_waits(segmenter, scan)

    model = build_amvnet(recipe.model, CLASSES)
    stages: list[NetworkStage] = [
        RangeStage(model.range_view, model.range_net, recipe.training.rv, SEMANTICKITTI, None),
        PolarStage(model.polar_view, model.polar_net, recipe.training.bev, SEMANTICKITTI, None),
    ]
    for stage in stages:
        time_training(stage, scan, limit, options)


if __name__ == "__main__":
    main()
