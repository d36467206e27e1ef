"""Label each point of a LiDAR scan: road, car, person, ...

Load a segmenter, call it, and save or show the result:

    import amvnet

    segmenter = amvnet.load("sim-hdl64e")  # or another of amvnet.list_weights(), or a file
    result = segmenter("scan.pcd")         # or an array (N, 4): x, y, z, intensity in [0, 1]
    result.save("scan.ply")                # or .pcd, .las, .laz, .npy, .label
    amvnet.show(result)                    # in 3D, in the browser

A result has, in the order of the points:

    result.labels, result.class_names      # ids (N,), and the name of each id
    result.points, result.uncertain        # x, y, z (N, 3); where the two networks disagree (N,)
    result.counts()                        # {"road": 65510, "car": 3298, ...}
    result.mask("car", "truck")            # which points are one of these (N,)
    result.verdict                         # whether the labels can be relied on

Many scans: `segmenter.each("folder")`. Scans in memory: `amvnet.read`, `amvnet.read_all`. A drive:
`amvnet.drive`. The scores of two other models: `amvnet.fuse`. Scans to try: `amvnet.simulate`.

Bad input raises `amvnet.InputError` with one line: what was expected, what was found, what to do.
"""

from __future__ import annotations

import os
from importlib import import_module
from importlib.metadata import version
from typing import TYPE_CHECKING, Any

from amvnet.progress import Reporter, report_nothing

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence
    from pathlib import Path

    from amvnet import onnx_runner as onnx_runner
    from amvnet import weights as weights
    from amvnet.data.datasets.simulated import simulate as simulate
    from amvnet.engines.base import Engine
    from amvnet.engines.compute import Compute, EngineName, Precision
    from amvnet.errors import InputError as InputError
    from amvnet.inference.drive import drive as drive
    from amvnet.inference.fuse import fuse as fuse
    from amvnet.inference.listing import read as read
    from amvnet.inference.listing import read_all as read_all
    from amvnet.inference.segmentation import Segmentation as Segmentation
    from amvnet.inference.segmenter import Segmenter as Segmenter
    from amvnet.models.methods import MethodName
    from amvnet.scan import Scan as Scan
    from amvnet.viewing.page import show as show
    from amvnet.weights.file import Weights as Weights
    from amvnet.weights.file import list_weights as list_weights
    from amvnet.weights.push import push as push

# The modules of the names, which are imported when they are first used: `import amvnet` is fast.
_MODULES = {
    "Scan": "amvnet.scan",
    "Segmentation": "amvnet.inference.segmentation",
    "Segmenter": "amvnet.inference.segmenter",
    "Weights": "amvnet.weights.file",
    "drive": "amvnet.inference.drive",
    "fuse": "amvnet.inference.fuse",
    "list_weights": "amvnet.weights.file",
    "push": "amvnet.weights.push",
    "read": "amvnet.inference.listing",
    "read_all": "amvnet.inference.listing",
    "show": "amvnet.viewing.page",
    "simulate": "amvnet.data.datasets.simulated",
    "InputError": "amvnet.errors",
}
__all__ = ["load", *_MODULES]
__version__ = version("amvnet")

_SUBMODULES = ("onnx_runner", "weights")

# ONNX Runtime from 1.29 on would report the graphs that it runs to Microsoft. It reads this
# variable when it is imported.
os.environ.setdefault("ORT_DISABLE_TELEMETRY", "1")


def load(
    weights: Weights | Path | str,
    device: str = "auto",
    method: MethodName = "amvnet",
    precision: Precision = "auto",
    engine: EngineName = "torch",
    tau: float | None = None,
    *,
    sensor: str | Mapping[str, Any] | None = None,
    height: float | None = None,
    columns: str | Sequence[str] | None = None,
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
            (`sim-hdl64e`, `sim-hdl32e`), or weights on the hub (`hf-hub:OWNER/NAME`).
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
        graphs: on a GPU, capture the networks as CUDA graphs.
        report: called with a line that names the device, and with a line before long work.

    Raises:
        InputError: if there are no such weights, sensor or columns; if the weights lack a part that
            the method needs; if there is no such method, device, precision or engine; if tau is out
            of range; if a library of the engine is missing; or if the sensor of the weights cannot
            be simulated for int8.
    """
    from amvnet.data.formats.rows import parse_layout
    from amvnet.engines.compute import Compute
    from amvnet.sensors.lidars import make_sensor

    is_described = sensor is not None or height is not None
    described = make_sensor(sensor, height=height) if is_described else None
    parse_layout(columns)  # before the networks are loaded, which takes long
    compute = Compute(device, engine, precision)
    segmenter = load_with(compute, weights, method, tau, graphs=graphs, report=report)
    segmenter.sensor = described
    segmenter.columns = columns
    return segmenter


def load_with(
    compute: Compute,
    weights: Weights | Path | str,
    method: MethodName,
    tau: float | None = None,
    *,
    graphs: bool = True,
    report: Reporter = report_nothing,
) -> Segmenter:
    """Return the segmenter of `load`, given where and how the networks are computed."""
    from amvnet.engines.precision import resolved
    from amvnet.inference.segmenter import Segmenter
    from amvnet.weights.file import Weights
    from amvnet.weights.file import load as load_weights

    loaded = weights if isinstance(weights, Weights) else load_weights(weights)
    compute = resolved(compute)
    made: Engine
    if compute.engine == "torch":
        from amvnet.engines.torch import TorchEngine

        made = TorchEngine(
            loaded,
            method,
            tau,
            device=compute.device,
            precision=compute.precision,
            graphs=graphs,
        )
    else:
        from amvnet.engines.onnx import OnnxEngine
        from amvnet.export.cache import cached_networks
        from amvnet.export.int8 import SIMULATED
        from amvnet.models.methods import check_method

        check_method(method, loaded.parts)  # before the export, which takes long
        is_int8 = compute.engine == "int8"
        networks = cached_networks(loaded, SIMULATED if is_int8 else None, report)
        made = OnnxEngine(loaded, networks, method, tau, int8=is_int8)

    segmenter = Segmenter(loaded, made, compute.at_once)
    report(f"computing on {made.hardware} in {made.precision}")
    return segmenter


# Hide this function from type checkers, which would otherwise accept any name of the package.
if not TYPE_CHECKING:

    def __getattr__(name: str) -> Any:
        if name in _SUBMODULES:
            return import_module(f"amvnet.{name}")
        if name not in _MODULES:
            raise AttributeError(f"module 'amvnet' has no attribute {name!r}")
        return getattr(import_module(_MODULES[name]), name)


def __dir__() -> list[str]:
    return sorted([*__all__, *_SUBMODULES, "__doc__", "__version__"])
