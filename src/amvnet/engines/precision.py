"""Where a network computes, and in which precision; its inputs and outputs stay float32."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from typing import Any

import torch
from torch import Tensor, nn

from amvnet.errors import InputError
from amvnet.models.methods import ONNX_ENGINES, PRECISIONS, Precision


class InPrecision(nn.Module):
    """A network whose convolutions and matrix products have a precision; its scores are float32.

    On a GPU, float32 means float32: TF32, which PyTorch uses for convolutions by default, is used
    only after `torch.set_float32_matmul_precision("high")`.
    """

    def __init__(self, net: nn.Module, device: str, precision: Precision) -> None:
        super().__init__()
        self.net = net
        self.precision = precision
        self.kind = torch.device(device).type

    def forward(self, view: Any) -> Tensor:
        is_lower = self.precision != "float32"
        dtype = getattr(torch, self.precision) if is_lower else None
        # Of the whole process: on a CPU, several threads would set it back in the wrong order.
        tf32 = _tf32_as_set() if self.kind == "cuda" else nullcontext()
        # A graph must not use weights that autocast has converted and kept before its capture.
        # Each weight is used once, so that keeping them would save nothing.
        with tf32, torch.autocast(self.kind, dtype, enabled=is_lower, cache_enabled=False):
            return self.net(view).float()


def choose_device(name: str, engine: str = "torch") -> str:
    """Return the name of a device; for "auto" that is `cuda` if there is one, else `cpu`.

    An engine of ONNX Runtime computes on the CPU.
    """
    if name != "auto":
        return name
    return "cuda" if torch.cuda.is_available() and engine not in ONNX_ENGINES else "cpu"


def check_device(name: str) -> str:
    """Return the name, if it is that of a device of this machine; else raise InputError."""
    try:
        torch.zeros(1, device=name).item()
    except (RuntimeError, AssertionError, NotImplementedError):
        raise InputError(f"expected a device of this machine, found {name!r}; use cpu") from None
    return name


def choose_precision(precision: Precision, device: str) -> Precision:
    """Return the precision; for "auto", bfloat16 on a GPU that has it, else float32.

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


@contextmanager
def _tf32_as_set() -> Iterator[None]:
    """Let convolutions and recurrent layers use TF32 only if matrix products may."""
    before = torch.backends.cudnn.allow_tf32
    torch.backends.cudnn.allow_tf32 = torch.get_float32_matmul_precision() != "highest"
    try:
        yield
    finally:
        torch.backends.cudnn.allow_tf32 = before
