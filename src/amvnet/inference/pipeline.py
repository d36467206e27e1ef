"""A stream of scans: read, computed and written side by side, a few of them in memory at a time."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Executor, Future, ThreadPoolExecutor
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from itertools import groupby, islice
from pathlib import Path
from typing import Any

import numpy as np
import torch

from amvnet.data.label_files import write_uncertain
from amvnet.errors import InputError
from amvnet.files import atomic_write
from amvnet.inference.segmenter import Segmentation, Segmenter
from amvnet.scan import Scan

AHEAD = 3  # scans that are read before they are asked for, and that may wait to be written
Segment = Callable[[Scan], Segmentation]
Result = Segmentation | InputError


@dataclass(frozen=True)
class Task:
    """One scan to segment: how it is read, by what it is segmented, and where its labels go."""

    name: str
    read: Callable[[], Scan]
    segment: Segment
    write: Callable[[Segmentation], Path]
    scores: Path

    @property
    def uncertain(self) -> Path:
        """Where it is written which points are uncertain."""
        return self.scores.with_suffix(".uncertain.npy")


def stream(
    tasks: Sequence[Task], scores: bool, uncertain: bool, batch: int = 1, at_once: int = 1
) -> Iterator[tuple[Task, str | None]]:
    """Each task when it is done, in order, with what is wrong with its scan; only a few scans are in memory."""
    with (
        ThreadPoolExecutor(1) as reader,
        computers(at_once) as computer,
        ThreadPoolExecutor(1) as writer,
    ):
        source, writing = iter(tasks), deque[tuple[Task, Future[None]]]()
        read = ((task, reader.submit(task.read)) for task in source)
        reading = deque(islice(read, max(AHEAD, batch * at_once)))
        computing = deque[Future[list[tuple[Task, Result]]]]()
        try:
            while reading or computing:
                while reading and len(computing) < at_once + (
                    at_once > 1
                ):  # one waits, so that no thread has to
                    some = [reading.popleft() for _ in range(min(batch, len(reading)))]
                    reading.extend(islice(read, len(some)))
                    computing.append(computer.submit(_segmented, some))
                for task, result in computing.popleft().result():
                    if isinstance(result, InputError):
                        yield task, str(result)
                        continue
                    writing.append((task, writer.submit(_write, task, result, scores, uncertain)))
                    while len(writing) > AHEAD:
                        yield _written(*writing.popleft())
            while writing:
                yield _written(*writing.popleft())
        finally:
            for pool in (reader, computer):
                pool.shutdown(wait=False, cancel_futures=True)


class Here(Executor):
    """Computes in the thread that asks, which has all of torch's threads: a second such thread halves their speed."""

    def submit(self, function: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        done: Future[Any] = Future()
        try:
            done.set_result(function(*args, **kwargs))
        except BaseException as error:
            done.set_exception(error)
        return done


@contextmanager
def computers(at_once: int) -> Iterator[Executor]:
    """What computes so many groups of scans at a time, each with its share of torch's threads."""
    if at_once == 1:
        yield Here()
        return
    threads = torch.get_num_threads()
    try:
        share = (max(threads // at_once, 1),)
        with ThreadPoolExecutor(at_once, initializer=torch.set_num_threads, initargs=share) as pool:
            yield pool
    finally:
        torch.set_num_threads(threads)


def _segmented(some: Sequence[tuple[Task, Future[Scan]]]) -> list[tuple[Task, Result]]:
    """What is found for some tasks, in order, or what is wrong with their scans."""
    return list(_each_segmented(some))


def _each_segmented(some: Sequence[tuple[Task, Future[Scan]]]) -> Iterator[tuple[Task, Result]]:
    read: list[tuple[Task, Scan]] = []
    for task, coming in some:
        try:
            read.append((task, coming.result()))
        except InputError as error:
            yield task, error
    for segment, group in groupby(read, key=lambda one: one[0].segment):
        tasks, scans = zip(*group, strict=True)
        yield from zip(tasks, _together(segment, scans), strict=True)


def _together(segment: Segment, scans: Sequence[Scan]) -> Iterator[Result]:
    """By one pass of the networks, where they are what segments; one by one to find which scan is at fault."""
    if len(scans) > 1 and isinstance(segment, Segmenter):
        with suppress(InputError):
            yield from segment.many(scans)
            return
    for scan in scans:
        try:
            yield segment(scan)
        except InputError as error:
            yield error


def _write(task: Task, result: Segmentation, scores: bool, uncertain: bool) -> None:
    if scores:
        write_scores(task.scores, result)
    if uncertain:
        write_uncertain(task.uncertain, result.uncertain)
    task.write(result)


def _written(task: Task, writing: Future[None]) -> tuple[Task, None]:
    writing.result()  # raises what went wrong
    return task, None


def write_scores(path: Path, result: Segmentation) -> None:
    """Both networks' probabilities, (N, K) float16, as `rv` and `bev` of an `.npz`."""
    found = {
        name: v.astype(np.float16)
        for name, v in (("rv", result.rv), ("bev", result.bev))
        if v is not None
    }
    with atomic_write(path) as part:
        np.savez_compressed(part, **found)  # type: ignore[arg-type]  # of the arrays, none is an option
