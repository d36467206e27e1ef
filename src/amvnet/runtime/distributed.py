"""Connect processes that share a job, started by torchrun or SLURM."""

from __future__ import annotations

import atexit
import errno
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

# The longest time that a process waits for the others. A process may read for hours. If one process
# dies, all end.
LONGEST_WAIT = timedelta(days=7)


@dataclass(frozen=True)
class Processes:
    """This process among the processes of a job; by default it is the only one.

    Attributes:
        rank: this process's number among all processes, from 0.
        local_rank: this process's number among the processes on its machine, from 0.
        group: torch's process group for the exchange of Python objects; None if there is only one
            process.
    """

    rank: int = 0
    size: int = 1
    local_rank: int = 0
    nodes: int = 1
    group: Any = None

    @property
    def first(self) -> bool:
        """Whether this is the process that prints, and that writes what only one may write."""
        return self.rank == 0

    def share(self, items: Sequence[T]) -> Sequence[T]:
        """Return this process's share of the items: every `size`-th item, starting at `rank`."""
        return items[self.rank :: self.size]

    def gather(self, value: T) -> list[T]:
        """Return the values of all processes, by rank. Every process must call this.

        Raises:
            ConnectionResetError: if another process has ended.
        """
        if self.size == 1:
            return [value]

        values: list[Any] = [None] * self.size
        try:
            dist.all_gather_object(values, value, group=self.group)
        except RuntimeError as error:
            reason = "another process ended before its work was done, and has printed the reason"
            raise ConnectionResetError(errno.ECONNRESET, reason, "torch.distributed") from error
        return values

    def wait(self) -> None:
        """Wait until every process has called this."""
        self.gather(None)

    def device(self, name: str) -> str:
        """Return the device of this process: its own GPU if several processes share `cuda`."""
        if name == "cuda" and self.size > 1:
            return f"cuda:{self.local_rank}"

        return name


ALONE = Processes()


def environment() -> ClusterEnvironment:
    """Return Lightning's environment for torchrun, for srun, or for neither."""
    from lightning.fabric.plugins.environments import (
        LightningEnvironment,
        SLURMEnvironment,
        TorchElasticEnvironment,
    )

    if TorchElasticEnvironment.detect():
        return TorchElasticEnvironment()

    if _slurm_tasks() > 1 and SLURMEnvironment.detect():
        # A job that is queued again continues only if the user says --resume.
        return SLURMEnvironment(auto_requeue=False)

    return LightningEnvironment()


def started() -> int:
    """Return the number of processes that were started for this job, by environment variables."""
    if dist.is_torchelastic_launched():
        return int(os.environ.get("WORLD_SIZE", "1"))

    return _slurm_tasks()


def _slurm_tasks() -> int:
    """Return the number of tasks that srun has started. In the job's own script, it is 1."""
    if "SLURM_STEP_ID" not in os.environ:
        return 1

    return int(os.environ.get("SLURM_NTASKS", "1"))


@functools.cache
def connect(cuda: bool = False) -> Processes:
    """Connect to the other processes of this job, if any; by NCCL with CUDA, else by gloo."""
    if started() == 1:
        return ALONE

    cluster = environment()
    os.environ["MASTER_ADDR"] = cluster.main_address
    os.environ["MASTER_PORT"] = str(cluster.main_port)
    rank = cluster.global_rank()
    size = cluster.world_size()
    local_rank = cluster.local_rank()

    if cuda:
        torch.cuda.set_device(local_rank)
    dist.init_process_group("nccl" if cuda else "gloo", rank=rank, world_size=size)
    atexit.register(dist.destroy_process_group)

    group = dist.new_group(backend="gloo", timeout=LONGEST_WAIT)
    return Processes(
        rank=rank, size=size, local_rank=local_rank, nodes=_node_count(size), group=group
    )


def _node_count(size: int) -> int:
    local_size = os.environ.get("LOCAL_WORLD_SIZE")
    if local_size:
        return size // int(local_size)

    return int(os.environ.get("SLURM_NNODES", "1"))


def device_of(accelerator: str) -> str:
    """Return the kind of device (cuda, mps or cpu) of one of Lightning's accelerators.

    Raises:
        InputError: if this machine has no such device.
    """
    devices = {"cpu": "cpu", "auto": "cpu"}
    if torch.cuda.is_available():
        devices |= {"auto": "cuda", "gpu": "cuda", "cuda": "cuda"}
    elif torch.backends.mps.is_available():
        devices |= {"auto": "mps", "gpu": "mps", "mps": "mps"}

    if accelerator not in devices:
        raise InputError(
            f"expected an accelerator of this machine ({', '.join(devices)}), "
            f"found {accelerator!r}; use one of them"
        )
    return devices[accelerator]
