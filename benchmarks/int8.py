"""Compare graphs in int8 with graphs in float32, both in ONNX Runtime.

The tables show the mIoU of each method, and the time of each graph and of a whole scan.

    amvnet export --weights W --out FLOAT && amvnet export --weights W --out INT8 --int8 simulated
    python benchmarks/int8.py FLOAT INT8 DATA [THREADS]
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np

from amvnet.data.datasets.base import Dataset
from amvnet.data.datasets.open import open_dataset
from amvnet.evaluation.metrics import Evaluation
from amvnet.onnx_runner import OnnxSegmenter, disagree, disputed_points
from amvnet.scan import Scan

GRAPHS = ("range_net", "polar_map")
RUNS = 15
WARM_UP = 2


class Runner(OnnxSegmenter):
    """A segmenter with a number of threads, which keeps the last inputs of its graphs."""

    def __init__(self, folder: str, threads: int) -> None:
        import onnxruntime  # after amvnet, which turns its telemetry off

        super().__init__(folder)
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = threads
        for name in self._graphs:
            path = Path(folder) / self.description["graphs"][name]["file"]
            self._graphs[name] = onnxruntime.InferenceSession(str(path), options)
        self.last_inputs: dict[str, tuple[np.ndarray, ...]] = {}

    def _run(self, name: str, *inputs: np.ndarray) -> np.ndarray:
        self.last_inputs[name] = inputs
        return super()._run(name, *inputs)

    def label(self, scan: Scan) -> tuple[dict[str, np.ndarray], np.ndarray]:
        """Return the labels of finite points by method, and (P,) bool: the uncertain points."""
        scan = self.expects.prepare(scan)
        valid = scan.select(scan.valid)
        points = valid.points
        f = self.score_range_view(valid)
        g = self.score_polar_view(points)
        uncertain = disagree(self.assertion, f, g)

        scores = {"rv": f, "bev": g, "ensemble": np.sqrt(f * g)}
        if self.method == "amvnet":
            merged = scores["ensemble"].copy()
            disputed = disputed_points(self.assertion, f, g, uncertain)
            merged[disputed] = self._classify(points, f, g, disputed)
            scores["amvnet"] = merged

        labels = {name: values.argmax(axis=1) + 1 for name, values in scores.items()}
        return labels, uncertain

    def run_again(self, name: str) -> np.ndarray:
        """Run a graph on its last inputs."""
        return super()._run(name, *self.last_inputs[name])


def race(float32: Callable[[], Any], int8: Callable[[], Any]) -> tuple[float, float]:
    """Return the median times of both, milliseconds. They run in turns, after runs that warm up."""
    times: tuple[list[float], list[float]] = ([], [])
    for _ in range(WARM_UP + RUNS):
        for call, milliseconds in zip((float32, int8), times, strict=True):
            started = time.perf_counter()
            call()
            milliseconds.append(1000 * (time.perf_counter() - started))
    return median(times[0][WARM_UP:]), median(times[1][WARM_UP:])


def compare_labels(float32: Runner, int8: Runner, dataset: Dataset, data: str) -> None:
    evaluations = {"float32": Evaluation(dataset.taxonomy), "int8": Evaluation(dataset.taxonomy)}
    equal: list[float] = []
    for record in dataset.records(dataset.sequences("all")):
        scan = dataset.read(record)
        assert scan.labels is not None
        points = scan.points[scan.valid]
        truth = scan.labels[scan.valid]

        last_labels = []
        for name, runner in (("float32", float32), ("int8", int8)):
            labels, uncertain = runner.label(scan)
            evaluations[name].add(points, truth, labels, uncertain)
            last_labels.append(list(labels.values())[-1])
        equal.append(float((last_labels[0] == last_labels[1]).mean()))

    for name, evaluation in evaluations.items():
        report = evaluation.report(data)
        figures = []
        for method, scores in report["methods"].items():
            figures.append(f"{method} {100 * scores['miou']:.2f} ({100 * scores['accuracy']:.2f})")
        uncertain_share = f"uncertain {report['uncertain_fraction']:.1%}"
        print(f"{name}: mIoU (accuracy) {', '.join(figures)}; {uncertain_share}")
    print(f"labels of the last method that are the same: {np.mean(equal):.1%}")


def compare_times(float32: Runner, int8: Runner, scan: Scan) -> None:
    float32.label(scan)
    int8.label(scan)
    for name in GRAPHS:
        int8.last_inputs[name] = float32.last_inputs[name]
        print_race(name, partial(float32.run_again, name), partial(int8.run_again, name))

    print_race(
        "scan", partial(float32, scan.points, scan.ring), partial(int8, scan.points, scan.ring)
    )


def print_race(name: str, float32: Callable[[], Any], int8: Callable[[], Any]) -> None:
    slow, fast = race(float32, int8)
    print(f"{name}: float32 {slow:.1f} ms, int8 {fast:.1f} ms, {slow / fast:.2f} times as fast")


def main(float32: str, int8: str, data: str, threads: str = "2") -> None:
    float32_runner = Runner(float32, int(threads))
    int8_runner = Runner(int8, int(threads))
    dataset = open_dataset(data)
    compare_labels(float32_runner, int8_runner, dataset, data)

    first = dataset.records(dataset.sequences("all"))[0]
    compare_times(float32_runner, int8_runner, dataset.read(first))


if __name__ == "__main__":
    main(*sys.argv[1:])
