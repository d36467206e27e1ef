"""The workers of a fleet: actors on a Ray cluster, any of which may end at any time."""

from __future__ import annotations

import logging
import os
import re
import signal
import threading
import warnings
from collections import Counter, deque
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from typing import Any

import pyarrow as pa

from amvnet.errors import InputError, reason_of
from amvnet.fleet.actors import Labelling, LabelScans

os.environ.setdefault("RAY_BACKEND_LOG_LEVEL", "fatal")  # Ray's C++ code prints to stderr
os.environ.setdefault("RAY_worker_niceness", "0")  # as `predict`, and not 15
import ray
from ray.exceptions import RayError, RayTaskError

OBJECT_STORE = 500_000_000  # bytes on this machine, of shared memory
CORES = 4  # of a worker without a GPU, if the machine has them
RETRIES = 2  # of a table whose worker ends, and of workers that end before they are ready
QUEUED = 2  # tables that a worker has at a time, so that it need not wait for the next
PATIENCE = 1.0  # seconds between two looks at signals
ADDRESS = re.compile(r"auto|local|(ray://)?[\w.\-\[\]]+:\d+")


def connect(address: str | None = None) -> None:
    """Connect this process to a Ray cluster, unless it is already.

    Args:
        address: such as `auto` or `ray://HOST:10001`; None starts Ray on this machine.

    Raises:
        InputError: if the text is no address, or there is no cluster at it.
    """
    if address is not None and not ADDRESS.fullmatch(address):
        raise InputError(
            f"--ray: expected an address such as auto or ray://HOST:10001, found {address!r}; "
            "name the inputs before --ray"
        )
    if ray.is_initialized():
        return
    options: dict[str, Any] = {"address": address or "local"}
    if address is None:
        options |= {"include_dashboard": False, "object_store_memory": OBJECT_STORE}

    warnings.filterwarnings("ignore", module=r"ray\.")
    try:
        with _own_signals():
            ray.init(**options, log_to_driver=False, logging_level=logging.CRITICAL)
    except Exception as error:  # Ray raises this class itself
        raise InputError(
            f"--ray {address or ''}: expected a Ray cluster, found {reason_of(error)}; start one "
            "with ray start --head, or leave the address out"
        ) from None


@contextmanager
def _own_signals() -> Iterator[None]:
    """Keep the handlers of signals: Ray's would abort the process without a word."""
    handlers = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    yield
    if threading.current_thread() is threading.main_thread():
        for number, handler in handlers.items():
            signal.signal(number, handler)


class Workers:
    """Actors that run the methods of `LabelScans`; those that end are replaced.

    Those for which the cluster has no room wait until it grows.

    Args:
        labelling: how scans are labelled.
        most: number of workers, if there is work for all; None means one for each GPU of the
            cluster, or else for each four cores.

    Raises:
        InputError: if the device is a GPU, and the cluster has none.
    """

    def __init__(self, labelling: Labelling, most: int | None = None) -> None:
        self._most, resources = _share_cluster(labelling.compute.device, most)
        self._labelling = ray.put(labelling)
        self._class: Any = ray.remote(**resources)(LabelScans)
        self._starting: dict[Any, Any] = {}  # by the reference that is ready when they are
        self._ready: list[Any] = []
        self._failures = 0  # workers that ended before they were ready, in succession
        self._grow(1)

    def close(self) -> None:
        """End the workers."""
        for worker in (*self._ready, *self._starting.values()):
            ray.kill(worker)

    def run(
        self, method: str, tables: Sequence[pa.Table], queued: int = QUEUED
    ) -> Iterator[tuple[pa.Table, Any]]:
        """Run a method of `LabelScans` on tables; yield each with its result as soon as it is done.

        The result is None if the method failed, or the workers that had the table have ended.

        Args:
            queued: tables that a worker has at a time; if it ends, all of them are run again.

        Raises:
            InputError: if workers cannot be started.
        """
        waiting = deque((table, 0) for table in tables)
        running: dict[Any, tuple[Any, pa.Table, int]] = {}
        while waiting or running:
            self._grow(len(waiting) + len(running))
            self._submit(method, waiting, running, queued)

            done, _ = ray.wait([*running, *self._starting], timeout=PATIENCE)
            for reference in done:
                if reference in self._starting:
                    self._begin(reference)
                    continue
                worker, table, retries = running.pop(reference)
                result = None
                try:
                    result = ray.get(reference)
                except RayTaskError:
                    pass  # the method failed
                except RayError:
                    self._give_up(worker)
                    if retries < RETRIES:
                        waiting.append((table, retries + 1))
                        continue
                yield table, result

    def _submit(
        self,
        method: str,
        waiting: deque[tuple[pa.Table, int]],
        running: dict[Any, tuple[Any, pa.Table, int]],
        queued: int,
    ) -> None:
        """Give tables that wait to the workers that have the fewest."""
        loads = Counter(worker for worker, _, _ in running.values())
        while waiting and self._ready:
            worker = min(self._ready, key=loads.__getitem__)
            if loads[worker] >= queued:
                return
            table, retries = waiting.popleft()
            running[getattr(worker, method).remote(table)] = (worker, table, retries)
            loads[worker] += 1

    def _grow(self, wanted: int) -> None:
        """Start workers until there are as many as wanted, or as many as there may be."""
        present = len(self._ready) + len(self._starting)
        for _ in range(min(wanted, self._most) - present):
            worker = self._class.remote(self._labelling)
            self._starting[worker.__ray_ready__.remote()] = worker

    def _begin(self, reference: Any) -> None:
        """Add a worker to those that are ready, or count that it ended before.

        Raises:
            InputError: if the labelling does not fit its machine, or workers end again and again.
        """
        worker = self._starting.pop(reference)
        try:
            ray.get(reference)
        except RayError as error:
            self._failures += 1
            if "InputError: " in str(error) or self._failures > RETRIES:
                raise InputError(_reason(error)) from error
        else:
            self._failures = 0
            self._ready.append(worker)

    def _give_up(self, worker: Any) -> None:
        """End a worker that does not answer any more."""
        with suppress(ValueError):  # done before, for another of its tables
            self._ready.remove(worker)
            ray.kill(worker)


def _share_cluster(device: str, most: int | None) -> tuple[int, dict[str, Any]]:
    """Return how many workers there are, and what each needs, as options of Ray."""
    available = ray.cluster_resources()
    cores = int(available.get("CPU", 1))
    gpus = int(available.get("GPU", 0))
    if device.startswith("cuda") and not gpus:
        raise InputError("--device: expected a cluster with a GPU, found none; leave it out")
    if gpus and device != "cpu":
        return most or gpus, {"num_gpus": 1, "num_cpus": 1}

    each = max(min(CORES, cores // (most or 1)), 1)
    return most or max(cores // each, 1), {"num_cpus": each}


def _reason(error: BaseException) -> str:
    """Return the line of an error on a worker, without its traceback."""
    lines = [line.strip() for line in str(error).splitlines() if line.strip()]
    own = [line for line in lines if "InputError: " in line]
    if own:
        return own[-1].rpartition("InputError: ")[2]
    reason = lines[-1] if lines else repr(error)
    return f"--ray: expected workers that run, found {reason}; check the cluster's logs"
