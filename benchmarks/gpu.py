"""Scans a second, TFLOP/s, memory and waits of the whole method on a GPU, at the paper's size.

python benchmarks/gpu.py [--scan FILE] [--precision bfloat16,float32] [--batch 1,4] [--part 8] [--compile]
python benchmarks/gpu.py --device cpu --size tiny --runs 1    whether it works, where there is no GPU
"""

from __future__ import annotations

import argparse
import time
import warnings
from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from statistics import median
from tempfile import TemporaryDirectory

import torch
from torch.utils.flop_counter import FlopCounterMode

from amvnet.config.recipes import load_recipe
from amvnet.config.schema import (
    ModelConfig,
    PolarNetConfig,
    PolarViewConfig,
    RangeNetConfig,
    RangeViewConfig,
    Recipe,
)
from amvnet.data.scan_files import read_scan
from amvnet.data.taxonomy import SEMANTICKITTI
from amvnet.inference.segmenter import Segmenter
from amvnet.models.amvnet import build_amvnet
from amvnet.models.assertions import Disagreement, cosine_similarity
from amvnet.models.neighbours import nearest_others
from amvnet.models.neighbours_gpu import nearest_others_by_blocks
from amvnet.models.views.points import PointBatch
from amvnet.scan import Scan
from amvnet.simulation import simulate
from amvnet.training.stages import NetworkStage, PolarStage, RangeStage
from amvnet.weights.file import Weights, part_state

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


def seconds(work: Callable[[], object], runs: int, device: str) -> float:
    """The median of some runs, after others that only warm up."""
    times = []
    for _ in range(WARM_UP + runs):
        started = time.perf_counter()
        work()
        if device != "cpu":
            torch.cuda.synchronize(device)
        times.append(time.perf_counter() - started)
    return median(times[WARM_UP:])


def matrix_limit(device: str, runs: int) -> float:
    """FLOP/s of a large product in bfloat16: what this device gives at best."""
    n = 512 if device == "cpu" else 8192
    a, b = torch.randn(2, n, n, device=device).bfloat16()
    return 2 * n**3 / seconds(lambda: a @ b, max(runs, 10), device)


def flops_of(work: Callable[[], object]) -> int:
    with FlopCounterMode(display=False) as counter:
        work()
    return counter.get_total_flops()


def fresh(model: ModelConfig) -> Weights:
    """Weights that have learnt nothing: times do not depend on them, but for how many points are uncertain."""
    torch.manual_seed(0)
    built = build_amvnet(model, CLASSES)
    parts = {name: getattr(built, name) for name in ("range_net", "polar_net", "point_head")}
    tensors = {
        key: value for name, part in parts.items() for key, value in part_state(name, part).items()
    }
    return Weights(model, SEMANTICKITTI, "hdl64e", tensors)


def segmenter_of(
    weights: Weights, scan: Scan, device: str, precision: str, uncertain: float
) -> Segmenter:
    """One for which such a share of the scan's points is uncertain, as with trained weights."""
    segmenter = Segmenter(weights, device, precision=precision)  # type: ignore[arg-type]
    found = segmenter(scan)
    likeness = cosine_similarity(
        *map(torch.from_numpy, (found.rv[scan.valid], found.bev[scan.valid]))
    )
    segmenter.model.assertion = Disagreement(
        float(likeness.sort().values[int(uncertain * (len(likeness) - 1))])
    )
    return segmenter


def memory(device: str) -> str:
    """The most that was taken since the last call."""
    if device == "cpu":
        return "not measured"
    most = torch.cuda.max_memory_allocated(device)
    torch.cuda.reset_peak_memory_stats(device)
    return f"{most / 2**30:.1f} GiB"


def whole(segmenter: Segmenter, scan: Scan, batch: int, runs: int) -> None:
    taken = seconds(lambda: segmenter.many([scan] * batch), runs, segmenter.device)
    print(
        f"points to labels, {segmenter.precision}, {batch} at a time: {batch / taken:.1f} scans/s "
        f"({taken / batch * 1e3:.1f} ms a scan), memory {memory(segmenter.device)}"
    )


@torch.inference_mode()
def networks(segmenter: Segmenter, scan: Scan, batch: int, runs: int, limit: float) -> None:
    model, device = segmenter.model, segmenter.device
    points = PointBatch.of([scan] * batch).to(device)
    image, grid = model.range_view.project(points).image, model.polar_view.project(points)
    for name, net, view in (("RV", model.range_net, image), ("BEV", model.polar_net, grid)):
        work = flops_of(lambda net=net, view=view: net(view))
        rate = work / seconds(lambda net=net, view=view: net(view), runs, device)
        share = f"{rate / 1e12:.2f} TFLOP/s, {rate / limit:.0%} of the limit"
        print(f"  {name}: {work / batch / 1e9:.2f} GFLOP a scan, {share}")


