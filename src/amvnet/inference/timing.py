"""Time each stage from a scan's file to its written labels."""

from __future__ import annotations

import time
from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

from amvnet.files import Signature
from amvnet.inference.segmentation import label_ids
from amvnet.inference.segmenter import Segmenter
from amvnet.models.amvnet import AMVNet, Watch, one_after_the_other
from amvnet.models.methods import geometric_mean
from amvnet.progress import Progress, no_progress
from amvnet.runtime.memory import peak_memory
from amvnet.scan import Scan

REST = "rest"  # all that is between the other stages
STAGES = ("read", "project", "RV", "BEV", "compare", "neighbours", "head", "merge", "write", REST)
FUSION = ("compare", "neighbours", "head", "merge")
MEAN = "mean"  # the stage of the ensemble, which takes the place of the fusion
WARM_UP_RUNS = 2  # the number of first runs that do not count
MEBIBYTE = 2**20

Read = Callable[[], Scan]
Write = Callable[[np.ndarray], object]

FIGURES = Signature("figures of bench", rb'\{\s*"engine": ')


@dataclass(frozen=True)
class Timing:
    """The time of one run: the seconds of each of the `STAGES`, and of `MEAN`.

    `points` counts the valid points.
    """

    seconds: dict[str, float]
    points: int
    uncertain: int

    @property
    def total(self) -> float:
        """The seconds from the file to the written labels."""
        return sum(self.seconds[stage] for stage in STAGES)

    def share_of(self, stages: Sequence[str]) -> float:
        """Return the share of some stages in the total, in [0, 1]."""
        return sum(self.seconds[stage] for stage in stages) / self.total


def time_runs(
    segmenter: Segmenter, read: Read, write: Write, runs: int, progress: Progress = no_progress
) -> dict[str, Any]:
    """Time runs, after `WARM_UP_RUNS` that do not count; return a report for JSON.

    Each run reads a scan, segments it, and writes its (P,) train ids.
    """
    timings = []
    for run in range(runs + WARM_UP_RUNS):
        timings.append(run_once(segmenter, read, write))
        progress(run + 1, runs + WARM_UP_RUNS)
    return _report(segmenter, timings[WARM_UP_RUNS:])


@torch.inference_mode()
def run_once(segmenter: Segmenter, read: Read, write: Write) -> Timing:
    """Read, segment and write a scan, with a clock around each step of `AMVNet.forward`."""
    clock = _Clock(segmenter.device)
    start = time.perf_counter()
    with clock("read"):
        scan = read()
    with clock("project"):
        batch = segmenter.batch([scan])

    with _watched(segmenter.model, clock):
        scores = segmenter.engine.score(batch)

    with clock("merge"):
        labels = label_ids(scores.merged).cpu().numpy()
    with clock("write"):
        write(labels)
    total = time.perf_counter() - start
    clock.seconds[REST] = total - sum(clock.seconds.values())

    assert scores.rv is not None
    assert scores.bev is not None
    with clock(MEAN):
        label_ids(geometric_mean(scores.rv, scores.bev)).cpu()

    return Timing(dict(clock.seconds), len(labels), int(scores.uncertain.sum()))


@contextmanager
def _watched(model: AMVNet, watch: Watch) -> Iterator[None]:
    """Let a model run its steps one after the other, and time each by `watch`."""
    before = model.watch, model.arrange
    model.watch = watch
    model.arrange = one_after_the_other
    try:
        yield
    finally:
        model.watch, model.arrange = before


class _Clock:
    """Adds up the seconds of each stage; waits for a GPU at the end of a stage."""

    def __init__(self, device: str) -> None:
        self.seconds: dict[str, float] = defaultdict(float)
        self._gpu = torch.device(device).type == "cuda"

    @contextmanager
    def __call__(self, stage: str) -> Iterator[None]:
        start = time.perf_counter()
        yield

        if self._gpu:
            torch.cuda.synchronize()

        self.seconds[stage] += time.perf_counter() - start


def _report(segmenter: Segmenter, timings: Sequence[Timing]) -> dict[str, Any]:
    stages = {}
    for stage in (*STAGES, MEAN):
        stages[stage] = _spread([1e3 * timing.seconds[stage] for timing in timings])

    device = segmenter.device
    is_gpu = torch.device(device).type == "cuda"
    memory = torch.cuda.max_memory_allocated(device) if is_gpu else peak_memory()
    return {
        "engine": segmenter.engine.name,
        "precision": segmenter.engine.precision,
        "device": device,
        "threads": torch.get_num_threads(),
        "runs": len(timings),
        "points": timings[0].points,
        "uncertain": timings[0].uncertain,
        "stages_ms": stages,
        "all_ms": _spread([1e3 * timing.total for timing in timings]),
        "fusion_share": _spread([timing.share_of(FUSION) for timing in timings]),
        "peak_memory_mib": memory / MEBIBYTE,
    }


def _spread(values: Sequence[float]) -> dict[str, float]:
    low, median, high = np.quantile(values, (0.25, 0.5, 0.75)).tolist()
    return {"median": median, "low": low, "high": high}
