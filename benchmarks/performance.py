"""Measure the time of a scan on this machine's CPU, next to the time of SalsaNext.

Also measure the gain by each optimisation, which is taken away for that.

    python benchmarks/performance.py [--scan FILE] [--rounds N] [--runs N] [--engines torch,onnx]
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import time
from collections import defaultdict
from collections.abc import Callable, Sequence
from itertools import product
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import torch
from salsanext import CHANNELS, SalsaNext
from torch import Tensor, nn
from torch.nn import functional as F

import amvnet
import amvnet.engines.base
import amvnet.models.amvnet
import amvnet.models.layers
import amvnet.models.polar_net
from amvnet import read as read_scan
from amvnet.data.labels.ids import write_ids
from amvnet.engines.compute import ONNX_ENGINES
from amvnet.engines.onnx import OnnxGraph
from amvnet.inference.timing import FUSION, MEAN, STAGES, run_once
from amvnet.models.amvnet import LateFusion, Scores
from amvnet.models.layers import upsample
from amvnet.models.point_head import PointHead, head_features, point_table
from amvnet.models.polar_net import PolarNet
from amvnet.models.views.points import PointBatch
from amvnet.models.views.polar_view import PolarGrid
from lidarstreets import simulate

HEIGHT = 64  # height of the range image for SalsaNext
WIDTH = 2048  # width of this image
WARM_UP = 2  # number of runs that do not count


def without_folding() -> None:
    amvnet.engines.base.freeze = lambda module: None  # type: ignore[attr-defined]


def without_convolved_rows() -> None:
    # Nobody names the first parameter, `x`, which torch calls `input`.
    amvnet.models.layers.linear = F.linear  # type: ignore[assignment]
    amvnet.models.polar_net.linear = F.linear  # type: ignore[attr-defined, assignment]


def without_pykdtree() -> None:
    sys.modules["pykdtree.kdtree"] = None  # type: ignore[assignment]


def without_occupied_pillars() -> None:
    """Score every voxel of every pillar, and select the scores of occupied pillars."""

    def forward(self: PolarNet, grid: PolarGrid) -> Tensor:
        pillars = self.compress(self.pool(grid))
        return grid.at_pillars(self.scores(self.unet(grid.to_map(pillars))))

    PolarNet.forward = forward  # type: ignore[method-assign]


def without_parts() -> None:
    amvnet.models.polar_net.PART_ON_CPU = 10**9


def without_joining() -> None:
    """Upsample the coarse maps and convolve them at full size."""

    def apply_to_joined(block: nn.Module, coarse: Tensor, fine: Tensor) -> Tensor:
        return block(torch.cat([upsample(coarse, fine), fine], dim=1))

    amvnet.models.polar_net.apply_to_joined = apply_to_joined  # type: ignore[attr-defined]
    amvnet.models.layers.apply_to_joined = apply_to_joined


def without_sharing() -> None:
    """Compute the head's first layer for every neighbour of every uncertain point."""

    def classify(
        self: PointHead, points: Tensor, f: Tensor, g: Tensor, index: Tensor, near: Tensor
    ) -> Tensor:
        table = point_table(points, f, g)
        logits = []
        for uncertain, neighbours in zip(index.split(2048), near.split(2048), strict=True):
            point, rows = head_features(self.config, table, uncertain, neighbours)
            logits.append(self(point, rows))
        return torch.cat(logits).softmax(dim=1)

    PointHead.classify = classify  # type: ignore[method-assign]


def without_lead() -> None:
    """Let the head classify all uncertain points."""
    fuse = LateFusion.fuse

    def fuse_all(self: LateFusion, batch: PointBatch, f: Tensor, g: Tensor) -> Scores:
        self.lead = 0.0
        return fuse(self, batch, f, g)

    LateFusion.fuse = fuse_all  # type: ignore[method-assign]


def without_cubes() -> None:
    """Let the head classify all disputed points in a cube of space, not only the first one."""
    amvnet.models.amvnet.first_in_cubes = (  # type: ignore[attr-defined]
        lambda points, index, edge: (index, torch.arange(len(index)))
    )


UNCHANGED = "unchanged"
ALL = "all of these"
REMOVALS: dict[str, Callable[[], None]] = {
    "batch norms not folded": without_folding,
    "linear layers by matrix products": without_convolved_rows,
    "every voxel scored, occupied or not": without_occupied_pillars,
    "points of pillars encoded at once": without_parts,
    "coarse maps upsampled before convolutions": without_joining,
    "neighbours by SciPy": without_pykdtree,
    "head's first layer once a neighbour": without_sharing,
    "head for all uncertain points": without_lead,
    "head for all points of a cube": without_cubes,
}


def remove_optimisations(variant: str) -> None:
    for name, remove in REMOVALS.items():
        if variant in (name, ALL):
            remove()