@torch.inference_mode()
def neighbours(segmenter: Segmenter, scan: Scan, runs: int) -> None:
    model, device = segmenter.model, segmenter.device
    assert model.point_head is not None
    xyz, n = scan.points[scan.valid][:, :3].copy(), model.point_head.config.neighbours
    own = segmenter(scan).uncertain[scan.valid].nonzero()[0]
    there, asked = torch.from_numpy(xyz).to(device), torch.from_numpy(own).to(device)
    blocks = seconds(lambda: nearest_others_by_blocks(there, asked, n), runs, device)
    tree = seconds(lambda: nearest_others(xyz, own, n), runs, "cpu")
    print(
        f"neighbours of {len(own)} points: {blocks * 1e3:.1f} ms by blocks, {tree * 1e3:.1f} ms by the tree on the CPU"
    )


def waits(segmenter: Segmenter, scan: Scan) -> None:
    """Where the processor waits for the GPU in one pass."""
    torch.cuda.set_sync_debug_mode("warn")
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        segmenter(scan)
    torch.cuda.set_sync_debug_mode("default")
    places = Counter(
        f"{Path(w.filename).name}:{w.lineno}" for w in caught if "synchronizing" in str(w.message)
    )
    print(
        "waits for the GPU in a scan:",
        ", ".join(f"{place} ({n})" for place, n in places.items()) or "none",
    )


def training(
    stage: NetworkStage,
    scan: Scan,
    batch: int,
    part: int,
    runs: int,
    limit: float,
    options: Options,
) -> None:
    """A step of AdamW over a batch in parts, as `amvnet train` takes it with bf16-mixed."""
    device = options.device
    stage.to(device).train()
    optimizer = torch.optim.AdamW(stage.trained.parameters(), lr=1e-4)
    points = PointBatch.of([scan] * part).to(device)
    labels = torch.randint(1, CLASSES + 1, (len(points.points),), device=device)

    def once() -> None:
        with torch.autocast(torch.device(device).type, torch.bfloat16):
            scores, truth, _ = stage.logits(points, labels)
            loss = torch.stack([stage.loss(*one) for one in zip(scores, truth, strict=True)]).mean()
        loss.backward()

    def step() -> None:
        for _ in range(batch // part):
            once()
        optimizer.step()
        optimizer.zero_grad()

    work = flops_of(once) * (batch // part)
    if options.compile:  # what is compiled cannot be counted
        stage.trained.compile()
    memory(device)
    taken = seconds(step, runs, device)
    print(
        f"training {stage.name}, bfloat16, {batch} scans in parts of {part}: {taken:.3g} s a step, {batch / taken:.3g} "
        f"scans/s, {work / taken / 1e12:.2f} TFLOP/s, {work / taken / limit:.0%} of the limit, memory {memory(device)}"
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


def options() -> Options:
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


def main() -> None:
    given = options()
    device, runs, recipe = given.device, given.runs, recipe_of(given.size)
    with TemporaryDirectory() as folder:
        if given.scan is None:
            simulate(Path(folder), scans=1)
        scan = read_scan(given.scan or Path(folder) / "sequences/00/velodyne/000000.bin")
    limit = matrix_limit(device, runs)
    name = "CPU" if device == "cpu" else torch.cuda.get_device_name(device)
    print(
        f"{name}, torch {torch.__version__}: {limit / 1e12:.2f} TFLOP/s in a bfloat16 matrix product"
    )
    print(f"{given.size} size, {scan.valid.sum()} points, {given.uncertain:.0%} uncertain")
    weights = fresh(recipe.model)
    for precision in given.precision.split(","):
        segmenter = segmenter_of(weights, scan, device, precision, given.uncertain)
        for batch in map(int, given.batch.split(",")):
            whole(segmenter, scan, batch, runs)
            networks(segmenter, scan, batch, runs, limit)
    neighbours(segmenter, scan, runs)
    if device != "cpu":
        waits(segmenter, scan)
    model = build_amvnet(recipe.model, CLASSES)
    stages: list[NetworkStage] = [
        RangeStage(model.range_view, model.range_net, recipe.training.rv, SEMANTICKITTI, None),
        PolarStage(model.polar_view, model.polar_net, recipe.training.bev, SEMANTICKITTI, None),
    ]
    for stage in stages:
        batch = stage.config.batch
        training(stage, scan, batch, min(given.part, batch), runs, limit, given)


if __name__ == "__main__":
    main()
