"""The base class of the engines, which run the two networks for a segmenter."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor, nn

from amvnet.engines.compute import Precision
from amvnet.models.amvnet import AMVNet, Score, Scores
from amvnet.models.assertion import Disagreement
from amvnet.models.layers import freeze
from amvnet.models.methods import METHODS, MethodName, check_method
from amvnet.models.polar_net import PolarNet
from amvnet.models.views.points import PointBatch
from amvnet.models.views.polar_view import PolarGrid
from amvnet.models.voting import vote
from amvnet.runtime.memory import available_memory
from amvnet.runtime.threads import run_parts, survive_forks
from amvnet.weights.file import Weights

# The memory budget per scan, bytes. A scan of 120,000 points takes half of it in networks of the
# paper's size.
SCAN_BYTES = 2**30

Network = Callable[[Tensor], Tensor]


class Engine:
    """Scores the points of scans by a method.

    Torch projects the points and fuses the scores. A derived class decides what runs the two
    networks, and builds a model with these networks.

    Args and attributes:
        name: "torch", "onnx" or "int8".
        method: how the points are scored, one of `METHODS`.
        tau: the threshold of the assertion, in [0, 1]; None if it is the threshold of the weights.
        device: the device that holds the points: "cpu", "cuda", "cuda:1", ...

    Attributes:
        at_once: the number of scans to segment at the same time, each with its share of torch's
            threads. On a CPU, by default one scan for each thread, or as many as the memory
            suffices for; on a GPU 1.
    """

    def __init__(
        self,
        name: str,
        model: AMVNet,
        method: MethodName = "amvnet",
        *,
        tau: float | None = None,
        device: str = "cpu",
        precision: Precision = "float32",
    ) -> None:
        self.name = name
        self.model = model
        self.method = method
        self.tau = tau
        self.device = device
        self.precision = precision
        self.at_once = 1
        if device == "cpu":
            self.at_once = max(min(torch.get_num_threads(), available_memory() // SCAN_BYTES), 1)
        survive_forks()

    @property
    def hardware(self) -> str:
        """The device in words."""
        return self.device

    @torch.inference_mode()
    def score(self, batch: PointBatch) -> Scores:
        """Return the scores of the points of a batch, which is on the device of the engine."""
        model = self.model
        if METHODS[self.method].has_two_networks:
            scores: Scores = model(batch)
            return scores
        if self.method == "bev":
            g = model.score_polar(model.polar_view.project(batch))
            return Scores(g, _none_uncertain(g), rv=None, bev=g)

        image = model.range_view.project(batch)
        f = model.score_range(image)
        y = vote(f, batch, image) if self.method == "rv-knn" else f
        return Scores(y, _none_uncertain(y), rv=f, bev=None)


class WithUnet(nn.Module):
    """PolarNet whose U-Net, which has most of the work, is run by something other than torch."""

    def __init__(self, net: PolarNet, unet: Network) -> None:
        super().__init__()
        self.net = net
        self.unet = unet

    def forward(self, grid: PolarGrid) -> Tensor:
        return self.net.decode(grid, self.unet(self.net.encode(grid)))


def build_model(
    weights: Weights, method: MethodName, tau: float | None = None, device: str = "cpu"
) -> AMVNet:
    """Return AMVNet with trained weights, set up for a method; it cannot be trained.

    Args:
        tau: the threshold of the assertion, in [0, 1]; by default the threshold of the weights.

    Raises:
        InputError: if the weights lack a part that the method needs, there is no such method, or
            tau is out of range.
    """
    check_method(method, weights.parts)
    model = weights.build().to(device)
    model.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
    freeze(model)

    if tau is not None:
        model.assertion = Disagreement(tau)
    ensemble = METHODS[method].ensemble
    if ensemble is not None:
        model.ensemble = ensemble
        model.point_head = None
    return model


def side_by_side(score_range: Score, score_polar: Score) -> tuple[Tensor, Tensor]:
    """Run both networks at the same time if threads of the CPU are idle, else in turn."""
    f, g = run_parts(lambda score: score(), (score_range, score_polar))
    return f, g


def _none_uncertain(scores: Tensor) -> Tensor:
    """Return (P,) bool, all False: a single network has no uncertain points."""
    return torch.zeros(len(scores), dtype=torch.bool, device=scores.device)
