"""The precision that a network computes in; what goes in and comes out stays float32."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import torch
from torch import Tensor, nn

from amvnet.errors import InputError
from amvnet.models.methods import PRECISIONS, Precision


class InPrecision(nn.Module):
    """A network whose convolutions and matrix products are of a precision; its scores are float32.

    On a GPU float32 means float32: TF32, which PyTorch takes for convolutions by default, is used where
    `torch.set_float32_matmul_precision("high")` was said.
    """

    def __init__(self, net: nn.Module, device: str, precision: Precision) -> None:
        super().__init__()
        self.net, self.precision = net, precision
        self.kind = torch.device(device).type

    def forward(self, view: Any) -> Tensor:
        lower = self.precision != "float32"
        with (
            _tf32_as_asked(),
            torch.autocast(self.kind, getattr(torch, self.precision) if lower else None, lower),
        ):
            return self.net(view).float()


def check_precision(precision: str, device: str) -> None:
    """Raises InputError where there is no such precision, or the device has none."""
    if precision not in PRECISIONS:
        raise InputError(
            f"expected a precision of {', '.join(PRECISIONS)}, found {precision!r}; use one of them"
        )
    if precision == "float16" and torch.device(device).type == "cpu":
        raise InputError("expected float32 or bfloat16 on a CPU, found float16; use bfloat16")


@contextmanager
def _tf32_as_asked() -> Iterator[None]:
    """Let convolutions and recurrent layers use TF32 where matrix products may, and leave the setting as it was."""
    before = torch.backends.cudnn.allow_tf32
    torch.backends.cudnn.allow_tf32 = torch.get_float32_matmul_precision() != "highest"
    try:
        yield
    finally:
        torch.backends.cudnn.allow_tf32 = before
