"""Where and how the networks are computed: the choices, and what "auto" is on this machine.

torch is imported on first use, for a quick command line.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal, get_args

from amvnet.config.bounds import Count
from amvnet.errors import InputError

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


def choose_device(name: str, engine: str = "torch") -> str:
    """Return the name of a device; "auto" becomes "cuda" if there is a GPU, else "cpu".

    For an engine of ONNX Runtime, "auto" becomes "cpu".
    """
    import torch

    if name != "auto":
        return name
    return "cuda" if torch.cuda.is_available() and engine not in ONNX_ENGINES else "cpu"


def check_device(name: str) -> str:
    """Return the name of a device; raise InputError if this machine has no such device."""
    import torch

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
    import torch

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
