"""Read scans ahead, and compute on several at the same time; every command does so."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Generator, Iterator, Sequence
from concurrent.futures import Executor, Future, ThreadPoolExecutor
from contextlib import closing, contextmanager
from itertools import islice
from typing import Any, TypeVar

import torch

from amvnet.progress import Progress, no_progress
from amvnet.runtime.threads import thread_pool

READ_AHEAD = 3  # the number of scans that are read ahead; as many may wait to be written

Record = TypeVar("Record")
Loaded = TypeVar("Loaded")
Result = TypeVar("Result")


def stream_groups(
    records: Sequence[Record],
    load: Callable[[Record], Loaded],
    compute: Callable[[Sequence[tuple[Record, Future[Loaded]]]], Result],
    batch: int = 1,
    at_once: int = 1,
) -> Generator[Result]:
    """Read scans and compute on groups of them; only a few are in memory at a time.

    Args:
        load: reads a scan. One other thread calls it, in the order of the records.
        compute: takes a group of records, each with the future of its scan. `at_once` other threads
            call it, or this thread if `at_once` is 1.
        at_once: the number of groups that are computed at the same time, each with a share of
            torch's threads.

    Yields:
        The result of each group, in order. An exception of `compute` is raised in its turn.
    """
    # If there are few groups, they share all threads.
    at_once = max(min(at_once, math.ceil(len(records) / batch)), 1)
    with ThreadPoolExecutor(1) as reader, computing_threads(at_once) as computer:
        loads = ((record, reader.submit(load, record)) for record in records)
        reading = deque(islice(loads, max(READ_AHEAD, batch * at_once)))
        computing = deque[Future[Result]]()
        # One more group than threads, so that no thread has to wait for the next.
        most_groups = at_once + 1 if at_once > 1 else 1
        try:
            while reading or computing:
                while reading and len(computing) < most_groups:
                    group = [reading.popleft() for _ in range(min(batch, len(reading)))]
                    reading.extend(islice(loads, len(group)))
                    computing.append(computer.submit(compute, group))
                yield computing.popleft().result()
        finally:
            # After an error, what has been submitted is not needed any more.
            for pool in (reader, computer):
                pool.shutdown(wait=False, cancel_futures=True)


def stream_scans(
    records: Sequence[Record],
    load: Callable[[Record], Loaded],
    compute: Callable[[Record, Loaded], Result],
    at_once: int = 1,
    progress: Progress = no_progress,
) -> Generator[Result]:
    """Read scans and compute on each, as `stream_groups` does for groups of one scan.

    One other thread calls `load`. An exception of `load` or `compute` is raised in its turn.
    """

    def compute_one(group: Sequence[tuple[Record, Future[Loaded]]]) -> Result:
        ((record, reading),) = group
        return compute(record, reading.result())

    progress(0, len(records))
    with closing(stream_groups(records, load, compute_one, at_once=at_once)) as results:
        for done, result in enumerate(results, start=1):
            yield result
            progress(done, len(records))


class CallingThread(Executor):
    """Computes in the thread that submits, with all of torch's threads.

    A second thread would start a second team of OpenMP threads, which halves the speed of both.
    """

    def submit(self, function: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        """Call the function at once; return its result or its error as a future."""
        future: Future[Any] = Future()
        try:
            future.set_result(function(*args, **kwargs))
        except BaseException as error:
            future.set_exception(error)
        return future


@contextmanager
def computing_threads(at_once: int) -> Iterator[Executor]:
    """Yield an executor of `at_once` jobs at a time, each with a share of torch's threads."""
    if at_once == 1:
        yield CallingThread()
        return

    share = max(torch.get_num_threads() // at_once, 1)
    with thread_pool(at_once, threads_each=share) as pool:
        yield pool
