"""Time per stage from a scan's file to its written labels, and how near the networks come to the machine's limit."""

from __future__ import annotations

import time
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
from amvnet.inference.segmenter import Segmenter, label_ids
from amvnet.memory import peak_memory
from amvnet.models.amvnet import build_amvnet, geometric_mean, merge, settle
from amvnet.models.assertions import cosine_similarity
from amvnet.models.layers import linear
from amvnet.models.point_head import nearest_neighbours
from amvnet.models.views.points import PointBatch
from amvnet.scan import Scan
from amvnet.weights.file import PARTS, Weights, part_state

STAGES = ("read", "project", "RV", "BEV", "compare", "neighbours", "head", "merge", "write")
NETWORKS = ("RV", "BEV")
FUSION = ("compare", "neighbours", "head", "merge")
MEAN = "mean"  # what the ensemble does instead of the fusion
WARM_UP = 2  # runs that do not count
PRODUCT = (4096, 1024, 1024)  # of the matrices whose product is the machine's limit
PRODUCT_RUNS = 3  # before each round
UNCERTAIN = 0.1  # of the points, where random weights have nothing to say about it
MEBIBYTE = 2**20


@dataclass(frozen=True)
class Job:
    """What is timed: a segmenter, where its scan comes from and its labels go.

    Attributes:
        segmenter: with all of AMVNet.
        read: reads the scan.
        write: writes its (P,) train ids.
        name: of the engine, or what else tells it from the others.
        share: of the points that count as uncertain: those the networks agree on least; None as tau says.
    """

    segmenter: Segmenter
    read: Callable[[], Scan]
    write: Callable[[np.ndarray], object]
    name: str = "torch"
    share: float | None = None


@dataclass(frozen=True)
class Timing:
    """Seconds of each stage, and of `MEAN`; how many points the scan has, and how many of them were uncertain."""

    seconds: dict[str, float]
    points: int
    uncertain: int

    @property
    def all(self) -> float:
        """Seconds from the file to the written labels."""
        return sum(self.seconds[stage] for stage in STAGES)


def time_jobs(
    jobs: Sequence[Job], runs: int, step: Callable[[int, int], None] = lambda done, total: None
) -> list[dict[str, Any]]:
    """Time some jobs in turn, so that what disturbs one disturbs all; returns a report of each, for JSON.

    Raises:
        InputError: where there is no run to time, or the weights have no point head.
    """
    if runs < 1:
        raise InputError(f"expected one run or more, found {runs}; give a number from 1")
    for job in jobs:
        if job.segmenter.method != "amvnet":
            raise InputError(
                f"expected the whole of AMVNet to time, found the method {job.segmenter.method}; use amvnet"
            )
        if job.share is not None and not 0 <= job.share <= 1:
            raise InputError(
                f"expected a share of uncertain points from 0 to 1, found {job.share}; give another"
            )
    found: list[list[Timing]] = [[] for _ in jobs]
    limits: dict[str, float] = {}
    for number in range(runs + WARM_UP):
        for kind, speed in product_limits(jobs[0].segmenter.device).items():
            limits[kind] = max(speed, limits.get(kind, 0))
        for job, some in zip(jobs, found, strict=True):
            some.append(run_once(job))
        step(number + 1, runs + WARM_UP)
    return [_report(job, some[WARM_UP:], limits) for job, some in zip(jobs, found, strict=True)]


@torch.inference_mode()
def run_once(job: Job) -> Timing:
    """Time a job once: the steps of `AMVNet.forward`, each with a clock beside it."""
    model, device = job.segmenter.model, job.segmenter.device
    head = model.point_head
    assert head is not None
    clock = _Clock(device)
    with clock("read"):
        scan = job.read()
    with clock("project"):
        batch = PointBatch.of([scan]).to(device)
        image, grid = model.range_view.project(batch), model.polar_view.project(batch)
    with clock("RV"):
        f = image.to_points(model.range_net(image.image)).float().softmax(dim=1)
    with clock("BEV"):
        g = grid.to_points(model.polar_net(grid)).float().softmax(dim=1)
    with clock(MEAN):
        label_ids(geometric_mean(f, g)).cpu()
    with clock("compare"):
        uncertain = (
            model.assertion(f, g, batch.points) if job.share is None else _least(f, g, job.share)
        )
        index = uncertain.nonzero()[:, 0]
    with clock("neighbours"):
        near = nearest_neighbours(batch.points, index, head.config.neighbours)
    with clock("head"):
        h = settle(head, batch.points, f, g, index, near)
    with clock("merge"):
        labels = label_ids(merge(f, g, uncertain, h)).cpu().numpy()
    with clock("write"):
        job.write(labels)
    return Timing(clock.seconds, len(f), len(index))


