"""How this process's OpenMP threads behave while other programs run, and after a fork.

torch divides each operation among a team of OpenMP threads. A thread of the team that is done
waits for the others, by default by spinning: it keeps its processor busy. If another program needs
that processor, the thread that all wait for does not get it, and a call takes many times as long.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from functools import cache
from typing import TypeVar

# By these variables, threads sleep while they wait. GNU's and LLVM's OpenMP read the first, LLVM's
# and Intel's the last one. The second replaces the first for GNU's, so that it stays unset.
WAITING = {"OMP_WAIT_POLICY": "passive", "GOMP_SPINCOUNT": None, "KMP_BLOCKTIME": "0"}

Part = TypeVar("Part")
Result = TypeVar("Result")


def wait_passively() -> None:
    """Let the threads of this process, and of those that it starts, sleep while they wait.

    Nothing changes if the user has set one of the variables, or torch is already imported: OpenMP
    reads the environment only once.
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

    A thread that sleeps has to be woken for its share of each operation. In a part of many short
    operations this takes longer than the share. So every thread takes whole parts instead; if there
    are fewer parts than threads, each part gets equally many. Threads that spin need no waking, and
    would keep the processors from the threads of the parts.
    """
    import torch

    in_turn = torch.compiler.is_compiling() or torch.is_grad_enabled() or not do_threads_sleep()
    threads = 1 if in_turn else torch.get_num_threads()
    workers = min(threads, len(parts))
    if workers < 2:
        return [run(part) for part in parts]

    # All of these are settings of a thread.
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
    """Yield a pool of threads that compute with a number of torch's threads each."""
    import torch

    threads = torch.get_num_threads()
    try:
        with ThreadPoolExecutor(
            workers, initializer=torch.set_num_threads, initargs=(threads_each,)
        ) as pool:
            yield pool
    finally:
        torch.set_num_threads(threads)  # the pool's threads changed it for the whole process


@cache  # once per process
def survive_forks() -> None:
    """Let every process that is forked from this one compute with one thread.

    The threads of the team are not part of the forked process, which would wait for them forever.
    """
    os.register_at_fork(after_in_child=_use_one_thread)


def _use_one_thread() -> None:
    import torch

    torch.set_num_threads(1)
