"""The processes that share a job, started by torchrun or SLURM: which one this is, and what they tell each other."""

from __future__ import annotations

import atexit
import functools
import os
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import timedelta
from typing import TYPE_CHECKING, Any, TypeVar

import torch
from torch import distributed as dist

from amvnet.errors import InputError

if TYPE_CHECKING:
    from lightning.fabric.plugins.environments import ClusterEnvironment

T = TypeVar("T")
PATIENCE = timedelta(
    days=7
)  # one process may read for hours while the others wait; a dead one ends them all


@dataclass(frozen=True)
class Processes:
    """This process among those of a job; by default it is alone.

    Attributes:
        rank: its number, from 0, among all.
        size: how many there are.
        local_rank: its number among those of its machine.
        nodes: machines.
        words: the group in which they exchange Python objects, or None where it is alone.
    """

    rank: int = 0
    size: int = 1
    local_rank: int = 0
    nodes: int = 1
    words: Any = None

    @property
    def first(self) -> bool:
        """Whether this is the process that prints, and writes what is written once."""
        return self.rank == 0

    @property
    def here(self) -> int:
        """How many there are on each machine."""
        return self.size // self.nodes

    def share(self, items: Sequence[T]) -> Sequence[T]:
        """This process's part: every `size`-th, so that all parts together are the items."""
        return items[self.rank :: self.size]

    def gather(self, mine: T) -> list[T]:
        """What each process has, by rank. All must call it."""
        if self.size == 1:
            return [mine]
        found: list[Any] = [None] * self.size
        dist.all_gather_object(found, mine, group=self.words)
        return found

    def wait(self) -> None:
        """Until all are here."""
        self.gather(None)

    def device(self, name: str) -> str:
        """The device of this process, where the user said `cuda`: one for each process of a machine."""
        return f"cuda:{self.local_rank}" if name == "cuda" and self.size > 1 else name


ALONE = Processes()


def environment() -> ClusterEnvironment:
    """Who started the processes: torchrun, SLURM's srun, or nobody."""
    from lightning.fabric.plugins.environments import (
        LightningEnvironment,
        SLURMEnvironment,
        TorchElasticEnvironment,
    )

    if TorchElasticEnvironment.detect():
        return TorchElasticEnvironment()
    if _slurm_tasks() > 1 and SLURMEnvironment.detect():
        # A job that is put back into the queue goes on by --resume, which is the user's to say.
        return SLURMEnvironment(auto_requeue=False)
    return LightningEnvironment()


def started() -> int:
    """How many processes were started for this job, by what the environment says."""
    return (
        int(os.environ.get("WORLD_SIZE", "1"))
        if dist.is_torchelastic_launched()
        else _slurm_tasks()
    )


def _slurm_tasks() -> int:
    # Of a job's script itself, which srun has not started, there is one.
    return int(os.environ.get("SLURM_NTASKS", "1")) if "SLURM_STEP_ID" in os.environ else 1


@functools.cache
def join(cuda: bool = False) -> Processes:
    """Meet the other processes of this job, if it has any.

    Args:
        cuda: whether they compute on CUDA devices, and so exchange gradients by NCCL and not by gloo.
    """
    if started() == 1:
        return ALONE
    found = environment()
    os.environ["MASTER_ADDR"], os.environ["MASTER_PORT"] = found.main_address, str(found.main_port)
    rank, size, local = found.global_rank(), found.world_size(), found.local_rank()
    here = os.environ.get("LOCAL_WORLD_SIZE")
    nodes = size // int(here) if here else int(os.environ.get("SLURM_NNODES", "1"))
    if cuda:
        torch.cuda.set_device(local)
    dist.init_process_group("nccl" if cuda else "gloo", rank=rank, world_size=size)
    atexit.register(dist.destroy_process_group)
    return Processes(rank, size, local, nodes, dist.new_group(backend="gloo", timeout=PATIENCE))


def device_of(accelerator: str) -> str:
    """The kind of device that Lightning's name of an accelerator means on this machine: cuda, mps or cpu.

    Raises:
        InputError: where the machine has none of it.
    """
    cuda, mps = torch.cuda.is_available(), torch.backends.mps.is_available()
    known = {"cpu": "cpu", "auto": "cuda" if cuda else "mps" if mps else "cpu"}
    known |= (
        {"gpu": "cuda", "cuda": "cuda"} if cuda else {"gpu": "mps", "mps": "mps"} if mps else {}
    )
    if accelerator not in known:
        raise InputError(
            f"expected an accelerator of this machine ({', '.join(known)}), found {accelerator!r}; use one of them"
        )
    return known[accelerator]