def _least(f: Tensor, g: Tensor, share: float) -> Tensor:
    """(P,) bool: the share of the points that the networks agree on least."""
    count = round(share * len(f))
    found = torch.zeros(len(f), dtype=torch.bool, device=f.device)
    found[cosine_similarity(f, g).topk(count, largest=False).indices] = True
    return found


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


def _report(job: Job, runs: Sequence[Timing], limits: dict[str, float]) -> dict[str, Any]:
    stages = {stage: _spread([run.seconds[stage] for run in runs]) for stage in (*STAGES, MEAN)}
    fusion = _spread(
        [sum(run.seconds[stage] for stage in FUSION) / run.all for run in runs], unit=1
    )
    networks = _spread(
        [run.all / sum(run.seconds[stage] for stage in NETWORKS) for run in runs], unit=1
    )
    flops = _flops(job)
    return {
        "engine": job.name,
        "device": job.segmenter.device,
        "threads": torch.get_num_threads(),
        "runs": len(runs),
        "points": runs[0].points,
        "uncertain": runs[0].uncertain,
        "stages_ms": stages,
        "all_ms": _spread([run.all for run in runs]),
        "fusion_share": fusion,
        "all_over_networks": networks,
        "networks": {
            name: {
                "gflop": flops[name] / 1e9,
                "gflop_per_s": (speed := flops[name] / stages[name]["median"] / 1e6),
                "share_of_limit": speed / limits["float32"],
            }
            for name in NETWORKS
        },
        "limit_gflop_per_s": limits,
        "peak_memory_mib": _peak_memory(job.segmenter.device) / MEBIBYTE,
    }


def _spread(values: Sequence[float], unit: float = 1e3) -> dict[str, float]:
    """The median, and between what half of the values lie."""
    low, median, high = np.quantile(np.asarray(values) * unit, (0.25, 0.5, 0.75)).tolist()
    return {"median": median, "low": low, "high": high}


@torch.inference_mode()
def _flops(job: Job) -> dict[str, float]:
    """Floating-point operations of each network for the scan; a multiplication and an addition are two."""
    model, batch = (
        job.segmenter.weights.build().to(job.segmenter.device),
        PointBatch.of([job.read()]),
    )
    counted = {}
    for name, score in (("RV", model.score_range_view), ("BEV", model.score_polar_view)):
        with FlopCounterMode(display=False) as counter:
            score(batch.to(job.segmenter.device))
        counted[name] = float(counter.get_total_flops())
    return counted


def product_limits(device: str) -> dict[str, float]:
    """The most GFLOP/s of a large matrix product by any way that torch has, by type; on a GPU of bfloat16 too."""
    types = [torch.float32, torch.bfloat16] if device.startswith("cuda") else [torch.float32]
    rows, inner, columns = PRODUCT
    limits = {}
    for kind in types:
        x, w = (
            torch.randn(rows, inner, dtype=kind, device=device),
            torch.randn(columns, inner, dtype=kind, device=device),
        )
        ways = (lambda x=x, w=w: x @ w.T), (lambda x=x, w=w: linear(x, w, None))
        seconds = min(_fastest(way, device) for way in ways)
        limits[str(kind).removeprefix("torch.")] = 2 * rows * inner * columns / seconds / 1e9
    return limits


@torch.inference_mode()
def _fastest(function: Callable[[], object], device: str) -> float:
    seconds = []
    for _ in range(PRODUCT_RUNS):
        clock = _Clock(device)
        with clock("product"):
            function()
        seconds.append(clock.seconds["product"])
    return min(seconds)


def _peak_memory(device: str) -> int:
    """Bytes that the process has taken at most; on a GPU, of its memory."""
    return torch.cuda.max_memory_allocated(device) if device.startswith("cuda") else peak_memory()


def untrained(recipe: Recipe) -> Weights:
    """Random weights of a recipe's sizes, to time them."""
    taxonomy = TAXONOMIES[recipe.taxonomy]
    model = build_amvnet(recipe.model, taxonomy.size)
    tensors = {
        key: value
        for part in PARTS
        for key, value in part_state(part, getattr(model, part)).items()
    }
    return Weights(recipe.model, taxonomy, recipe.sensor, tensors)
