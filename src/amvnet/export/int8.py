"""Exported convolutions in 8-bit integers: calibrated on some scans, checked on others."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from amvnet.errors import InputError
from amvnet.export.onnx_files import digest, one_line, quiet, strip
from amvnet.inference.predict import Task
from amvnet.inference.segmenter import Segmenter
from amvnet.inference.tasks import Lone, tasks_in
from amvnet.onnx_runner import OnnxSegmenter
from amvnet.scan import Scan
from amvnet.sensors.adapt import ScanAdapter

SIMULATED = "simulated"  # in place of a data set: streets of the weights' sensor
SEED = 20_261_121  # of these streets, far from those of any training
SCANS = 20  # that are taken, evenly spaced
HELD = 5  # of so many scans the first one checks, the others calibrate
LEAST_AGREEMENT = 0.9  # of labels before and after; far less than a good calibration gives
# The graphs that are convolutions, nearly all of the time, and whether their first layer stays as it is: the range
# view's input is metres beside a mask of 0 and 1, for which 256 steps are too few.
FIRST_KEPT = {"range_net": True, "polar_map": False}


def calibration_scans(text: str, segmenter: Segmenter) -> list[Scan]:
    """Scans of a data set, scan files or folders of them as `predict` takes them, or of simulated streets.

    Raises:
        InputError: where there are none, one is broken, or the weights' sensor cannot be simulated.
    """
    if text != SIMULATED:
        return _read(text, segmenter)
    from amvnet.simulation import SENSORS, simulate

    sensor = segmenter.weights.sensor
    if sensor not in SENSORS:
        raise InputError(
            f"expected weights of {' or '.join(SENSORS)} to simulate for, found {sensor!r}; name scans"
        )
    with TemporaryDirectory() as folder:
        simulate(folder, sensor=sensor, sequences=SCANS, scans=1, seed=SEED)
        return _read(folder, segmenter)


def quantise(
    folder: Path, names: Sequence[str], scans: Sequence[Scan]
) -> Iterator[tuple[str, dict[str, Any]]]:
    """Replace exported graphs by ones in int8.

    Args:
        folder: what `amvnet export` wrote.
        names: the graphs, of `FIRST_KEPT`.
        scans: one of five, from the first on, checks; the others calibrate. A lone one does both.

    Yields:
        Each name with what the description says anew: `precision`, `sha256`, and `agreement`, the share of the
        points whose label by this network stays.

    Raises:
        InputError: where a graph cannot be quantised, or the agreement is below `LEAST_AGREEMENT`.
    """
    held, kept = list(scans[::HELD]), [scan for place, scan in enumerate(scans) if place % HELD]
    before = _Recorder(folder)
    for name in names:
        expected = _labels(before, name, held)
        before.given[name].clear()
        _labels(before, name, kept or held)
        _write(folder / f"{name}.onnx", before.given.pop(name))
        agreement = float((_labels(OnnxSegmenter(folder), name, held) == expected).mean())
        if agreement < LEAST_AGREEMENT:
            raise InputError(
                f"{name}: expected {LEAST_AGREEMENT:.0%} of the labels to stay in int8, found {agreement:.0%}; "
                "calibrate with more scans, or leave out --int8"
            )
        yield (
            name,
            {
                "precision": "int8",
                "sha256": digest(folder / f"{name}.onnx"),
                "agreement": agreement,
            },
        )


class _Recorder(OnnxSegmenter):
    """Keeps what each graph is given: a list of (input name, array)."""

    def __init__(self, folder: Path) -> None:
        super().__init__(folder)
        self.given: dict[str, list[dict[str, np.ndarray]]] = {name: [] for name in FIRST_KEPT}

    def _run(self, name: str, *inputs: np.ndarray) -> np.ndarray:
        if name in self.given:
            self.given[name].append(
                {self.description["graphs"][name]["inputs"][0]["name"]: inputs[0]}
            )
        return super()._run(name, *inputs)


def _read(text: str, segmenter: Segmenter) -> list[Scan]:
    by: Callable[[Path, bool], Segmenter] = lambda place, lone: segmenter  # noqa: E731  nothing is segmented
    with TemporaryDirectory() as nowhere:
        fitting = ScanAdapter(segmenter.weights)
        tasks = tasks_in(
            [text], Lone(segmenter.taxonomy, by, fitting, Path(nowhere), None), None, "all"
        )
        scans = [task.read() for task in _spaced(tasks)]
    found = [scan for scan in scans if scan.valid.any()]
    if not found:
        raise InputError(
            f"{text}: expected scans to calibrate with, found none with a finite point; name others"
        )
    return found


def _spaced(tasks: Sequence[Task]) -> list[Task]:
    places = np.linspace(0, len(tasks) - 1, min(SCANS, len(tasks))).astype(int)
    return [tasks[place] for place in places]


def _labels(runner: OnnxSegmenter, name: str, scans: Sequence[Scan]) -> np.ndarray:
    """Of the finite points of all scans, by the network that the graph is a part of."""
    found = []
    for scan in scans:
        points = scan.points[scan.valid]
        ring = None if scan.ring is None else scan.ring[scan.valid]
        scores = (
            runner.score_range_view(points, ring)
            if name == "range_net"
            else runner.score_polar_view(points)
        )
        found.append(scores.argmax(axis=1))
    return np.concatenate(found)


def _write(path: Path, inputs: list[dict[str, np.ndarray]]) -> None:
    """Replace a graph by its quantised one, calibrated with some inputs.

    Unsigned activations and signed weights are what ONNX Runtime's kernels for x86 take whole. Weights have seven
    bits: processors without VNNI would overflow with eight. The range of a value is the mean of those of the scans.
    """
    from onnxruntime.quantization import CalibrationMethod, QuantFormat, QuantType, quantize_static
    from onnxruntime.quantization.shape_inference import quant_pre_process

    ready, done = path.with_suffix(".ready"), path.with_suffix(".int8")
    with quiet("root"), one_line(path.stem, "onnxruntime.quantization", "onnx and onnxruntime"):
        quant_pre_process(path, ready, skip_symbolic_shape=True)
        quantize_static(
            *(ready, done, _Inputs(inputs)),
            quant_format=QuantFormat.QDQ,
            activation_type=QuantType.QUInt8,
            weight_type=QuantType.QInt8,
            per_channel=True,
            reduce_range=True,
            calibrate_method=CalibrationMethod.MinMax,
            nodes_to_exclude=_first_layer(ready) if FIRST_KEPT[path.stem] else [],
            extra_options={"CalibMovingAverage": True},
        )
    ready.unlink()
    os.replace(done, path)
    strip(path)


def _first_layer(path: Path) -> list[str]:
    """The names of the nodes up to the first activation."""
    import onnx

    nodes = list(onnx.load(path).graph.node)
    end = next((place for place, node in enumerate(nodes) if node.op_type == "LeakyRelu"), -1)
    return [node.name for node in nodes[: end + 1]]


class _Inputs:
    """The inputs as onnxruntime's calibration asks for them: one by one, then None."""

    def __init__(self, inputs: list[dict[str, np.ndarray]]) -> None:
        self._left = iter(inputs)

    def get_next(self) -> dict[str, np.ndarray] | None:
        return next(self._left, None)
