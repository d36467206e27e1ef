"""The precision of a training's forward and backward passes."""

from __future__ import annotations

from typing import Final, Literal

import torch

from amvnet.config.schema import TrainingConfig
from amvnet.distributed import device_of

Precision = Literal["32-true", "bf16-mixed", "16-mixed", "64-true"]

SINGLE: Final = "32-true"
DOUBLE: Final = "64-true"
MIXED: Final = "bf16-mixed"


def precision_of(training: TrainingConfig) -> Precision:
    """Return the precision of a training, as Lightning names it.

    `auto` is bf16-mixed on a device with bfloat16 arithmetic and 32-true on others, which only
    emulate it, several times slower.

    Raises:
        InputError: if this machine does not have the training's accelerator.
    """
    if training.precision != "auto":
        return training.precision
    return MIXED if _multiplies_bfloat16(device_of(training.accelerator)) else SINGLE


def _multiplies_bfloat16(device: str) -> bool:
    if device == "cuda":
        return torch.cuda.is_bf16_supported(including_emulation=False)
    if device == "cpu" and hasattr(torch.cpu, "get_capabilities"):  # newer than torch 2.6
        capabilities = torch.cpu.get_capabilities()
        return bool(capabilities.get("avx512_bf16") or capabilities.get("amx_bf16"))
    return False
