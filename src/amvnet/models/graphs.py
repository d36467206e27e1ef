"""Networks captured as CUDA graphs: one launch replays hundreds of kernels."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import dataclass
from threading import Lock
from typing import Any

import torch
from torch import Tensor, nn

from amvnet.errors import reason_of

WARM_UP = 2  # runs before the capture, in which libraries choose their algorithms
MOST_SHAPES = 8  # that are captured for a network; its memory grows with each

Network = Callable[[Tensor], Tensor]


@dataclass(frozen=True)
class Graph:
    """A captured network: `replay` computes `output` from what `input` holds at that time."""

    input: Tensor
    output: Tensor
    replay: Callable[[], None]


class Captured(nn.Module):
    """A network that is captured once for each shape of its input, and replayed from then on.

    The network maps one tensor on a GPU to another. Its shapes must follow from the shape of the
    input, and it must not wait for the GPU. If it cannot be captured, a warning says so once, and
    its kernels are launched one by one from then on. This also happens, without a warning, with
    gradients and for shapes beyond the first `MOST_SHAPES`. Several threads may call it.
    """

    def __init__(self, net: Network) -> None:
        super().__init__()
        self.net = net
        self._graphs: dict[Any, Graph] = {}  # by what the kernels depend on
        self._pool: Any = None  # of memory, which all graphs of the network share
        self._can_capture = True
        self._lock = Lock()

    def forward(self, x: Tensor) -> Tensor:
        if torch.is_grad_enabled():
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
        """Return the graph for inputs like x, captured if necessary; None if there can be none."""
        precision = torch.get_float32_matmul_precision()
        key = (x.shape, x.stride(), x.dtype, torch.is_inference_mode_enabled(), precision)
        if key in self._graphs:
            return self._graphs[key]
        if not self._can_capture or len(self._graphs) == MOST_SHAPES:
            return None

        try:
            self._graphs[key] = self._capture(x)
        except RuntimeError as error:  # also if the memory does not suffice
            self._can_capture = False
            warnings.warn(
                f"a network could not be captured as a CUDA graph ({reason_of(error)}); its "
                "kernels are launched one by one, which is slower; graphs=False avoids this "
                "warning",
                RuntimeWarning,
                stacklevel=2,
            )
        return self._graphs.get(key)

    def _capture(self, x: Tensor) -> Graph:
        static = torch.empty_like(x)  # keeps the strides
        static.copy_(x)

        # CUDA wants the runs that warm up on another stream than the current one.
        current = torch.cuda.current_stream(x.device)
        side = torch.cuda.Stream(x.device)
        side.wait_stream(current)
        with torch.cuda.stream(side):
            for _ in range(WARM_UP):
                self.net(static)
        current.wait_stream(side)

        if self._pool is None:
            self._pool = torch.cuda.graph_pool_handle()
        graph = torch.cuda.CUDAGraph()
        # Other threads may go on using the GPU, such as one that reads scans into pinned memory.
        with torch.cuda.graph(graph, pool=self._pool, capture_error_mode="thread_local"):
            output = self.net(static)
        return Graph(static, output, graph.replay)
