"""Measure how many scans a second `predict` segments, next to the two networks alone.

    python benchmarks/many_scans.py FOLDER [--weights NAME] [--engines torch,int8]
        [--at-once 1,2] [--taus 0.5,0.85] [--rounds N]

FOLDER holds ten scan files or more, such as *.bin. The rate of `predict` is the rate at which label
files appear, without the first few, so that the start of the program does not count.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import time
from collections import defaultdict
from itertools import product
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import torch

from amvnet import load
from amvnet import read as read_scan
from amvnet.inference.scan_stream import stream_scans

WARM_UP = 4  # number of scans that do not count
SLEEPING = {**os.environ, "OMP_WAIT_POLICY": "passive"}  # the environment of commands


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--weights", default="sim-hdl64e")
    parser.add_argument("--engines", default="torch,int8")
    parser.add_argument("--at-once", default="1,2")
    parser.add_argument("--taus", default="0.85")
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--networks", action="store_true")  # in this process, for `networks_rate`
    options = parser.parse_args()

    paths = sorted(path for path in options.folder.iterdir() if path.is_file())
    if options.networks:
        print(json.dumps(time_networks(options, paths)))
        return

    lists = (options.engines.split(","), options.at_once.split(","), options.taus.split(","))
    rows: defaultdict[tuple[str, ...], list[tuple[float, float, int]]] = defaultdict(list)
    for _ in range(options.rounds):
        for engine, at_once in product(*lists[:2]):
            common = [str(options.folder), "--weights", options.weights, "--at-once", at_once]
            networks = networks_rate([*common, "--engines", engine])
            for tau in lists[2]:
                predict = predict_rate([*common, "--engine", engine, "--tau", tau])
                rows[engine, at_once, tau].append((networks, *predict))

    print(f"{len(paths)} scans; scans per second, medians of {options.rounds} rounds\n")
    print("| engine | at once | tau | networks alone | predict | share | peak memory, MiB |")
    print("|---|---|---|---|---|---|---|")
    for variant, rounds in rows.items():
        networks, predict, memory = np.median(rounds, axis=0)
        share = np.median([row[1] / row[0] for row in rounds])
        cells = f"{networks:.1f} | {predict:.1f} | {share:.2f} | {memory:.0f}"
        print(f"| {' | '.join(variant)} | {cells} |")


def predict_rate(options: list[str]) -> tuple[float, int]:
    """Return the scans per second of `amvnet predict`, and its peak memory in MiB."""
    with TemporaryDirectory() as out:
        command = [sys.executable, "-m", "amvnet", "predict", *options, "--out", out]
        process = subprocess.Popen(
            command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, env=SLEEPING
        )
        _, status, usage = os.wait4(process.pid, 0)
        if status:
            raise RuntimeError(f"expected predict to end well, found {status}: {command}")

        written = sorted(path.stat().st_mtime for path in Path(out).glob("*.label"))
    counted = written[WARM_UP:]
    return (len(counted) - 1) / (counted[-1] - counted[0]), usage.ru_maxrss // 1024


def networks_rate(options: list[str]) -> float:
    """Return the rate of `time_networks`, measured in another process."""
    command = [sys.executable, __file__, *options, "--networks"]
    output = subprocess.run(command, check=True, capture_output=True, text=True, env=SLEEPING)
    return json.loads(output.stdout.splitlines()[-1])


@torch.inference_mode()
def time_networks(options: argparse.Namespace, paths: list[Path]) -> float:
    """Return the number of projected scans per second that the two networks score."""
    segmenter = load(options.weights, engine=options.engines)
    model = segmenter.model
    views = [model.project(segmenter.batch([read_scan(path)])) for path in paths]

    def score(index: int, _: None) -> None:
        with torch.inference_mode():
            model.score(*views[index])

    def score_all(indices: range) -> None:
        for _ in stream_scans(indices, lambda _: None, score, int(options.at_once)):
            pass

    score_all(range(WARM_UP))
    started = time.perf_counter()
    score_all(range(len(views)))
    return len(views) / (time.perf_counter() - started)


if __name__ == "__main__":
    main()
