"""Capture networks as CUDA graphs: one launch then replays hundreds of kernels."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from threading import Lock
from typing import Any

import torch
from torch import Tensor, nn

from amvnet.engines.base import Network
from amvnet.errors import reason_of
from amvnet.models.amvnet import Scores
from amvnet.models.views.points import PointBatch

WARM_UP_RUNS = 2  # runs before the capture, in which libraries choose their algorithms
MAX_SHAPES = 8  # largest number of shapes that are captured for a network; each takes memory
# The largest change of a point's probabilities by graphs, as a share of its largest probability.
# The rounding of bfloat16 changes hardly any point by half as much (docs/log.md).
LARGEST_CHANGE = 0.1
LARGEST_SHARE = 0.001  # the largest share of points that may change more


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
