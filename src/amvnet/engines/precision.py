"""Choose the device and the precision of a network; its inputs and outputs stay float32."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from dataclasses import replace
from typing import Any, get_args

import torch
from torch import Tensor, nn

from amvnet.engines.compute import ONNX_ENGINES, PRECISIONS, Compute, EngineName, Precision
from amvnet.errors import InputError


class InPrecision(nn.Module):
    """A network that computes convolutions and matrix products in a precision; scores are float32.

    On a GPU, "float32" does not include TF32, which PyTorch by default uses for convolutions. TF32
    is used only after `torch.set_float32_matmul_precision("high")`.
    """

    def __init__(self, net: nn.Module, device: str, precision: Precision) -> None:
        super().__init__()
        self.net = net
        self.precision = precision
        self.kind = torch.device(device).type

    def forward(self, view: Any) -> Tensor:
        is_lower = self.precision != "float32"
        dtype = getattr(torch, self.precision) if is_lower else None
        # The setting belongs to the whole process. It does not matter on a CPU, where several
        # threads would restore it in the wrong order.
        tf32 = _tf32_as_set() if self.kind == "cuda" else nullcontext()
        # Autocast must not keep converted weights: a CUDA graph would use weights that were
        # converted before its capture. Each weight is used once, so nothing is lost.
        with tf32, torch.autocast(self.kind, dtype, enabled=is_lower, cache_enabled=False):
            scores: Tensor = self.net(view)
            return scores.float()


def choose_device(name: str, engine: str = "torch") -> str:
    """Return the name of a device; "auto" becomes "cuda" if there is a GPU, else "cpu".

    For an engine of ONNX Runtime, "auto" becomes "cpu".
    """
    if name != "auto":
        return name
    return "cuda" if torch.cuda.is_available() and engine not in ONNX_ENGINES else "cpu"


def check_device(name: str) -> str:
    """Return the name of a device; raise InputError if this machine has no such device."""
    try:
        torch.zeros(1, device=name).item()
    except (RuntimeError, AssertionError, NotImplementedError):
        raise InputError(f"expected a device of this machine, found {name!r}; use cpu") from None
    return name


def choose_precision(precision: Precision, device: str) -> Precision:
    """Return a precision; "auto" becomes "bfloat16" on a GPU that has it, else "float32".

    Raises:
        InputError: if there is no such precision, or the device does not have it.
    """
    if precision not in PRECISIONS:
        raise InputError(
            f"expected a precision of {', '.join(PRECISIONS)}, found {precision!r}; use one of them"
        )
    kind = torch.device(device).type
    if precision == "float16" and kind == "cpu":
        raise InputError("expected float32 or bfloat16 on a CPU, found float16; use bfloat16")

    if precision != "auto":
        return precision
    has_bfloat16 = kind == "cuda" and torch.cuda.is_bf16_supported(including_emulation=False)
    return "bfloat16" if has_bfloat16 else "float32"


def resolved(compute: Compute) -> Compute:
    """Return where and how the networks are computed on this machine, without "auto".

    Raises:
        InputError: if there is no such engine, device or precision, or the engine does not have the
            device or the precision.
    """
    engine = compute.engine
    engines = get_args(EngineName)
    if engine not in engines:
        raise InputError(
            f"expected an engine of {', '.join(engines)}, found {engine!r}; use one of them"
        )
    device = check_device(choose_device(compute.device, engine))
    precision = choose_precision(compute.precision, device)
    if engine in ONNX_ENGINES and (device, precision) != ("cpu", "float32"):
        raise InputError(
            f"expected float32 on cpu for the engine {engine}, found {precision} on {device}; "
            "use torch"
        )
    return replace(compute, device=device, precision=precision)


@contextmanager
def _tf32_as_set() -> Iterator[None]:
    """Let convolutions and recurrent layers use TF32 only if matrix products may."""
    before = torch.backends.cudnn.allow_tf32
    torch.backends.cudnn.allow_tf32 = torch.get_float32_matmul_precision() != "highest"
    try:
        yield
    finally:
        torch.backends.cudnn.allow_tf32 = before
