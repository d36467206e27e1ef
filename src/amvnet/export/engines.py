"""ONNX Runtime for the networks of a segmenter, also in int8."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Sequence
from importlib.metadata import version
from pathlib import Path
from threading import Lock
from typing import Any, get_args

import torch
from torch import Tensor, nn

from amvnet.errors import InputError
from amvnet.export.int8 import SIMULATED
from amvnet.export.onnx import OPSET, check_libraries, export
from amvnet.inference.segmenter import Segmenter
from amvnet.models.methods import METHODS, Compute, EngineName, MethodName
from amvnet.models.polar_net import PolarNet
from amvnet.models.precision import choose_device
from amvnet.onnx_runner import DESCRIPTION
from amvnet.progress import Say, say_nothing
from amvnet.runtime.memory import keep_freed_memory
from amvnet.weights.file import Weights

ENGINES: tuple[EngineName, ...] = get_args(EngineName)
# ONNX Runtime's execution providers, the fastest first
PROVIDERS = ("TensorrtExecutionProvider", "CUDAExecutionProvider", "CPUExecutionProvider")
CACHE = "AMVNET_CACHE"  # the environment variable with the folder of exported networks


def make_segmenter(
    weights: Weights,
    method: MethodName,
    compute: Compute,
    tau: float | None = None,
    say: Say = say_nothing,
) -> Segmenter:
    """Return a segmenter with an engine, for a process that does nothing else.

    On a CPU, the process keeps the memory that it frees.

    Args:
        tau: as for `Segmenter`.
        say: called with lines about the device, and about work that takes long.

    Raises:
        InputError: as `Segmenter` and `use_engine`.
    """
    device = choose_device(compute.device, compute.engine)
    if device == "cpu":
        keep_freed_memory()
    segmenter = Segmenter(weights, device, method, precision=compute.precision, tau=tau)
    say(f"computing on {segmenter.hardware} in {segmenter.precision}")
    use_engine(segmenter, compute.engine, say)
    if compute.at_once is not None:
        segmenter.at_once = compute.at_once
    return segmenter


def use_engine(segmenter: Segmenter, engine: str, say: Say = say_nothing) -> None:
    """Let an engine run the networks of a segmenter that was made for torch.

    Torch still does everything around the networks. `onnx` exports the networks once, in half a
    minute, and keeps them in `cache_folder`. It takes scans one by one, and computes on a GPU if
    the installed ONNX Runtime can. `int8` does the same on the CPU with convolutions in 8-bit
    integers, which it calibrates once, in a few minutes, on simulated scans of the weights' sensor.

    Args:
        engine: one of `ENGINES`.
        say: called with a line before work that takes long.

    Raises:
        InputError: if there is no such engine, it lacks a library or the device, or the sensor of
            the weights cannot be simulated for int8.
    """
    if engine not in ENGINES:
        raise InputError(
            f"expected an engine of {', '.join(ENGINES)}, found {engine!r}; use one of them"
        )
    if engine == "torch":
        return
    if segmenter.device != "cpu" or segmenter.precision != "float32":
        found = f"{segmenter.precision} on {segmenter.device}"
        raise InputError(
            f"expected float32 on cpu for the engine {engine}, found {found}; use torch"
        )

    parts = METHODS[segmenter.method].parts
    model = segmenter.model
    folder = exported(segmenter, SIMULATED if engine == "int8" else None, say)
    # GPUs cannot run int8 graphs, whose activations are unsigned.
    providers: Sequence[str] = PROVIDERS[-1:]
    if engine == "onnx":
        import onnxruntime

        installed = onnxruntime.get_available_providers()
        providers = [name for name in PROVIDERS if name in installed]
    if len(providers) > 1:
        say(f"the networks compute with the {providers[0]} of ONNX Runtime")
    if "range_net" in parts:
        model.range_net = OnnxGraph(folder / "range_net.onnx", providers)
    if "polar_net" in parts:
        assert isinstance(model.polar_net, PolarNet)
        model.polar_net.run_unet = OnnxGraph(folder / "polar_map.onnx", providers)
    segmenter.engine = engine


def cache_folder() -> Path:
    """Return where exported networks are kept: $AMVNET_CACHE, or amvnet in the user's cache."""
    if os.environ.get(CACHE):
        return Path(os.environ[CACHE])

    caches = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    return Path(caches) / "amvnet"


def exported(segmenter: Segmenter, int8: str | None = None, say: Say = say_nothing) -> Path:
    """Return the folder of a segmenter's exported networks; export them if it is not there."""
    check_libraries()
    weights = segmenter.weights
    digests = [weights.digest(part) for part in weights.parts]
    key = [*digests, repr(weights.model), version("amvnet"), torch.__version__]
    if int8 is not None:
        key.append(f"int8 {int8}")
    name = hashlib.sha256(repr((key, OPSET)).encode()).hexdigest()[:16]

    folder = cache_folder() / "onnx" / name
    if not (folder / DESCRIPTION).is_file():
        calibrated = "" if int8 is None else " and calibrated in int8"
        say(f"the networks are exported{calibrated}, once for these weights; kept in {folder}")
        export(weights, folder, int8=int8)
    return folder


class OnnxGraph(nn.Module):
    """An exported graph with one input (1, C, H, W) and one output; float32, without gradients.

    It computes with as many threads as torch does in the thread that calls it.

    Args:
        path: of the graph's file.
        providers: ONNX Runtime's execution providers, the preferred one first.
    """

    def __init__(self, path: Path, providers: Sequence[str] = PROVIDERS[-1:]) -> None:
        super().__init__()
        self.path = path
        self.providers = providers
        self.sessions: dict[int, Any] = {}  # by number of threads
        self.lock = Lock()
        self.process = os.getpid()
        self.input = self.session().get_inputs()[0].name

    def session(self) -> Any:
        """Return ONNX Runtime's session with the number of threads of the calling thread."""
        threads = torch.get_num_threads()
        with self.lock:
            if threads not in self.sessions:
                self.sessions[threads] = _open_session(self.path, self.providers, threads)
        return self.sessions[threads]

    def forward(self, x: Tensor) -> Tensor:
        # A forked process has none of the runtime's threads, and would wait for them forever.
        if os.getpid() != self.process:
            raise InputError(
                "expected the process that loaded an engine of ONNX Runtime, found one forked "
                "from it; load the weights in the forked process, or use the engine torch"
            )
        if len(x) != 1:
            raise InputError(
                f"expected one scan at a time for this engine, found {len(x)}; use the engine torch"
            )
        inputs = {self.input: x.contiguous().numpy()}
        return torch.from_numpy(self.session().run(None, inputs)[0])


def _open_session(path: Path, providers: Sequence[str], threads: int) -> Any:
    import onnxruntime

    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = threads
    # Threads that wait for the next graph would take the processor from torch's.
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")
    # TensorRT builds its engine in minutes, once.
    cached = {"trt_engine_cache_enable": True, "trt_engine_cache_path": str(path.parent)}
    chosen = [(name, cached if name == PROVIDERS[0] else {}) for name in providers]
    return onnxruntime.InferenceSession(str(path), options, providers=chosen)
