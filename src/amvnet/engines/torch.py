"""The engine of PyTorch, on a CPU, or on a GPU with two streams, CUDA graphs and a precision.

One launch of a CUDA graph replays the hundreds of kernels of a network.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass
from threading import Lock
from typing import Any

import torch
from torch import Tensor, nn

from amvnet.engines.base import Engine, Network, WithUnet, build_model, side_by_side
from amvnet.engines.compute import Precision
from amvnet.errors import reason_of
from amvnet.models.amvnet import AMVNet, Score, Scores
from amvnet.models.methods import MethodName
from amvnet.models.polar_net import PolarNet
from amvnet.models.views.points import PointBatch
from amvnet.weights.file import Weights

WARM_UP_RUNS = 2  # runs before the capture, in which libraries choose their algorithms
MAX_SHAPES = 8  # largest number of shapes that are captured for a network; each takes memory
# The largest change of a point's probabilities by graphs, as a share of its largest probability.
# The rounding of bfloat16 changes hardly any point by half as much (docs/log.md).
LARGEST_CHANGE = 0.1
LARGEST_SHARE = 0.001  # the largest share of points that may change more


class TorchEngine(Engine):
    """Runs the two networks in PyTorch; `Engine` documents the attributes.

    `amvnet.load` documents the arguments; the device and the precision are `resolved`. With
    `graphs`, the networks are captured as CUDA graphs (`Captured`), once for each number of
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


class GraphCheck:
    """A check that turns off the CUDA graphs of a model if one fails or gives other scores."""

    def __init__(self) -> None:
        self.is_passed = True
        self._is_paused = False
        self._checked: set[int] = set()  # numbers of scans for which a batch has been checked
        self._lock = Lock()

    @property
    def are_graphs_on(self) -> bool:
        """Whether networks replay their graphs."""
        return self.is_passed and not self._is_paused

    def score(self, score: Callable[[PointBatch], Scores], batch: PointBatch) -> Scores:
        """Score a batch; check the graphs on the first batch of each number of scans.

        The check compares the scores with and without graphs; it returns the scores without graphs.
        """
        if not self.is_passed or batch.count in self._checked:
            return score(batch)

        # The first pass captures the graphs.
        with self._lock:
            replayed = score(batch)
            with self._paused():
                expected = score(batch)
            if self.is_passed and not _agree(replayed, expected):
                self.fail("their scores differ from the scores without graphs")
            self._checked.add(batch.count)
        return expected

    def fail(self, reason: str) -> None:
        """Turn the graphs off, with one warning."""
        if not self.is_passed:
            return
        self.is_passed = False
        warnings.warn(
            f"the networks run without CUDA graphs, which is slower: {reason}; graphs=False of "
            "amvnet.load avoids this warning",
            RuntimeWarning,
            stacklevel=2,
        )

    @contextmanager
    def _paused(self) -> Iterator[None]:
        self._is_paused = True
        try:
            yield
        finally:
            self._is_paused = False


@dataclass(frozen=True)
class Graph:
    """A captured network: `replay` computes `output` from the current values of `input`."""

    input: Tensor
    output: Tensor
    replay: Callable[[], None]