def measure(options: argparse.Namespace) -> dict[str, float]:
    """Measure one variant in one engine, in this process.

    Returns:
        The median seconds of each stage and of SalsaNext's forward pass, timed in turn.
    """
    remove_optimisations(options.variant)
    segmenter = amvnet.load("sim-hdl64e", engine=options.engines)
    salsanext, image = build_salsanext(options.engines)

    times: list[dict[str, float]] = []
    with TemporaryDirectory() as folder:
        target = Path(folder) / "labels.label"
        for _ in range(WARM_UP + options.runs):
            started = time.perf_counter()
            with torch.inference_mode():
                salsanext(image)
            seconds = time.perf_counter() - started

            run = run_once(
                segmenter,
                read=lambda: read_scan(options.scan),
                write=lambda ids: write_ids(target, ids),
            )
            figures = {**run.seconds, "SalsaNext": seconds, "all": run.total}
            figures["points"] = run.points
            figures["uncertain"] = run.uncertain / run.points
            times.append(figures)

    return {key: median_of(times[WARM_UP:], key) for key in times[0]}


def median_of(rows: Sequence[dict[str, float]], key: str) -> float:
    return float(np.median([row[key] for row in rows]))


def build_salsanext(engine: str) -> tuple[nn.Module, torch.Tensor]:
    """Return SalsaNext in an engine, and an image for it."""
    net = SalsaNext().eval().to(memory_format=torch.channels_last)  # type: ignore[call-overload]
    image = torch.randn(1, CHANNELS, HEIGHT, WIDTH).contiguous(memory_format=torch.channels_last)
    if engine in ONNX_ENGINES:  # in float32 also next to int8
        with TemporaryDirectory() as folder:
            path = Path(folder) / "salsanext.onnx"
            torch.onnx.export(
                net, (image.contiguous(),), path, dynamo=True, external_data=False, verbose=False
            )
            net = OnnxGraph(path.read_bytes())
    return net, image


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--scan", type=Path)
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--runs", type=int, default=7)
    parser.add_argument("--engines", default="torch")
    parser.add_argument("--short", action="store_true")  # measure only the engines
    parser.add_argument("--variant")  # to measure in this process; for `run_variant`
    options = parser.parse_args()

    if options.variant:
        print(json.dumps(measure(options)))
        return
    with TemporaryDirectory() as folder:
        if options.scan is None:
            simulate(Path(folder), scans=1)
        compare(options, options.scan or Path(folder) / "sequences/00/velodyne/000000.bin")


def compare(options: argparse.Namespace, scan: Path) -> None:
    """Measure every variant of each engine and print a table of their times.

    Each measurement is a process of its own. The variants take turns, round by round.
    """
    variants = list(product([UNCHANGED], options.engines.split(",")))
    if not options.short:
        variants += product([*REMOVALS, ALL], ["torch"])

    results: defaultdict[tuple[str, str], list[dict[str, float]]] = defaultdict(list)
    for number in range(options.rounds):
        for variant, engine in variants:
            results[variant, engine].append(run_variant(variant, engine, scan, options))
            print(f"round {number + 1}: {engine}, {variant}", file=sys.stderr)

    first = results[variants[0]][0]
    print(
        f"{first['points']:,.0f} points, {first['uncertain']:.1%} of them uncertain; "
        "ms, medians of rounds\n"
    )
    columns = (*STAGES, "all", "fusion", "SalsaNext", "all / SalsaNext")
    print("| |", " | ".join(columns), "|\n|---|" + "---|" * len(columns))
    for (variant, engine), rounds in results.items():
        name = variant if engine == "torch" else engine
        print(f"| {name} |", " | ".join(cells(rounds, columns)), "|")


def run_variant(
    variant: str, engine: str, scan: Path, options: argparse.Namespace
) -> dict[str, float]:
    """Run `measure` in another process."""
    command = [sys.executable, __file__, "--scan", str(scan), "--runs", str(options.runs)]
    command += ["--variant", variant, "--engines", engine]

    output = subprocess.run(command, check=True, capture_output=True, text=True).stdout
    return json.loads(output.splitlines()[-1])


def cells(rounds: list[dict[str, float]], columns: tuple[str, ...]) -> list[str]:
    """Return a row of the table, without its name."""
    texts = {}
    for key in (*STAGES, MEAN, "all", "SalsaNext"):
        texts[key] = f"{1e3 * median_of(rounds, key):.1f}"

    fusion_shares = []
    ratios = []
    for row in rounds:
        fusion_shares.append(sum(row[stage] for stage in FUSION) / row["all"])
        ratios.append(row["all"] / row["SalsaNext"])
    texts["fusion"] = f"{np.median(fusion_shares):.1%}"
    texts["all / SalsaNext"] = f"{np.median(ratios):.2f}"
    return [texts[column] for column in columns]


if __name__ == "__main__":
    main()
