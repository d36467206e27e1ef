"""Time per stage of the way from a scan's file to its labels, on this machine."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from statistics import median

import torch

from amvnet.errors import InputError
from amvnet.models.amvnet import merge, settle
from amvnet.models.point_head import nearest_neighbours
from amvnet.scan import Scan
from amvnet.segmenter import Segmenter
from amvnet.views.points import PointBatch

STAGES = ("read", "project", "RV", "BEV", "compare", "neighbours", "head", "merge")
FUSION = ("compare", "neighbours", "head", "merge")


@dataclass(frozen=True)
class Timing:
    """Median seconds of each stage for one scan, how many points it has, and how many of them are uncertain."""

    seconds: dict[str, float]
    points: int
    uncertain: int


def time_stages(segmenter: Segmenter, read: Callable[[], Scan], runs: int = 10) -> Timing:
    """Time the stages for one scan, after two runs that only warm up.

    Raises:
        InputError: where there is no run to time, or the weights have no point head.
    """
    if runs < 1:
        raise InputError(f"expected one run or more, found {runs}; give a number from 1")
    if segmenter.method != "amvnet":
        raise InputError(f"expected the whole of AMVNet to time, found the method {segmenter.method}; use amvnet")
    timed = [_run(segmenter, read) for _ in range(runs + 2)][2:]
    seconds = {stage: median(run.seconds[stage] for run in timed) for stage in STAGES}
    return Timing(seconds, timed[0].points, timed[0].uncertain)


@torch.inference_mode()
def _run(segmenter: Segmenter, read: Callable[[], Scan]) -> Timing:
    """The steps of `AMVNet.forward`, each with a clock beside it."""
    model, device = segmenter.model, segmenter.device
    head = model.point_head
    assert head is not None
    clock = _Clock(device)
    with clock("read"):
        scan = read()
    with clock("project"):
        batch = PointBatch.of([scan]).to(device)
        image, grid = model.range_view.project(batch), model.polar_view.project(batch)
    with clock("RV"):
        f = image.to_points(model.range_net(image.image)).float().softmax(dim=1)
    with clock("BEV"):
        g = grid.to_points(model.polar_net(grid)).float().softmax(dim=1)
    with clock("compare"):
        uncertain = model.assertion(f, g, batch.points)
        index = uncertain.nonzero()[:, 0]
    with clock("neighbours"):
        near = nearest_neighbours(batch.points, index, head.config.neighbours)
    with clock("head"):
        h = settle(head, batch.points, f, g, index, near)
    with clock("merge"):
        merge(f, g, uncertain, h).argmax(dim=1).cpu()
    return Timing(clock.seconds, len(f), len(index))


class _Clock:
    """Seconds by stage; waits for a GPU to finish before it looks."""

    def __init__(self, device: str) -> None:
        self.seconds: dict[str, float] = {}
        self._gpu = device.startswith("cuda")

    @contextmanager
    def __call__(self, stage: str) -> Iterator[None]:
        start = time.perf_counter()
        yield
        if self._gpu:
            torch.cuda.synchronize()
        self.seconds[stage] = time.perf_counter() - start
