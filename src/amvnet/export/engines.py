"""Other ways to run the networks of a segmenter: compiled by torch, or by ONNX Runtime."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from amvnet import __version__
from amvnet.errors import InputError
from amvnet.export.onnx import OPSET, check_libraries, export
from amvnet.inference.methods import NEEDED
from amvnet.inference.segmenter import Segmenter
from amvnet.models.precision import InPrecision
from amvnet.models.views.range_view import CHANNELS
from amvnet.onnx_runner import DESCRIPTION

ENGINES = ("auto", "torch", "compile", "onnx")
FASTEST = "torch"  # without a long start, see docs/performance.md; what "auto" takes
PartRunner = Callable[[str], Any]  # from a part's name to what runs it
CACHE = "AMVNET_CACHE"  # the variable that says where exported networks are kept


def use_engine(segmenter: Segmenter, engine: str) -> str:
    """Let the networks of a segmenter be run by an engine from now on; returns its name.

    What is around the networks stays torch's. `compile` takes a minute before the first scan. `onnx` exports the
    networks once, in half a minute, and keeps them in `cache_folder`; it takes scans one by one.

    Raises:
        InputError: where there is no such engine, or it lacks a library, a compiler or the device.
    """
    if engine not in ENGINES:
        raise InputError(
            f"expected an engine of {', '.join(ENGINES)}, found {engine!r}; use one of them"
        )
    engine = FASTEST if engine == "auto" else engine
    if engine != "torch":
        run = {"compile": _compiled, "onnx": _exported}[engine](segmenter)
        needed = NEEDED[segmenter.method]
        model = segmenter.model
        if "range_net" in needed:
            holder, name = (
                (model.range_net, "net")
                if isinstance(model.range_net, InPrecision)
                else (model, "range_net")
            )
            setattr(holder, name, run("range_net"))
        if "polar_net" in needed:  # the instance's goes before the class's method of this name
            object.__setattr__(_inner(model.polar_net), "unet", run("polar_map"))
    segmenter.engine = engine
    return engine


def _compiled(segmenter: Segmenter) -> PartRunner:
    model, sizes = segmenter.model, segmenter.weights.model
    a, b = sizes.range_view, sizes.polar_view
    parts: dict[str, tuple[Any, tuple[int, ...]]] = {
        "range_net": (_inner(model.range_net), (1, a.height, a.width, CHANNELS)),
        "polar_map": (
            _inner(model.polar_net).unet,
            (1, b.radial, b.angular, sizes.polar_net.pillar),
        ),
    }

    def run(name: str) -> Any:
        function, shape = parts[name]
        compiled = torch.compile(function)
        try:
            with torch.inference_mode():
                compiled(torch.zeros(shape, device=segmenter.device).permute(0, 3, 1, 2))
        except Exception as error:  # of a dozen classes; most often there is no C++ compiler
            said = (str(error).splitlines() or [""])[0]
            raise InputError(
                f"expected torch.compile to work, found {said}; use the engine torch"
            ) from error
        return compiled

    return run


def _inner(net: nn.Module) -> nn.Module:
    return net.net if isinstance(net, InPrecision) else net


def _exported(segmenter: Segmenter) -> PartRunner:
    if segmenter.device != "cpu" or segmenter.precision != "float32":
        found = f"{segmenter.precision} on {segmenter.device}"
        raise InputError(f"expected float32 on cpu for the engine onnx, found {found}; use compile")
    folder = exported(segmenter)
    return lambda name: OnnxGraph(folder / f"{name}.onnx", torch.get_num_threads())


def cache_folder() -> Path:
    """Where exported networks are kept: $AMVNET_CACHE, or amvnet in the user's cache folder."""
    caches = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    return Path(os.environ.get(CACHE) or caches / "amvnet")


def exported(segmenter: Segmenter) -> Path:
    """The folder of a segmenter's exported networks; they are exported where that has not been done."""
    check_libraries()
    weights = segmenter.weights
    told = [
        *(weights.digest(part) for part in weights.parts),
        repr(weights.model),
        __version__,
        torch.__version__,
    ]
    folder = cache_folder() / "onnx" / hashlib.sha256(repr((told, OPSET)).encode()).hexdigest()[:16]
    if not (folder / DESCRIPTION).is_file():
        export(weights, folder)
    return folder


class OnnxGraph(nn.Module):
    """An exported graph with one input (1, C, H, W) and one output, as a module; float32, no gradients."""

    def __init__(self, path: Path, threads: int) -> None:
        super().__init__()
        import onnxruntime

        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = threads
        # Threads that wait for the next graph would take the processor from torch's.
        options.add_session_config_entry("session.intra_op.allow_spinning", "0")
        self.session = onnxruntime.InferenceSession(
            str(path), options, providers=["CPUExecutionProvider"]
        )
        self.input = self.session.get_inputs()[0].name

    def forward(self, x: Tensor) -> Tensor:
        if len(x) != 1:
            raise InputError(
                f"expected one scan at a time for the engine onnx, found {len(x)}; use torch"
            )
        return torch.from_numpy(self.session.run(None, {self.input: x.contiguous().numpy()})[0])
