"""AMVNet: LiDAR semantic segmentation by two projections and late fusion.

    segmenter = amvnet.load("sim-hdl64e")
    result = segmenter(points)

Names are imported when they are first used, so that `import amvnet` is fast.
"""

from __future__ import annotations

from importlib import import_module
from importlib.metadata import version
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from amvnet import onnx_runner as onnx_runner
    from amvnet import weights as weights
    from amvnet.data.datasets.simulated import simulate as simulate
    from amvnet.errors import InputError as InputError
    from amvnet.inference.fuse import fuse as fuse
    from amvnet.inference.listing import read as read
    from amvnet.inference.listing import read_all as read_all
    from amvnet.inference.segmentation import Segmentation as Segmentation
    from amvnet.inference.segmenter import Segmenter as Segmenter
    from amvnet.models.methods import MethodName, Precision
    from amvnet.scan import Scan as Scan
    from amvnet.viewing.page import show as show
    from amvnet.weights.file import Weights as Weights
    from amvnet.weights.push import push as push

_MODULES = {
    "InputError": "amvnet.errors",
    "Scan": "amvnet.scan",
    "Segmentation": "amvnet.inference.segmentation",
    "Segmenter": "amvnet.inference.segmenter",
    "Weights": "amvnet.weights.file",
    "fuse": "amvnet.inference.fuse",
    "push": "amvnet.weights.push",
    "read": "amvnet.inference.listing",
    "read_all": "amvnet.inference.listing",
    "show": "amvnet.viewing.page",
    "simulate": "amvnet.data.datasets.simulated",
}
__all__ = ["load", *_MODULES]
__version__ = version("amvnet")

_SUBMODULES = ("onnx_runner", "weights")


def load(
    weights: str,
    device: str = "auto",
    method: MethodName = "amvnet",
    precision: Precision = "auto",
    engine: str = "torch",
    tau: float | None = None,
) -> Segmenter:
    """Return a segmenter with trained weights.

    Args:
        weights: the path of a weights file, the name of built-in weights (`sim-hdl64e`,
            `sim-hdl32e`), or weights on the hub (`hf-hub:OWNER/NAME`).
        device, method, precision, tau: as for `Segmenter`; "auto" chooses a device that the engine
            runs on.
        engine: what runs the networks: "torch", "onnx" or "int8".

    Raises:
        InputError: if there are no such weights, they lack a part that the method needs, or the
            engine lacks a library.
    """
    segmenter_class = import_module("amvnet.inference.segmenter").Segmenter
    choose_device = import_module("amvnet.models.precision").choose_device
    device = choose_device(device, engine)
    segmenter: Segmenter = segmenter_class(
        weights, device=device, method=method, precision=precision, tau=tau
    )
    if engine != "torch":
        import_module("amvnet.export.engines").use_engine(segmenter, engine)
    return segmenter


# Hidden from type checkers, which would take any name for one of the package.
if not TYPE_CHECKING:

    def __getattr__(name: str) -> Any:
        if name in _SUBMODULES:
            return import_module(f"amvnet.{name}")
        if name not in _MODULES:
            raise AttributeError(f"module 'amvnet' has no attribute {name!r}")
        return getattr(import_module(_MODULES[name]), name)


def __dir__() -> list[str]:
    return sorted([*__all__, *_SUBMODULES, "__doc__", "__version__"])
