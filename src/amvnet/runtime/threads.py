"""Keep OpenMP threads fast while other programs run, and safe after a fork.

torch divides each operation among a team of OpenMP threads. A thread that is done waits for the
others. By default, it spins, which means that it keeps its processor busy. If other programs run
as well, the last thread of the team may find no free processor. A call then takes many times as
long.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from functools import cache
from typing import TypeVar

# Environment variables that let threads sleep while they wait. The OpenMP of GNU and of LLVM reads
# the first, the OpenMP of LLVM and of Intel the last. For GNU, the second would override the first,
# so it stays unset.
WAITING = {"OMP_WAIT_POLICY": "passive", "GOMP_SPINCOUNT": None, "KMP_BLOCKTIME": "0"}

Part = TypeVar("Part")
Result = TypeVar("Result")


def wait_passively() -> None:
    """Let the threads of this process, and of processes that it starts, sleep while they wait.

    Nothing changes if the user has set one of the variables, or if torch is already imported:
    OpenMP reads the environment only once.
    """
    if any(name in os.environ for name in WAITING) or "torch" in sys.modules:
        return
    for name, value in WAITING.items():
        if value is not None:
            os.environ[name] = value


def do_threads_sleep() -> bool:
    """Return whether the environment says that threads sleep while they wait."""
    spins = os.environ.get("GOMP_SPINCOUNT", "0") != "0"
    return os.environ.get("OMP_WAIT_POLICY", "").lower() == "passive" and not spins


def run_parts(run: Callable[[Part], Result], parts: Sequence[Part]) -> list[Result]:
    """Run the parts of a computation on a CPU; return their results in order.

    torch wakes sleeping threads for their share of each operation. If operations are short, waking
    a thread takes longer than its share. Therefore every thread takes whole parts instead. If there
    are fewer parts than threads, each part gets the same number of threads.

    Spinning threads need no waking, and would keep the processors from the threads that run the
    parts. If threads spin, the parts run one after the other.
    """
    import torch

    in_turn = torch.compiler.is_compiling() or torch.is_grad_enabled() or not do_threads_sleep()
    threads = 1 if in_turn else torch.get_num_threads()
    workers = min(threads, len(parts))
    if workers < 2:
        return [run(part) for part in parts]

    # Pass these settings on, because each thread has its own values of them.
    is_inference = torch.is_inference_mode_enabled()
    is_mixed = torch.is_autocast_enabled("cpu")
    precision = torch.get_autocast_dtype("cpu")

    def run_alone(part: Part) -> Result:
        with (
            torch.no_grad(),
            torch.inference_mode(is_inference),
            torch.autocast("cpu", precision, enabled=is_mixed),
        ):
            return run(part)

    with thread_pool(workers, threads_each=threads // workers) as pool:
        return list(pool.map(run_alone, parts))


@contextmanager
def thread_pool(workers: int, threads_each: int) -> Iterator[ThreadPoolExecutor]:
    """Yield a pool of threads. Each computes with `threads_each` of torch's threads."""
    import torch

    threads = torch.get_num_threads()
    try:
        with ThreadPoolExecutor(
            workers, initializer=torch.set_num_threads, initargs=(threads_each,)
        ) as pool:
            yield pool
    finally:
        torch.set_num_threads(threads)  # which the pool changed for the whole process


@cache  # once per process
def survive_forks() -> None:
    """Let every process that is forked from this one compute with one thread.

    A forked process does not have the threads of the team, and would wait for them forever.
    """
    os.register_at_fork(after_in_child=_use_one_thread)


def _use_one_thread() -> None:
    import torch

    torch.set_num_threads(1)
