"""Time per stage from a scan's file to its written labels, and the networks' share of the limit.

The limit is the speed of a large matrix product on the same machine.
"""

from __future__ import annotations

import copy
import time
from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.utils.flop_counter import FlopCounterMode

from amvnet.config.schema import Recipe
from amvnet.data.taxonomy import TAXONOMIES
from amvnet.errors import InputError
from amvnet.inference.segmentation import label_ids
from amvnet.inference.segmenter import Segmenter
from amvnet.memory import peak_memory
from amvnet.models.amvnet import build_amvnet
from amvnet.models.assertion import cosine_similarity
from amvnet.models.layers import linear
from amvnet.models.methods import geometric_mean
from amvnet.models.streams import one_after_the_other
from amvnet.progress import Progress, no_progress
from amvnet.scan import Scan
from amvnet.weights.file import PARTS, Weights, part_state

STAGES = ("read", "project", "RV", "BEV", "compare", "neighbours", "head", "merge", "write")
NETWORKS = ("RV", "BEV")
FUSION = ("compare", "neighbours", "head", "merge")
MEAN = "mean"  # what the ensemble does instead of the fusion
WARM_UP = 2  # runs that do not count
PRODUCT = (4096, 1024, 1024)  # rows, inner size and columns of the matrix product
PRODUCT_RUNS = 3  # before each round
UNCERTAIN = 0.1  # of the points, for random weights, which cannot tell
MEBIBYTE = 2**20


@dataclass(frozen=True)
class Job:
    """What is timed: a segmenter, where its scan comes from and where its labels go.

    Attributes:
        segmenter: with all of AMVNet.
        read: reads the scan.
        write: writes its (P,) train ids.
        name: of the engine, or whatever distinguishes it from other jobs.
        share: of the points that count as uncertain: those on which the networks agree least; None
            means as tau says.
    """

    segmenter: Segmenter
    read: Callable[[], Scan]
    write: Callable[[np.ndarray], object]
    name: str = "torch"
    share: float | None = None


@dataclass(frozen=True)
class Timing:
    """The seconds of each stage and of `MEAN`, and the numbers of points and uncertain points."""

    seconds: dict[str, float]
    points: int
    uncertain: int

    @property
    def all(self) -> float:
        """Seconds from the file to the written labels."""
        return sum(self.seconds[stage] for stage in STAGES)


@dataclass(frozen=True)
class LeastAgreeing:
    """An assertion: the share of the points on which the networks agree least is uncertain."""

    share: float

    def __call__(self, f: Tensor, g: Tensor, points: Tensor) -> Tensor:
        count = round(self.share * len(f))
        least = cosine_similarity(f, g).topk(count, largest=False).indices

        uncertain = torch.zeros(len(f), dtype=torch.bool, device=f.device)
        uncertain[least] = True
        return uncertain


def time_jobs(
    jobs: Sequence[Job], runs: int, progress: Progress = no_progress
) -> list[dict[str, Any]]:
    """Time some jobs in turn, so that a disturbance hits all of them.

    Returns:
        A report of each job, for JSON.

    Raises:
        InputError: if there is no run to time, or the weights have no point head.
    """
    if runs < 1:
        raise InputError(f"expected one run or more, found {runs}; give a number from 1")
    for job in jobs:
        _check_job(job)

    timings: list[list[Timing]] = [[] for _ in jobs]
    limits: dict[str, float] = {}
    for run in range(runs + WARM_UP):
        for kind, speed in product_limits(jobs[0].segmenter.device).items():
            limits[kind] = max(speed, limits.get(kind, 0))
        for job, timings_of_job in zip(jobs, timings, strict=True):
            timings_of_job.append(run_once(job))

        progress(run + 1, runs + WARM_UP)

    reports = []
    for job, timings_of_job in zip(jobs, timings, strict=True):
        reports.append(_report(job, timings_of_job[WARM_UP:], limits))
    return reports


def _check_job(job: Job) -> None:
    method = job.segmenter.method

    if method != "amvnet":
        raise InputError(f"expected AMVNet to time, found the method {method}; use amvnet")

    if job.share is not None and not 0 <= job.share <= 1:
        raise InputError(
            f"expected a share of uncertain points from 0 to 1, found {job.share}; give another"
        )


@torch.inference_mode()
def run_once(job: Job) -> Timing:
    """Time a job once, with a clock around each step of `AMVNet.forward`."""
    device = job.segmenter.device
    clock = _Clock(device)

    model = copy.copy(job.segmenter.model)
    model.watch = clock
    model.arrange = one_after_the_other
    if job.share is not None:
        model.assertion = LeastAgreeing(job.share)

    with clock("read"):
        scan = job.read()
    with clock("project"):
        batch = job.segmenter.batch([scan])

    scores = model(batch)

    with clock("merge"):
        labels = label_ids(scores.merged).cpu().numpy()
    with clock("write"):
        job.write(labels)

    with clock(MEAN):
        label_ids(geometric_mean(scores.rv, scores.bev)).cpu()

    return Timing(dict(clock.seconds), len(labels), int(scores.uncertain.sum()))


