"""Read, write and share weights: weights files, the hub and model cards.

`load` and `Weights` are imported on first use, so that importing this package is fast.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from amvnet.weights.file import Weights, load

__all__ = ["Weights", "load"]


def __getattr__(name: str) -> Any:
    if name not in __all__:
        raise AttributeError(f"module 'amvnet.weights' has no attribute {name!r}")
    return getattr(import_module("amvnet.weights.file"), name)
