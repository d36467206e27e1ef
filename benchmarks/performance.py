"""What a scan costs on this machine's CPU, beside SalsaNext, and what each measure for speed gives: by taking it away.

python benchmarks/performance.py [--scan FILE] [--rounds N] [--runs N] [--engines torch,onnx] [--uncertain SHARE]
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import torch
from salsanext import CHANNELS, SalsaNext
from torch import nn
from torch.nn import functional as F

import amvnet.inference.segmenter
import amvnet.models.layers
import amvnet.models.polar_net
import amvnet.models.range_net
from amvnet.config.recipes import load_recipe
from amvnet.data.scan_files import read_scan, write_labels
from amvnet.export.engines import OnnxGraph, cache_folder, use_engine
from amvnet.inference.segmenter import Segmenter
from amvnet.inference.timing import FUSION, MEAN, STAGES, Job, product_limits, run_once, untrained
from amvnet.models.layers import upsample
from amvnet.models.point_head import head_features, point_table
from amvnet.simulation import simulate

WIDTH, HEIGHT = 2048, 64  # of the range image that SalsaNext is timed on
WARM_UP = 2


def without_memory() -> None:
    amvnet.inference.segmenter.keep_freed_memory = lambda: False


def without_folding() -> None:
    amvnet.inference.segmenter.fold_batch_norms = lambda model: None


def without_convolved_rows() -> None:
    amvnet.models.layers.linear = amvnet.models.polar_net.linear = F.linear


def without_pykdtree() -> None:
    sys.modules["pykdtree.kdtree"] = None  # type: ignore[assignment]


def without_occupied_pillars() -> None:
    """Score every voxel of every pillar, and take those of the occupied ones."""

    def forward(self, grid):  # type: ignore[no-untyped-def]
        pillars = self.compress(self.pool(grid))
        return grid.at_pillars(self.scores(self.unet(grid.to_map(pillars))))

    amvnet.models.polar_net.PolarNet.forward = forward


def without_parts() -> None:
    amvnet.models.polar_net.PART = 10**9


def without_joining() -> None:
    """Upsample the coarse maps, and convolve them at full size."""

    def joined(block, coarse, fine):  # type: ignore[no-untyped-def]
        return block(torch.cat([upsample(coarse, fine), fine], dim=1))

    amvnet.models.polar_net.joined = amvnet.models.range_net.joined = joined


def without_sharing() -> None:
    """The head's first layer for every neighbour of every uncertain point."""

    def settle(head, points, f, g, index, near):  # type: ignore[no-untyped-def]
        table = point_table(points, f, g)
        parts = zip(index.split(2048), near.split(2048), strict=True)
        return torch.cat(
            [head(*head_features(head.config, table, i, n)) for i, n in parts]
        ).softmax(dim=1)

    amvnet.inference.timing.settle = settle


TAKEN_AWAY: dict[str, tuple[Callable[[], None], ...]] = {
    "as it is": (),
    "freed memory goes back to the system": (without_memory,),
    "batch norms not folded": (without_folding,),
    "linear layers by matrix products": (without_convolved_rows,),
    "every voxel scored, occupied or not": (without_occupied_pillars,),
    "points of pillars encoded at once": (without_parts,),
    "coarse maps upsampled before convolutions": (without_joining,),
    "neighbours by SciPy": (without_pykdtree,),
    "head's first layer once a neighbour": (without_sharing,),
}
TAKEN_AWAY["all of these"] = tuple(taken for some in TAKEN_AWAY.values() for taken in some)


def measure(
    variant: str, engine: str, scan: Path, runs: int, recipe: str | None, share: float | None
) -> dict[str, float]:
    """Median seconds of each stage and of SalsaNext's forward pass, in turn, in this process."""
    for take_away in TAKEN_AWAY[variant]:
        take_away()
    segmenter = Segmenter(untrained(load_recipe(recipe)) if recipe else "sim-hdl64e")
    use_engine(segmenter, engine)
    salsanext, image = yardstick(engine)
    with TemporaryDirectory() as folder:
        target = Path(folder) / "labels.label"
        job = Job(
            segmenter, lambda: read_scan(scan), lambda ids: write_labels(target, ids), engine, share
        )
        times: list[dict[str, float]] = []
        for _ in range(runs + WARM_UP):
            started = time.perf_counter()
            with torch.inference_mode():
                salsanext(image)
            seconds = time.perf_counter() - started
            run = run_once(job)
            rest = {"points": run.points, "uncertain": run.uncertain / run.points, "all": run.all}
            times.append({**run.seconds, "SalsaNext": seconds, **rest})
    median = {key: float(np.median([some[key] for some in times[WARM_UP:]])) for key in times[0]}
    return {**median, "limit": product_limits("cpu")["float32"]}


