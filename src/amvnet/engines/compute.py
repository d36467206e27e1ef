"""Define where and how the networks are computed; without torch, for a quick command line."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, get_args

from amvnet.config.bounds import Count

# The floating-point type in which the two networks are computed.
Precision = Literal["auto", "float32", "bfloat16", "float16"]
EngineName = Literal["torch", "onnx", "int8"]  # name of the engine that runs the two networks


@dataclass(frozen=True)
class Compute:
    """Where and how the networks are computed."""

    device: str = "auto"
    """device of the networks: cpu, cuda, cuda:1, ..., or auto: cuda if there is a GPU."""
    engine: EngineName = "torch"
    """what runs the networks: torch, onnx (ONNX Runtime), or int8 (ONNX Runtime in 8-bit integers,
    calibrated once; a few labels change)."""
    precision: Precision = "auto"
    """precision of the networks; auto: bfloat16 on a GPU, float32 on a CPU; float16 needs a GPU."""
    at_once: Count | None = None
    """number of scans segmented at the same time on a CPU; default: one per core, fewer if the
    memory does not suffice."""


ONNX_ENGINES = frozenset({"onnx", "int8"})  # engines that run ONNX Runtime
PRECISIONS: tuple[Precision, ...] = get_args(Precision)
