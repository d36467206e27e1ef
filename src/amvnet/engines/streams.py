"""Run the two networks at the same time, on the threads of a CPU or the streams of a GPU."""

from __future__ import annotations

import torch
from torch import Tensor

from amvnet.models.amvnet import Score
from amvnet.runtime.threads import run_parts


def side_by_side(score_range: Score, score_polar: Score) -> tuple[Tensor, Tensor]:
    """Run both networks at the same time if threads of the CPU are idle, else in turn."""
    f, g = run_parts(lambda score: score(), (score_range, score_polar))
    return f, g


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
