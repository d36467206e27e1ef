"""The engine of ONNX Runtime, with graphs in float32 or in 8-bit integers."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from threading import Lock
from typing import Any

import torch
from torch import Tensor, nn

from amvnet.engines.base import Engine, WithUnet, build_model, side_by_side
from amvnet.errors import InputError
from amvnet.models.methods import METHODS, MethodName
from amvnet.models.polar_net import PolarNet
from amvnet.weights.file import Weights

# ONNX Runtime's execution providers, the fastest first.
TENSORRT = "TensorrtExecutionProvider"
PROVIDERS = (TENSORRT, "CUDAExecutionProvider", "CPUExecutionProvider")
RANGE_NET = "range_net"  # the graph of the range-view network
UNET = "polar_map"  # the graph of the U-Net in the bird's-eye-view network


@dataclass(frozen=True)
class ExportedNetworks:
    """The graphs of both networks, as `amvnet export` writes them.

    Attributes:
        files: the contents of the graphs' files, by name: `RANGE_NET`, `UNET`, or both.
        folder: the folder that keeps the files; None if they are not kept.
    """

    files: Mapping[str, bytes]
    folder: Path | None = None


class OnnxEngine(Engine):
    """Runs the two networks in ONNX Runtime, scan by scan; `Engine` documents the attributes.

    It computes on a GPU if the installed ONNX Runtime can. GPUs cannot run graphs in int8, whose
    activations are unsigned.

    Raises:
        InputError: if the weights lack a part that the method needs, there is no such method, or
            tau is out of range.
    """

    def __init__(
        self,
        weights: Weights,
        networks: ExportedNetworks,
        method: MethodName = "amvnet",
        tau: float | None = None,
        *,
        int8: bool = False,
    ) -> None:
        import onnxruntime

        model = build_model(weights, method, tau)
        model.arrange = side_by_side
        installed = onnxruntime.get_available_providers()
        able = PROVIDERS[-1:] if int8 else PROVIDERS
        self.providers = [name for name in able if name in installed]

        parts = METHODS[method].parts
        if "range_net" in parts:
            model.range_net = OnnxGraph(networks.files[RANGE_NET], self.providers, networks.folder)
        if "polar_net" in parts:
            polar_net: nn.Module = model.polar_net
            assert isinstance(polar_net, PolarNet)
            unet = OnnxGraph(networks.files[UNET], self.providers, networks.folder)
            model.polar_net = WithUnet(polar_net, unet)
        super().__init__("int8" if int8 else "onnx", model, method, tau=tau)

    @property
    def hardware(self) -> str:
        """The device in words, with the provider that runs the networks if it is not the CPU's."""
        if len(self.providers) == 1:
            return self.device
        return f"{self.device} and {self.providers[0]} of ONNX Runtime"


class OnnxGraph(nn.Module):
    """An exported graph with one input (1, C, H, W) and one output, in float32, without gradients.

    It computes with as many threads as torch would use in the calling thread.

    Args:
        cache: the folder in which TensorRT keeps what it builds; without it, nothing is kept.
    """

    def __init__(
        self, content: bytes, providers: Sequence[str] = PROVIDERS[-1:], cache: Path | None = None
    ) -> None:
        super().__init__()
        self.content = content
        self.providers = [(name, _provider_options(name, cache)) for name in providers]
        self.sessions: dict[int, Any] = {}  # by number of threads
        self.lock = Lock()
        self.process = os.getpid()
        self.input = self.session().get_inputs()[0].name

    def session(self) -> Any:
        """Return the session of ONNX Runtime that has as many threads as the calling thread."""
        threads = torch.get_num_threads()
        with self.lock:
            if threads not in self.sessions:
                self.sessions[threads] = self._open_session(threads)
        return self.sessions[threads]

    def _open_session(self, threads: int) -> Any:
        import onnxruntime

        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = threads
        # Threads that wait for the next graph would take the processor from torch's threads.
        options.add_session_config_entry("session.intra_op.allow_spinning", "0")
        return onnxruntime.InferenceSession(self.content, options, providers=self.providers)

    def forward(self, x: Tensor) -> Tensor:
        # A forked process has no threads of the runtime, and would wait for them forever.
        if os.getpid() != self.process:
            raise InputError(
                "expected the process that loaded an engine of ONNX Runtime, found a forked copy "
                "of it; load the weights in the forked process, or use the engine torch"
            )
        if len(x) != 1:
            raise InputError(
                f"expected one scan at a time for this engine, found {len(x)}; use the engine torch"
            )
        inputs = {self.input: x.contiguous().numpy()}
        return torch.from_numpy(self.session().run(None, inputs)[0])


def _provider_options(name: str, cache: Path | None) -> dict[str, Any]:
    """Return a provider's options. TensorRT builds its engine in minutes, and keeps it."""
    if name != TENSORRT or cache is None:
        return {}
    return {"trt_engine_cache_enable": True, "trt_engine_cache_path": str(cache)}