def yardstick(engine: str) -> tuple[nn.Module, torch.Tensor]:
    """SalsaNext in an engine, and an image for it."""
    net = SalsaNext().eval().to(memory_format=torch.channels_last)  # type: ignore[call-overload]
    image = torch.randn(1, CHANNELS, HEIGHT, WIDTH).contiguous(memory_format=torch.channels_last)
    if engine == "compile":
        net = torch.compile(net)
    if engine == "onnx":
        path = cache_folder() / "salsanext.onnx"
        path.parent.mkdir(parents=True, exist_ok=True)
        torch.onnx.export(
            net, (image.contiguous(),), path, dynamo=True, external_data=False, verbose=False
        )
        net = OnnxGraph(path, torch.get_num_threads())
    return net, image


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--scan", type=Path)
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--runs", type=int, default=7)
    parser.add_argument("--engines", default="torch")
    parser.add_argument("--recipe")
    parser.add_argument(
        "--uncertain", type=float
    )  # share of the points; by default as the weights find
    parser.add_argument("--short", action="store_true")  # the engines alone
    parser.add_argument("--variant")  # of one process of ours
    options = parser.parse_args()
    if options.variant:
        what = (
            options.variant,
            options.engines,
            options.scan,
            options.runs,
            options.recipe,
            options.uncertain,
        )
        print(json.dumps(measure(*what)))
        return
    with TemporaryDirectory() as folder:
        if options.scan is None:
            simulate(Path(folder), scans=1)
        compare(options, options.scan or Path(folder) / "sequences/00/velodyne/000000.bin")


def compare(options: argparse.Namespace, scan: Path) -> None:
    """Every variant of each engine in processes of their own, round by round; the tables of docs/performance.md."""
    variants = [("as it is", engine) for engine in options.engines.split(",")]
    variants += [(name, "torch") for name in TAKEN_AWAY if name != "as it is" and not options.short]
    found: dict[tuple[str, str], list[dict[str, float]]] = {key: [] for key in variants}
    for number in range(options.rounds):
        for variant, engine in variants:
            command = [sys.executable, __file__, "--scan", str(scan), "--runs", str(options.runs)]
            command += ["--variant", variant, "--engines", engine]
            command += ["--recipe", options.recipe] if options.recipe else []
            command += (
                ["--uncertain", str(options.uncertain)] if options.uncertain is not None else []
            )
            printed = subprocess.run(command, check=True, capture_output=True, text=True).stdout
            found[variant, engine].append(json.loads(printed.splitlines()[-1]))
            print(f"round {number + 1}: {engine}, {variant}", file=sys.stderr)
    whole = found[variants[0]]
    print(
        f"{whole[0]['points']:,.0f} points, {whole[0]['uncertain']:.1%} of them uncertain; ms, medians of rounds\n"
    )
    columns = (*STAGES, "all", "fusion", "SalsaNext", "all / SalsaNext")
    print("| |", " | ".join(columns), "|\n|---|" + "---|" * len(columns))
    for (variant, engine), rounds in found.items():
        print(
            f"| {variant if engine == 'torch' else engine} |",
            " | ".join(cells(rounds, columns)),
            "|",
        )


def cells(rounds: list[dict[str, float]], columns: tuple[str, ...]) -> list[str]:
    shown = {
        key: f"{1e3 * np.median([r[key] for r in rounds]):.1f}"
        for key in (*STAGES, MEAN, "all", "SalsaNext")
    }
    shares = [sum(r[stage] for stage in FUSION) / r["all"] for r in rounds]
    ratios = [r["all"] / r["SalsaNext"] for r in rounds]
    shown |= {"fusion": f"{np.median(shares):.1%}", "all / SalsaNext": f"{np.median(ratios):.2f}"}
    return [shown[column] for column in columns]


if __name__ == "__main__":
    main()
