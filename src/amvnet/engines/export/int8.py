"""Convert exported convolutions to 8-bit integers: calibrate on some scans, check on others."""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np

from amvnet.engines.export.onnx_files import digest, finish, quiet
from amvnet.errors import InputError
from amvnet.files import temporary_folder
from amvnet.onnx_runner import OnnxSegmenter, open_session
from amvnet.scan import Scan
from amvnet.sensors.normalise import Normaliser, normalised
from amvnet.weights.file import Weights

SIMULATED = "simulated"  # stands for simulated streets, as the weights' sensor sees them
STREETS = [str(number) for number in range(999_000, 999_004)]  # no training has such streets
MAX_SCANS = 20  # largest number of scans that calibrate and check
CHECK_EVERY = 5  # the first of every five scans is for the check, the others to calibrate
# The least share of labels that must stay; a good calibration keeps far more.
LEAST_AGREEMENT = 0.9
# The graphs of convolutions, which take nearly all of the time, and whether their first layer stays
# in float32. The input of the range view holds metres next to a mask of 0 and 1: 256 steps for both
# would be too coarse.
KEEPS_FIRST_LAYER = {"range_net": True, "polar_map": False}


def simulated_scans(weights: Weights) -> list[Scan]:
    """Simulate scans for the calibration, as the weights' sensor sees them.

    Raises:
        InputError: if the sensor cannot be simulated.
    """
    from amvnet.data.datasets.simulated import SimulatedStreets
    from amvnet.data.taxonomy import CLASSES_BY_SENSOR

    sensor = weights.sensor
    if sensor not in CLASSES_BY_SENSOR:
        raise InputError(
            f"expected weights of a LiDAR that can be simulated (amvnet list), found {sensor!r}; "
            "give scans of this sensor to amvnet export --int8"
        )
    with temporary_folder() as folder:
        dataset = normalised(SimulatedStreets(folder, sensor), Normaliser(weights.expects))
        records = dataset.records(STREETS)[:MAX_SCANS]
        return [weights.expects.prepare(dataset.read(record, labels=False)) for record in records]


def quantise(
    folder: Path, names: Sequence[str], scans: Sequence[Scan]
) -> Iterator[tuple[str, dict[str, Any]]]:
    """Replace exported graphs by quantised graphs, one after the other.

    The first of every five scans is for the check, the others are for the calibration. A single
    scan serves for both.

    Args:
        names: the graphs to quantise, all of them in `KEEPS_FIRST_LAYER`.
        scans: the scans, prepared for the networks (`Expectation.prepare`).

    Yields:
        The name of each graph and the new values in its description: `precision`, `sha256`, and
        `agreement`, the share of the points whose label by this network stays, in [0, 1].

    Raises:
        InputError: if the agreement is below `LEAST_AGREEMENT`.
    """
    checking = list(scans[::CHECK_EVERY])
    calibrating = [scan for index, scan in enumerate(scans) if index % CHECK_EVERY] or checking
    recorder = _Recorder(folder)
    for name in names:
        expected = _labels(recorder, name, checking)
        recorder.recorded[name].clear()  # forget the scans for the check
        _labels(recorder, name, calibrating)
        path = folder / f"{name}.onnx"
        _write(path, recorder.recorded.pop(name))

        recorder.replace(name, path)
        agreement = float((_labels(recorder, name, checking) == expected).mean())
        if agreement < LEAST_AGREEMENT:
            raise InputError(
                f"{name}: expected {LEAST_AGREEMENT:.0%} of the labels to stay in int8, "
                f"found {agreement:.0%}; calibrate with more scans, or leave out --int8"
            )
        yield name, {"precision": "int8", "sha256": digest(path), "agreement": agreement}


class _Recorder(OnnxSegmenter):
    """Segments scans, and records the inputs of the graphs to quantise, by graph and by run."""

    def __init__(self, folder: Path) -> None:
        super().__init__(folder)
        self.recorded: dict[str, list[dict[str, np.ndarray]]] = {
            name: [] for name in KEEPS_FIRST_LAYER
        }

    def replace(self, name: str, path: Path) -> None:
        """Take a graph from another file, which the description in the folder does not list yet."""
        self._graphs[name] = open_session(path, path.read_bytes(), ["CPUExecutionProvider"])

    def _run(self, name: str, *inputs: np.ndarray) -> np.ndarray:
        if name in self.recorded:
            input_name = self.description["graphs"][name]["inputs"][0]["name"]
            self.recorded[name].append({input_name: inputs[0]})
        return super()._run(name, *inputs)


def _labels(runner: OnnxSegmenter, name: str, scans: Sequence[Scan]) -> np.ndarray:
    """Return the column of the largest score, 0..K - 1, for the finite points of all scans.

    The scores are given by the network that contains the graph `name`.
    """
    labels = []
    for scan in scans:
        valid = scan.select(scan.valid)
        if name == "range_net":
            scores = runner.score_range_view(valid)
        else:
            scores = runner.score_polar_view(valid.points)
        labels.append(scores.argmax(axis=1))

    return np.concatenate(labels)


def _write(path: Path, inputs: list[dict[str, np.ndarray]]) -> None:
    """Replace a graph by its quantised version, calibrated with recorded inputs.

    Activations are unsigned and weights signed: ONNX Runtime's kernels for x86 support this best.
    Weights have seven bits, because processors without VNNI would overflow with eight. The range of
    a value is the mean of its ranges in the scans.
    """
    from onnxruntime.quantization import CalibrationMethod, QuantFormat, QuantType, quantize_static
    from onnxruntime.quantization.shape_inference import quant_pre_process

    ready = path.with_suffix(".ready")
    quantised = path.with_suffix(".int8")

    with quiet("root"):
        quant_pre_process(path, ready, skip_symbolic_shape=True)
        quantize_static(
            ready,
            quantised,
            SimpleNamespace(get_next=partial(next, iter(inputs), None)),
            quant_format=QuantFormat.QDQ,
            activation_type=QuantType.QUInt8,
            weight_type=QuantType.QInt8,
            per_channel=True,
            reduce_range=True,
            calibrate_method=CalibrationMethod.MinMax,
            nodes_to_exclude=_first_layer(ready) if KEEPS_FIRST_LAYER[path.stem] else [],
            extra_options={"CalibMovingAverage": True},
        )

    ready.unlink()
    os.replace(quantised, path)
    finish(path)


def _first_layer(path: Path) -> list[str]:
    """Return the names of the nodes up to the first activation; empty if there is no activation."""
    import onnx

    names = []
    for node in onnx.load(path).graph.node:
        names.append(node.name)
        if node.op_type == "LeakyRelu":
            return names
    return []