class Captured(nn.Module):
    """A network that is captured once for each shape of its input, and replayed from then on.

    The network maps one tensor on a GPU to another. All its shapes must follow from the shape of
    the input, and it must not wait for the GPU. Its kernels are launched one by one if
    `check` has turned graphs off, if gradients are computed, and for shapes after the first
    `MAX_SHAPES`.
    Several threads may call it.
    """

    def __init__(self, net: Network, check: GraphCheck) -> None:
        super().__init__()
        self.net = net
        self.check = check
        # Graphs by the properties of an input that the kernels depend on.
        self._graphs: dict[Any, Graph] = {}
        self._pool: Any = None  # the pool of memory that all graphs of the network share
        self._lock = Lock()

    def forward(self, x: Tensor) -> Tensor:
        if torch.is_grad_enabled() or not self.check.are_graphs_on:
            return self.net(x)

        with self._lock:
            graph = self._graph_for(x)
            if graph is None:
                return self.net(x)
            graph.input.copy_(x)
            graph.replay()
            # The next replay overwrites the output.
            return graph.output.clone()

    def _graph_for(self, x: Tensor) -> Graph | None:
        """Return the graph for inputs like x; None if it cannot be captured."""
        precision = torch.get_float32_matmul_precision()
        key = (x.shape, x.stride(), x.dtype, torch.is_inference_mode_enabled(), precision)
        if key in self._graphs:
            return self._graphs[key]
        if len(self._graphs) == MAX_SHAPES:
            return None

        try:
            self._graphs[key] = self._capture(x)
        except RuntimeError as error:  # such as too little memory
            self.check.fail(f"a network could not be captured ({reason_of(error)})")
        return self._graphs.get(key)

    def _capture(self, x: Tensor) -> Graph:
        # Capture on zeros: the check then notices a replay that does not read its input.
        static = torch.zeros_like(x)  # keeps the strides

        # CUDA requires that the runs before the capture use another stream than the current one.
        current = torch.cuda.current_stream(x.device)
        side = torch.cuda.Stream(x.device)
        side.wait_stream(current)
        with torch.cuda.stream(side):
            for _ in range(WARM_UP_RUNS):
                self.net(static)
        current.wait_stream(side)

        if self._pool is None:
            self._pool = torch.cuda.graph_pool_handle()
        graph = torch.cuda.CUDAGraph()
        # Other threads may use the GPU during the capture: one reads scans into pinned memory.
        with torch.cuda.graph(graph, pool=self._pool, capture_error_mode="thread_local"):
            output = self.net(static)
        return Graph(static, output, graph.replay)


def _agree(replayed: Scores, expected: Scores) -> bool:
    """Return whether the probabilities of both networks agree, up to rounding."""
    for f, g in ((replayed.rv, expected.rv), (replayed.bev, expected.bev)):
        if f is None or g is None:
            continue
        change = (f - g).abs().amax(dim=1)
        is_close = change <= LARGEST_CHANGE * g.amax(dim=1)  # False for NaN
        if float((~is_close).float().mean()) > LARGEST_SHARE:
            return False
    return True


class TwoStreams:
    """Runs the range-view network on a second stream of a GPU while the other network runs."""

    def __init__(self, device: str | torch.device) -> None:
        self.device = torch.device(device)
        self.side = torch.cuda.Stream(self.device)

    def __call__(self, score_range: Score, score_polar: Score) -> tuple[Tensor, Tensor]:
        current = torch.cuda.current_stream(self.device)

        self.side.wait_stream(current)  # the projected points must be there
        with torch.cuda.stream(self.side):
            f = score_range()
        g = score_polar()

        # What follows waits for f. It also reuses the memory of the inputs after both networks.
        current.wait_stream(self.side)
        # The memory of f belongs to the side stream, which must not reuse it too early.
        f.record_stream(current)
        return f, g


class InPrecision(nn.Module):
    """A network that computes convolutions and matrix products in a precision; scores are float32.

    On a GPU, "float32" does not include TF32, which PyTorch by default uses for convolutions. TF32
    is used only after `torch.set_float32_matmul_precision("high")`.
    """

    def __init__(self, net: nn.Module, device: str, precision: Precision) -> None:
        super().__init__()
        self.net = net
        self.precision = precision
        self.kind = torch.device(device).type

    def forward(self, view: Any) -> Tensor:
        is_lower = self.precision != "float32"
        dtype = getattr(torch, self.precision) if is_lower else None
        # The setting belongs to the whole process. It does not matter on a CPU, where several
        # threads would restore it in the wrong order.
        tf32 = _tf32_as_set() if self.kind == "cuda" else nullcontext()
        # Autocast must not keep converted weights: a CUDA graph would use weights that were
        # converted before its capture. Each weight is used once, so nothing is lost.
        with tf32, torch.autocast(self.kind, dtype, enabled=is_lower, cache_enabled=False):
            scores: Tensor = self.net(view)
            return scores.float()


@contextmanager
def _tf32_as_set() -> Iterator[None]:
    """Let convolutions and recurrent layers use TF32 only if matrix products may."""
    before = torch.backends.cudnn.allow_tf32
    torch.backends.cudnn.allow_tf32 = torch.get_float32_matmul_precision() != "highest"
    try:
        yield
    finally:
        torch.backends.cudnn.allow_tf32 = before
