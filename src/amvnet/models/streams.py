"""In what order the two networks run: one after the other, or side by side on a GPU's streams."""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

import torch
from torch import Tensor

from amvnet.models.views.points import PointBatch

Score = Callable[[PointBatch], Tensor]


class Arrangement(Protocol):
    """Runs two scorers of a batch, and hands back what both found, in their order."""

    def __call__(self, first: Score, second: Score, batch: PointBatch) -> tuple[Tensor, Tensor]: ...


def in_turn(first: Score, second: Score, batch: PointBatch) -> tuple[Tensor, Tensor]:
    """One after the other."""
    return first(batch), second(batch)


class SideBySide:
    """The first on a stream of its own, the second meanwhile on the current one.

    The second is the one that may wait for its own stream (the bird's-eye view counts the pillars with points): the
    first has been handed to the GPU by then.

    Args:
        device: a CUDA device.
    """

    def __init__(self, device: str | torch.device) -> None:
        self.device = torch.device(device)
        self.side = torch.cuda.Stream(self.device)

    def __call__(self, first: Score, second: Score, batch: PointBatch) -> tuple[Tensor, Tensor]:
        here = torch.cuda.current_stream(self.device)
        self.side.wait_stream(here)  # until the points are there
        with torch.cuda.stream(self.side):
            f = first(batch)
        g = second(batch)
        here.wait_stream(
            self.side
        )  # from here on, so that the points' memory is free for others only after both
        f.record_stream(
            here
        )  # its memory is of the other stream, which must not use it again before this one is done
        return f, g
