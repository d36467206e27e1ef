"""Graphs in int8 beside those in float32, both in ONNX Runtime: time of each graph and of a scan, and mIoU by method.

amvnet export --weights W --out FLOAT && amvnet export --weights W --out INT8 --int8 simulated
python benchmarks/int8.py FLOAT INT8 DATA [THREADS]
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np
import onnxruntime

from amvnet.data.datasets.open import open_dataset
from amvnet.evaluation.metrics import Evaluation
from amvnet.onnx_runner import OnnxSegmenter, disagree
from amvnet.scan import Scan

GRAPHS = ("range_net", "polar_map")
RUNS = 15


class Runner(OnnxSegmenter):
    """With so many threads; knows what its graphs were given last, and all methods' labels."""

    def __init__(self, folder: str, threads: int) -> None:
        super().__init__(folder)
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = threads
        files = {
            name: str(Path(folder) / self.description["graphs"][name]["file"])
            for name in self._graphs
        }
        self._graphs = {
            name: onnxruntime.InferenceSession(file, options) for name, file in files.items()
        }
        self.given: dict[str, tuple[np.ndarray, ...]] = {}

    def _run(self, name: str, *inputs: np.ndarray) -> np.ndarray:
        self.given[name] = inputs
        return super()._run(name, *inputs)

    def by_method(self, scan: Scan) -> tuple[dict[str, np.ndarray], np.ndarray]:
        """Labels by method, and which points are uncertain, of the finite points."""
        points, ring = scan.points[scan.valid], None if scan.ring is None else scan.ring[scan.valid]
        f, g = self.score_range_view(points, ring), self.score_polar_view(points)
        found = {"rv": f, "bev": g, "ensemble": np.sqrt(f * g)}
        uncertain = disagree(self.assertion, f, g)
        if self.method == "amvnet":
            found["amvnet"] = found["ensemble"].copy()
            found["amvnet"][uncertain] = self._settle(points, f, g, uncertain)
        return {name: scores.argmax(axis=1) + 1 for name, scores in found.items()}, uncertain

    def run_graph(self, name: str, inputs: tuple[np.ndarray, ...]) -> Callable[[], Any]:
        return lambda: super(Runner, self)._run(name, *inputs)


def race(float32: Callable[[], Any], int8: Callable[[], Any]) -> tuple[float, float]:
    """Median milliseconds of both, run by turns, after two runs that only warm up."""
    times: tuple[list[float], list[float]] = ([], [])
    for _ in range(RUNS + 2):
        for call, kept in zip((float32, int8), times, strict=True):
            start = time.perf_counter()
            call()
            kept.append(1000 * (time.perf_counter() - start))
    return median(times[0][2:]), median(times[1][2:])


def main(float32: str, int8: str, data: str, threads: str = "2") -> None:
    runners = {"float32": Runner(float32, int(threads)), "int8": Runner(int8, int(threads))}
    dataset = open_dataset(data)
    records = dataset.records(dataset.sequences("all"))
    found = {name: Evaluation(dataset.taxonomy) for name in runners}
    same: list[float] = []
    for record in records:
        scan = dataset.read(record)
        assert scan.labels is not None
        labels = {name: runner.by_method(scan) for name, runner in runners.items()}
        for name, (by_method, uncertain) in labels.items():
            found[name].add(scan.points[scan.valid], scan.labels[scan.valid], by_method, uncertain)
        last = [list(by_method.values())[-1] for by_method, _ in labels.values()]
        same.append(float((last[0] == last[1]).mean()))
    for name, evaluation in found.items():
        report = evaluation.report(data)
        figures = (f"{key} {100 * one['miou']:.2f} ({100 * one['accuracy']:.2f})"
                   for key, one in report["methods"].items())  # fmt: skip
        print(
            f"{name}: mIoU (accuracy) {', '.join(figures)}; uncertain {report['uncertain_fraction']:.1%}"
        )
    print(f"labels of the last method that are the same: {np.mean(same):.1%}")
    first, second = runners.values()
    scan = dataset.read(records[0])
    first.by_method(scan)
    rows = {
        name: [one.run_graph(name, first.given[name]) for one in (first, second)] for name in GRAPHS
    }
    rows["scan"] = [lambda one=one: one(scan.points, scan.ring) for one in (first, second)]  # type: ignore[misc]
    for name, (one, other) in rows.items():
        a, b = race(one, other)
        print(f"{name}: float32 {a:.1f} ms, int8 {b:.1f} ms, {a / b:.2f} times as fast")


if __name__ == "__main__":
    main(*sys.argv[1:])
