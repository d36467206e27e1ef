"""AMVNet: LiDAR semantic segmentation by two views and late fusion.

    segmenter = amvnet.load("sim-hdl64e")
    result = segmenter(points)

Names are imported when they are first used, so that `import amvnet` is fast.
"""

from __future__ import annotations

from importlib import import_module
from importlib.metadata import version
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from amvnet.errors import InputError
    from amvnet.inference.fusion import fuse
    from amvnet.inference.segmenter import Segmentation, Segmenter
    from amvnet.scan import Scan
    from amvnet.simulation import simulate
    from amvnet.weights.push import push

__all__ = ["InputError", "Scan", "Segmentation", "Segmenter", "fuse", "load", "push", "simulate"]
__version__ = version("amvnet")

_HOMES = {
    "InputError": "amvnet.errors",
    "Scan": "amvnet.scan",
    "Segmentation": "amvnet.inference.segmenter",
    "Segmenter": "amvnet.inference.segmenter",
    "fuse": "amvnet.inference.fusion",
    "push": "amvnet.weights.push",
    "simulate": "amvnet.simulation",
}


def load(
    weights: str,
    device: str = "cpu",
    method: str = "amvnet",
    precision: str = "float32",
    engine: str = "torch",
) -> Segmenter:
    """A segmenter from a weights file, the name of built-in weights (`sim-hdl64e`), or the hub (`hf-hub:OWNER/NAME`).

    Raises:
        InputError: where there are no such weights, or they lack a part that the method needs, or the engine a library.
    """
    segmenter = import_module("amvnet.inference.segmenter").Segmenter(
        weights, device, method, precision
    )
    if engine != "torch":
        import_module("amvnet.export.engines").use_engine(segmenter, engine)
    return segmenter


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module 'amvnet' has no attribute {name!r}")
    return getattr(import_module(_HOMES[name]), name)
