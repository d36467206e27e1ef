"""Put weights, an engine and a segmenter together, or choose the weights by the first scan."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from amvnet.config.schema import PARTS
from amvnet.data.datasets.files import ScanFiles
from amvnet.data.formats.cloud import Cloud
from amvnet.data.formats.rows import parse_layout
from amvnet.data.recordings import Recording, ScanFile
from amvnet.engines.base import Engine
from amvnet.engines.compute import Compute, EngineName, Precision, resolved
from amvnet.engines.export.cache import cached_networks
from amvnet.engines.onnx import OnnxEngine
from amvnet.engines.torch import TorchEngine
from amvnet.errors import InputError
from amvnet.inference.listing import Inputs
from amvnet.inference.segmenter import Segmenter
from amvnet.models.assertion import Disagreement
from amvnet.models.methods import MethodName, check_method
from amvnet.progress import Reporter, report_nothing
from amvnet.scan import AnyArray, Scan
from amvnet.sensors.built_in import weights_for
from amvnet.sensors.lasers import SensorGeometry
from amvnet.sensors.lidars import AUTO, Sensor, make_sensor
from amvnet.sensors.reading import AS_FOUND, Reading, array_cloud
from amvnet.weights.file import Weights
from amvnet.weights.file import load as load_weights

CHOSEN = ("weights", "engine", "at_once")  # what a segmenter lacks until its weights are chosen


def load(
    weights: Weights | Path | str = AUTO,
    device: str = "auto",
    method: MethodName = "amvnet",
    precision: Precision = "auto",
    engine: EngineName = "torch",
    tau: float | None = None,
    *,
    sensor: str | Mapping[str, Any] | None = None,
    height: float | None = None,
    columns: str | Sequence[str] | None = None,
    keep_own: bool = False,
    graphs: bool = True,
    report: Reporter = report_nothing,
) -> Segmenter:
    """Return a segmenter with trained weights.

    The engine `onnx` exports the networks once, which takes half a minute, and keeps them in
    $AMVNET_CACHE. It takes scans one by one, and runs the networks on a GPU if the installed ONNX
    Runtime supports it. The engine `int8` does the same on the CPU, with convolutions in 8-bit
    integers. It calibrates them once on simulated scans of the weights' sensor, which takes a few
    minutes.

    Args:
        weights: trained weights, the path of a weights file, the name of built-in weights
            (`list_weights`), weights on the hub (`hf-hub:OWNER/NAME`), or "auto": the lasers of the
            first scan then choose the built-in weights, which label all scans. Until then, the
            segmenter has no weights and no classes.
        device: the device to compute on: "cpu", "cuda", "cuda:1", ..., or "auto", which is "cuda"
            if there is a GPU and the engine is "torch", else "cpu".
        method: "amvnet", or for comparison "rv" or "bev" (one network), "rv-knn" (the range view
            with a vote of neighbours), "ensemble" (geometric mean), "arithmetic" or "maximum".
        precision: the precision of the two networks: "float32", "bfloat16", on a GPU "float16", or
            "auto", which is bfloat16 on a GPU that supports it, else float32. The projections are
            computed in float64, everything else in float32.
        engine: the program that runs the networks: "torch", "onnx" or "int8".
        tau: a point is uncertain if the cosine similarity of the two networks' class probabilities
            is at most tau, in [0, 1]. By default, it is the threshold of the weights.
        sensor: the sensor of arrays and scan files: a name that `amvnet list` prints, a YAML file,
            or attributes such as {"unit": "mm", "axes": "z-down"}. The rest is measured. With a
            sensor or a height, arrays are normalised as files are.
        height: the height of the sensor over the ground, metres.
        columns: the names of the columns of arrays and of files of rows, as `Segmenter` takes them.
        keep_own: label the points of the car's own body as others. By default, they get the id 0.
            The body of nuScenes' car is known; of others, `own_body` of the sensor tells it.
        graphs: on a GPU, capture the networks as CUDA graphs.
        report: called with a line that names the device, and with a line before long work.

    Raises:
        InputError: if there are no such weights, sensor or columns; if the weights lack a part that
            the method needs; if there is no such method, device, precision or engine; if tau is out
            of range; if a library of the engine is missing; or if the sensor of the weights cannot
            be simulated for int8.
    """
    described = make_sensor(sensor, height=height, keep_own=keep_own or None)
    reading = Reading(described, parse_layout(columns))
    compute = Compute(device, engine, precision)

    def load_named(weights: Weights | Path | str) -> Segmenter:
        return load_with(
            compute, weights, method, tau, reading=reading, graphs=graphs, report=report
        )

    if weights != AUTO:
        return load_named(weights)
    compute = resolved(compute)  # what can be checked before the first scan
    check_method(method, PARTS)
    if tau is not None:
        Disagreement(tau)
    return ChoosingSegmenter(load_named, reading, report)


def load_with(
    compute: Compute,
    weights: Weights | Path | str,
    method: MethodName,
    tau: float | None = None,
    *,
    reading: Reading = AS_FOUND,
    graphs: bool = True,
    report: Reporter = report_nothing,
) -> Segmenter:
    """Return the segmenter of `load`, given where and how the networks are computed."""
    loaded = weights if isinstance(weights, Weights) else load_weights(weights)
    compute = resolved(compute)
    made: Engine
    if compute.engine == "torch":
        made = TorchEngine(
            loaded, method, tau, device=compute.device, precision=compute.precision, graphs=graphs
        )
    else:
        check_method(method, loaded.parts)  # before the export, which takes long
        is_int8 = compute.engine == "int8"
        networks = cached_networks(loaded, is_int8, report)
        made = OnnxEngine(loaded, networks, method, tau, int8=is_int8)

    segmenter = Segmenter(loaded, made, reading, compute.at_once)
    report(f"computing on {made.hardware} in {made.precision}")
    return segmenter


def choose_by(cloud: Cloud, sensor: Sensor) -> tuple[str, str]:
    """Return the name of built-in weights for a scan in memory, and why, as `Inputs` does."""
    recording = Recording("scan")
    recording.scans.append(ScanFile("scan", recording, Path("scan"), read=lambda: cloud))
    return Inputs([ScanFiles(recording.scans)], Reading(sensor)).choose_weights()


class ChoosingSegmenter(Segmenter):
    """Segments scans with the built-in weights that suit the lasers of the first scan.

    Args:
        make: returns the segmenter with the weights of a name.
        reading: as `Segmenter` takes it.
        report: called with a line that says which weights are chosen, and why.
    """

    def __init__(
        self, make: Callable[[str], Segmenter], reading: Reading, report: Reporter
    ) -> None:
        self.reading = reading
        self._make = make
        self._report = report
        self._choice = ""  # the line that is reported

    def __getattr__(self, name: str) -> Any:
        if name not in CHOSEN:
            raise AttributeError(f"{type(self).__name__!r} object has no attribute {name!r}")
        raise InputError(
            f"{name}: expected a segmented scan, whose lasers choose the weights, found none; "
            "segment one, or name weights, as "
            "amvnet.load(amvnet.list_weights()[0])"
        )

    def __repr__(self) -> str:
        if self._choice:
            return super().__repr__()
        return "<Segmenter with built-in weights by the lasers of the first scan>"

    def _list(self, inputs: Inputs) -> list[ScanFile]:
        if not self._choice:
            self._take(*inputs.choose_weights())
        return super()._list(inputs)

    def _read_array(
        self, points: AnyArray | Scan, columns: str | Sequence[str] | None = None
    ) -> Scan:
        if not self._choice:
            if isinstance(points, Scan):
                cloud = Cloud.of(points)
            else:
                cloud = array_cloud(points, self.reading.by(columns).layout)
            # Unless the sensor is described, such points are not normalised: without rings, the
            # networks would not know the lasers.
            if cloud.ring is None and not self.reading.sensor.is_known:
                self._take(*weights_for(SensorGeometry()))
            else:
                self._take(*choose_by(cloud, self.reading.sensor))
        return super()._read_array(points, columns)

    def _take(self, name: str, reason: str) -> None:
        """Take the weights of a name."""
        made = self._make(name)
        self.weights = made.weights
        self.engine = made.engine
        self.at_once = made.at_once
        self._choice = f"weights {name}, {reason}"
        self._report(self._choice)
