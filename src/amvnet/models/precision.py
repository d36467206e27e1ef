"""The precision that a network computes in; its inputs and outputs stay float32."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from typing import Any

import torch
from torch import Tensor, nn

from amvnet.errors import InputError
from amvnet.models.methods import PRECISIONS, Precision


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
        with tf32, torch.autocast(self.kind, dtype, enabled=is_lower):
            return self.net(view).float()


def check_precision(precision: str, device: str) -> None:
    """Raise InputError if there is no such precision, or the device does not have it."""
    if precision not in PRECISIONS:
        raise InputError(
            f"expected a precision of {', '.join(PRECISIONS)}, found {precision!r}; use one of them"
        )
    if precision == "float16" and torch.device(device).type == "cpu":
        raise InputError("expected float32 or bfloat16 on a CPU, found float16; use bfloat16")


@contextmanager
def _tf32_as_set() -> Iterator[None]:
    """Let convolutions and recurrent layers use TF32 only if matrix products may."""
    before = torch.backends.cudnn.allow_tf32
    torch.backends.cudnn.allow_tf32 = torch.get_float32_matmul_precision() != "highest"
    try:
        yield
    finally:
        torch.backends.cudnn.allow_tf32 = before
