"""One forward and backward pass of a paper-size network on one scan: seconds, and the peak of the memory.

python benchmarks/paper_size_step.py rv|bev [SCAN.bin] [LABELS.label]; without a scan, a simulated one.
"""

from __future__ import annotations

import resource
import sys
import time
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import torch

from amvnet.data.files import read_scan
from amvnet.data.labels import SEMANTICKITTI
from amvnet.loading import collate
from amvnet.models.amvnet import build_amvnet
from amvnet.recipes import load_recipe
from amvnet.scan import Scan
from amvnet.simulation import simulate
from amvnet.training import PolarStage, RangeStage


def main(network: str, scan: Path, labels: Path) -> None:
    recipe = load_recipe("semantickitti")
    model = build_amvnet(recipe.model, SEMANTICKITTI.size)
    stage = (
        RangeStage(model.range_view, model.range_net, recipe.training.rv, SEMANTICKITTI, None)
        if network == "rv"
        else PolarStage(model.polar_view, model.polar_net, recipe.training.bev, SEMANTICKITTI, None)
    )
    ids = SEMANTICKITTI.to_train(np.fromfile(labels, np.uint32))
    batch, truth = collate([Scan(read_scan(scan).points, ids)])
    started = time.perf_counter()
    logits, targets, _ = stage.logits(batch, truth)
    loss = stage.loss(logits, targets)
    forward = time.perf_counter() - started
    loss.backward()
    seconds = time.perf_counter() - started
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
    print(
        f"{network}: {len(batch.points)} points, loss {loss.item():.2f}, forward {forward:.1f} s, "
        f"forward and backward {seconds:.1f} s, peak {peak:.1f} GiB, {torch.get_num_threads()} threads"
    )


if __name__ == "__main__":
    with TemporaryDirectory() as folder:
        if len(sys.argv) > 3:
            main(sys.argv[1], Path(sys.argv[2]), Path(sys.argv[3]))
        else:
            simulate(Path(folder), scans=1)
            sequence = Path(folder) / "sequences/00"
            main(sys.argv[1], sequence / "velodyne/000000.bin", sequence / "labels/000000.label")
