"""The engine of PyTorch, on a CPU, or on a GPU with two streams, CUDA graphs and a precision."""

from __future__ import annotations

import torch
from torch import nn

from amvnet.engines.base import Engine, WithUnet, build_model
from amvnet.engines.compute import Precision
from amvnet.engines.graphs import Captured, GraphCheck
from amvnet.engines.precision import InPrecision
from amvnet.engines.streams import TwoStreams, side_by_side
from amvnet.models.amvnet import AMVNet, Scores
from amvnet.models.methods import MethodName
from amvnet.models.polar_net import PolarNet
from amvnet.models.views.points import PointBatch
from amvnet.weights.file import Weights


class TorchEngine(Engine):
    """Runs the two networks in PyTorch; `Engine` documents the attributes.

    `amvnet.load` documents the arguments; the device and the precision are `resolved`. With
    `graphs`, the networks are captured as CUDA graphs (`engines.graphs`), once for each number of
    scans in a batch.

    Raises:
        InputError: as `build_model`.
    """

    def __init__(
        self,
        weights: Weights,
        method: MethodName = "amvnet",
        tau: float | None = None,
        *,
        device: str = "cpu",
        precision: Precision = "float32",
        graphs: bool = True,
    ) -> None:
        model = build_model(weights, method, tau, device)

        if is_gpu(device):
            model.arrange = TwoStreams(device)
        elif device == "cpu":
            model.arrange = side_by_side

        self._graphs = _capture(model) if is_gpu(device) and graphs else None
        if is_gpu(device) or precision != "float32":
            model.range_net = InPrecision(model.range_net, device, precision)
            model.polar_net = InPrecision(model.polar_net, device, precision)
        super().__init__("torch", model, method, tau=tau, device=device, precision=precision)

    @property
    def hardware(self) -> str:
        """The device in words, with the name of a GPU."""
        if not is_gpu(self.device):
            return self.device
        return f"{self.device} ({torch.cuda.get_device_name(self.device)})"

    def score(self, batch: PointBatch) -> Scores:
        """Return the scores of a batch; the first batch of each size also tests the CUDA graphs."""
        if self._graphs is None:
            return super().score(batch)
        return self._graphs.score(super().score, batch)


def is_gpu(device: str) -> bool:
    """Return whether a device is a GPU."""
    return torch.device(device).type == "cuda"


def _capture(model: AMVNet) -> GraphCheck:
    """Let a model replay its networks as CUDA graphs; return the check that can turn them off."""
    check = GraphCheck()
    polar_net: nn.Module = model.polar_net
    assert isinstance(polar_net, PolarNet)
    model.range_net = Captured(model.range_net, check)
    model.polar_net = WithUnet(polar_net, Captured(polar_net.unet, check))
    return check