class _Clock:
    """Seconds by stage; waits for a GPU to finish before it is read."""

    def __init__(self, device: str) -> None:
        self.seconds: dict[str, float] = defaultdict(float)
        self._gpu = device.startswith("cuda")

    @contextmanager
    def __call__(self, stage: str) -> Iterator[None]:
        start = time.perf_counter()
        yield

        if self._gpu:
            torch.cuda.synchronize()

        self.seconds[stage] += time.perf_counter() - start


def _report(job: Job, timings: Sequence[Timing], limits: dict[str, float]) -> dict[str, Any]:
    stages = {}
    for stage in (*STAGES, MEAN):
        stages[stage] = _spread([timing.seconds[stage] for timing in timings], unit=1e3)

    flops = _flops(job)
    networks = {}
    for name in NETWORKS:
        speed = flops[name] / stages[name]["median"] / 1e6  # GFLOP/s
        networks[name] = {
            "gflop": flops[name] / 1e9,
            "gflop_per_s": speed,
            "share_of_limit": speed / limits["float32"],
        }

    fusion_shares = [_sum(timing, FUSION) / timing.all for timing in timings]
    over_networks = [timing.all / _sum(timing, NETWORKS) for timing in timings]

    return {
        "engine": job.name,
        "device": job.segmenter.device,
        "threads": torch.get_num_threads(),
        "runs": len(timings),
        "points": timings[0].points,
        "uncertain": timings[0].uncertain,
        "stages_ms": stages,
        "all_ms": _spread([timing.all for timing in timings], unit=1e3),
        "fusion_share": _spread(fusion_shares, unit=1),
        "all_over_networks": _spread(over_networks, unit=1),
        "networks": networks,
        "limit_gflop_per_s": limits,
        "peak_memory_mib": _peak_memory(job.segmenter.device) / MEBIBYTE,
    }


def _sum(timing: Timing, stages: Sequence[str]) -> float:
    return sum(timing.seconds[stage] for stage in stages)


def _spread(values: Sequence[float], unit: float) -> dict[str, float]:
    """Return the median and the quartiles."""
    low, median, high = np.quantile(np.asarray(values) * unit, (0.25, 0.5, 0.75)).tolist()
    return {"median": median, "low": low, "high": high}


def _flops(job: Job) -> dict[str, float]:
    """Return each network's floating-point operations; a multiply-add counts as two."""
    device = job.segmenter.device
    # A counter sees one thread only, and `run_parts` uses several unless gradients are enabled.
    model = job.segmenter.weights.build().requires_grad_(False).to(device)
    batch = job.segmenter.batch([job.read()])

    counts = {}
    for name, score in (("RV", model.score_range_view), ("BEV", model.score_polar_view)):
        with FlopCounterMode(display=False) as counter:
            score(batch)
        counts[name] = float(counter.get_total_flops())

    return counts


def product_limits(device: str) -> dict[str, float]:
    """Return the GFLOP/s of a large matrix product, the fastest way that torch has, by type.

    The types are float32, and on a GPU bfloat16.
    """
    types = [torch.float32, torch.bfloat16] if device.startswith("cuda") else [torch.float32]
    rows, inner, columns = PRODUCT

    limits = {}
    for kind in types:
        x = torch.randn(rows, inner, dtype=kind, device=device)
        weight = torch.randn(columns, inner, dtype=kind, device=device)

        seconds = min(_fastest(_matmul, x, weight), _fastest(linear, x, weight))
        limits[str(kind).removeprefix("torch.")] = 2 * rows * inner * columns / seconds / 1e9
    return limits


def _matmul(x: Tensor, weight: Tensor, bias: None) -> Tensor:
    return x @ weight.T


@torch.inference_mode()
def _fastest(product: Callable[[Tensor, Tensor, None], Tensor], x: Tensor, weight: Tensor) -> float:
    """Return the seconds of the fastest of a few runs."""
    seconds = []
    for _ in range(PRODUCT_RUNS):
        clock = _Clock(str(x.device))
        with clock("product"):
            product(x, weight, None)

        seconds.append(clock.seconds["product"])

    return min(seconds)


def _peak_memory(device: str) -> int:
    """Return the peak memory in bytes: of the GPU, or of the process."""
    return torch.cuda.max_memory_allocated(device) if device.startswith("cuda") else peak_memory()


def untrained(recipe: Recipe) -> Weights:
    """Return random weights of a recipe's sizes, to time them."""
    taxonomy = TAXONOMIES[recipe.taxonomy]
    model = build_amvnet(recipe.model, taxonomy.size)

    tensors: dict[str, Tensor] = {}
    for part in PARTS:
        tensors |= part_state(part, getattr(model, part))

    return Weights(recipe.model, taxonomy, recipe.sensor, tensors)
