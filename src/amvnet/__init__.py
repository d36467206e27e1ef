"""Label each point of a LiDAR scan: road, car, person, ...

Load a segmenter, call it, and save or show the result:

    import amvnet

    segmenter = amvnet.load()       # or one of amvnet.list_weights(), or a file of weights
    result = segmenter("scan.pcd")  # or an array (N, 4): x, y, z, intensity in [0, 1]
    result.save("scan.ply")         # or .pcd, .las, .laz, .npy, .label
    amvnet.show(result)             # in 3D, in the browser

A result has, in the order of the points:

    result.labels, result.class_names      # ids (N,), and the name of each id
    result.points, result.uncertain        # x, y, z (N, 3); where the two networks disagree (N,)
    result.counts()                        # {"road": 65510, "car": 3298, ...}
    result.mask("car", "truck")            # which points are one of these (N,)
    result.verdict                         # whether the labels can be relied on

Many scans: `segmenter.each("folder")`. Scans in memory: `amvnet.read`, `amvnet.read_all`. A drive:
`amvnet.drive`. The scores of two other models: `amvnet.fuse`. Scans to try: `amvnet.simulate`.

Bad input raises `amvnet.InputError` with one line: what was expected, what was found, what to do.
"""

from __future__ import annotations

import os
from importlib import import_module
from importlib.metadata import version
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from amvnet import onnx_runner as onnx_runner
    from amvnet import weights as weights
    from amvnet.data.datasets.simulated import simulate as simulate
    from amvnet.errors import InputError as InputError
    from amvnet.inference.drive import drive as drive
    from amvnet.inference.fuse import fuse as fuse
    from amvnet.inference.listing import read as read
    from amvnet.inference.listing import read_all as read_all
    from amvnet.inference.loading import load as load
    from amvnet.inference.segmentation import Segmentation as Segmentation
    from amvnet.inference.segmenter import Segmenter as Segmenter
    from amvnet.scan import Scan as Scan
    from amvnet.viewing.page import show as show
    from amvnet.weights.file import Weights as Weights
    from amvnet.weights.file import list_weights as list_weights
    from amvnet.weights.push import push as push

# The modules of the names, which are imported when they are first used: `import amvnet` is fast.
_MODULES = {
    "Scan": "amvnet.scan",
    "Segmentation": "amvnet.inference.segmentation",
    "Segmenter": "amvnet.inference.segmenter",
    "Weights": "amvnet.weights.file",
    "drive": "amvnet.inference.drive",
    "fuse": "amvnet.inference.fuse",
    "list_weights": "amvnet.weights.file",
    "load": "amvnet.inference.loading",
    "push": "amvnet.weights.push",
    "read": "amvnet.inference.listing",
    "read_all": "amvnet.inference.listing",
    "show": "amvnet.viewing.page",
    "simulate": "amvnet.data.datasets.simulated",
    "InputError": "amvnet.errors",
}
__all__ = list(_MODULES)
__version__ = version("amvnet")

_SUBMODULES = ("onnx_runner", "weights")

# ONNX Runtime from 1.29 on would report the graphs that it runs to Microsoft. It reads this
# variable when it is imported.
os.environ.setdefault("ORT_DISABLE_TELEMETRY", "1")


# Hide this function from type checkers, which would otherwise accept any name of the package.
if not TYPE_CHECKING:

    def __getattr__(name: str) -> Any:
        if name in _SUBMODULES:
            return import_module(f"amvnet.{name}")
        if name not in _MODULES:
            raise AttributeError(f"module 'amvnet' has no attribute {name!r}")
        return getattr(import_module(_MODULES[name]), name)


def __dir__() -> list[str]:
    return sorted([*__all__, *_SUBMODULES, "__doc__", "__version__"])
