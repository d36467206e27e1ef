"""Estimate the memory of a training step from the sizes of a recipe, without taking it."""

from __future__ import annotations

import dataclasses
from contextlib import nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn
from torch._subclasses.fake_tensor import FakeTensorMode

from amvnet.config.schema import ModelConfig, Recipe
from amvnet.distributed import device_of
from amvnet.errors import InputError
from amvnet.models.polar_net import PolarNet
from amvnet.models.range_net import RangeNet
from amvnet.models.views.points import PointBatch
from amvnet.models.views.polar_view import PolarGrid, PolarView
from amvnet.models.views.range_view import CHANNELS
from amvnet.scan import Scan
from amvnet.training.precision import DOUBLE, SINGLE, precision_of

# Bytes per parameter: the weight, its gradient and AdamW's two moments in float32.
OPTIMIZED = 16
# The range view is estimated on a narrower image, since its memory grows with the width: two cells
# at the coarsest stride. The loop of the GRUs would take minutes on the whole width.
COARSEST_CELLS = 2
GIB = 2**30
CGROUP = Path("/sys/fs/cgroup")


@dataclass(frozen=True)
class StepMemory:
    """Bytes that a training step needs.

    Attributes:
        scan: for each scan that is in memory at a time.
        fixed: for the weights, their gradients and the optimizer.
    """

    scan: int
    fixed: int

    def of(self, scans: int) -> int:
        """Return the bytes for a number of scans at a time."""
        return scans * self.scan + self.fixed


def step_memory(recipe: Recipe, name: str, scan: Scan, classes: int) -> StepMemory:
    """Return the bytes that a training step of a network needs.

    They are those of the tensors that are kept for the backward pass, the weights, the gradients
    and the optimizer, in addition to what this process has taken so far.

    Args:
        recipe: sizes and precision.
        name: of the stage, rv or bev.
        scan: a typical scan.
        classes: K.
    """
    precision = precision_of(recipe.training)
    estimate = range_memory if name == "rv" else polar_memory
    activations, parameters = estimate(recipe.model, scan, classes, precision)
    # Weights of mixed precision stay in float32.
    fixed = parameters * OPTIMIZED * (2 if precision == DOUBLE else 1)
    return StepMemory(activations, fixed)


def range_memory(
    model: ModelConfig, scan: Scan, classes: int, precision: str = SINGLE
) -> tuple[int, int]:
    """Return the bytes kept for the backward pass of a scan, and the number of parameters."""
    config = model.range_net
    view = model.range_view
    narrow = min(COARSEST_CELLS * 2 ** len(config.widths), view.width)

    with FakeTensorMode():
        net = RangeNet(config, classes)
        image = torch.zeros(1, CHANNELS, view.height, narrow)
        twice = torch.zeros(1, CHANNELS, view.height, 2 * narrow)
        size = _kept_bytes(net, image, precision)
        growth = _kept_bytes(net, twice, precision) - size

    # The weights, which mixed precision copies, do not grow with the width.
    size += round(growth * (view.width - narrow) / narrow)
    return size, _count_parameters(net)


def polar_memory(
    model: ModelConfig, scan: Scan, classes: int, precision: str = SINGLE
) -> tuple[int, int]:
    """Return the bytes kept for the backward pass of a scan, and the number of parameters."""
    grid = PolarView(model.polar_view).project(PointBatch.of([scan]))

    with FakeTensorMode():
        net = PolarNet(model.polar_net, model.polar_view.vertical, classes)
        size = _kept_bytes(net, _without_values(grid), precision)
    return size, _count_parameters(net)


def _without_values(grid: PolarGrid) -> PolarGrid:
    """Return a grid of the same sizes; within a `FakeTensorMode`, its tensors take no memory."""
    changes: dict[str, Any] = {}
    for field in dataclasses.fields(grid):
        value = getattr(grid, field.name)
        if isinstance(value, Tensor):
            changes[field.name] = torch.zeros(value.shape, dtype=value.dtype)
    return dataclasses.replace(grid, **changes)


def _kept_bytes(net: nn.Module, inputs: Any, precision: str) -> int:
    """Return the bytes that a forward pass keeps for its backward pass, without the weights."""
    # Storages by address. They are held here, so that no address is used twice.
    storages: dict[int, Any] = {}

    def keep(tensor: Tensor) -> Tensor:
        storage = tensor.untyped_storage()
        storages[storage._cdata] = storage
        return tensor

    is_mixed = precision.endswith("-mixed")
    context = torch.autocast("cpu", torch.bfloat16) if is_mixed else nullcontext()
    with context, torch.autograd.graph.saved_tensors_hooks(keep, _same):
        net.train()(inputs)

    for parameter in net.parameters():
        storages.pop(parameter.untyped_storage()._cdata, None)
    total = sum(storage.nbytes() for storage in storages.values())
    return total * 2 if precision == DOUBLE else total


def _same(tensor: Tensor) -> Tensor:
    return tensor


def _count_parameters(net: nn.Module) -> int:
    return sum(parameter.numel() for parameter in net.parameters())


def free_memory(accelerator: str) -> int | None:
    """Return the bytes that are free on the device of a training; None if unknown.

    Args:
        accelerator: as in a recipe.
    """
    if device_of(accelerator) == "cuda":
        return torch.cuda.mem_get_info()[0]

    limits = []
    try:
        for line in Path("/proc/meminfo").read_text().splitlines():
            if line.startswith("MemAvailable:"):
                limits.append(int(line.split()[1]) * 1024)
    except OSError:
        return None

    # A container may have less than its machine.
    try:
        most = int((CGROUP / "memory.max").read_text())
        used = int((CGROUP / "memory.current").read_text()) - _cached_files()
        limits.append(max(most - used, 0))
    except (OSError, ValueError):  # no such file, or no limit: "max"
        pass
    return min(limits, default=None)


def _cached_files() -> int:
    """Return the bytes of this container that hold copies of files, and are freed when needed."""
    total = 0
    for line in (CGROUP / "memory.stat").read_text().splitlines():
        name, _, size = line.partition(" ")
        if name in ("active_file", "inactive_file"):
            total += int(size)
    return total


def check_memory(recipe: Recipe, name: str, scan: Scan, classes: int, processes: int) -> str:
    """Return a line about the memory of a network's training steps.

    Args:
        recipe: what to train.
        name: of the stage, rv or bev.
        scan: a typical scan.
        classes: K.
        processes: that share a batch.

    Raises:
        InputError: if the steps need more than is free; the line says what would fit.
    """
    config = getattr(recipe.training, name)
    scans = config.batch // config.accumulate // processes
    memory = step_memory(recipe, name, scan, classes)
    need = memory.of(scans)
    free = free_memory(recipe.training.accelerator)
    line = f"{name}: {scans} scans at a time need about {need / GIB:.1f} GiB"
    if free is None:
        return line
    if need <= free:
        return f"{line}, {free / GIB:.1f} GiB are free"

    advice = "take a compact recipe, or smaller sizes"
    for parts in range(2, scans + 1):
        if scans % parts == 0 and memory.of(scans // parts) <= free:
            advice = f"set --training.{name}.accumulate {config.accumulate * parts}"
            break
    raise InputError(
        f"{name}: expected steps that fit into the {free / GIB:.1f} GiB that are free, "
        f"found {scans} scans at a time, which need about {need / GIB:.1f} GiB; {advice}"
    )
