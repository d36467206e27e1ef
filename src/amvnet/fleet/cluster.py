"""Label a fleet of scans on a Ray cluster."""

from __future__ import annotations

import errno
import logging
import os
import re
import signal
import threading
import warnings
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from itertools import chain
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from amvnet.data.datasets.open import is_dataset
from amvnet.errors import InputError, SomeBroken
from amvnet.fleet.actors import Labelling, LabelScans, Row, measure_drive, results_schema
from amvnet.fleet.drives import describe_drive
from amvnet.fleet.manifest import Block, NameSet, list_blocks, windows
from amvnet.fleet.results import DRIVES, Results
from amvnet.fleet.storage import Place
from amvnet.inference.journal import Entry
from amvnet.inference.predict import report
from amvnet.models.methods import METHODS
from amvnet.progress import Progress, Say, no_progress, say_nothing
from amvnet.sensors.measure import MEASURED

os.environ.setdefault("RAY_BACKEND_LOG_LEVEL", "fatal")  # Ray's C++ code prints to stderr
os.environ.setdefault("RAY_worker_niceness", "0")  # as `predict`, and not 15
import ray
import ray.data

WINDOW = 10_000  # blocks that Ray Data runs together, up to 640,000 scans
OBJECT_STORE = 500_000_000  # bytes on this machine, of shared memory
CORES = 4  # of a worker without a GPU, if the machine has them
RETRIES = 2  # of a block whose worker ends
ADDRESS = re.compile(r"auto|local|(ray://)?[\w.\-\[\]]+:\d+")
SAID = 10  # drives of which is said what was assumed
MOST_FAULTS = 1000  # lines about broken scans

Workers = tuple[int, int]  # the least and the largest number


def label_fleet(
    inputs: Sequence[str],
    labelling: Labelling,
    address: str | None = None,
    workers: Workers | None = None,
    resume: bool = False,
    overwrite: bool = False,
    progress: Progress = no_progress,
    say: Say = say_nothing,
) -> int:
    """Label scan files on a Ray cluster, and write a table of results.

    Args:
        inputs: as `list_blocks` takes them.
        labelling: how scans are labelled, and where the results go.
        address: as `connect` takes it.
        workers: their numbers; None means as many as the cluster has GPUs, or four cores for.
        resume: go on with an earlier run into the same folder.
        overwrite: write into a folder that has other files.
        say: is told what was assumed of the sensors, and at the end how sure the labels are.

    Returns:
        The number of scans with labels, with those of the run that is resumed.

    Raises:
        InputError: before anything is computed, if an input or the output folder cannot be used, or
            the earlier run had other settings; while scans are listed, if two have the same name;
            at the end, if all are broken.
        SomeBroken: at the end, if some scans are broken.
        OSError: if labels cannot be written.
    """
    out = Place.of(labelling.out)
    _check_inputs(inputs, out, labelling)
    _check_address(address)
    blocks = list_blocks(inputs)
    first = next(blocks)  # raises if there is no scan
    results = Results(out, labelling.settings, resume, overwrite)

    connect(address)
    pool = pool_size(labelling, workers)
    run = FleetRun(labelling, results, *pool, progress=progress, say=say)
    try:
        run.label(chain([first], blocks))
    finally:
        results.flush()
    return run.finish()


def connect(address: str | None = None) -> None:
    """Connect this process to a Ray cluster, unless it is already.

    Args:
        address: such as `auto` or `ray://HOST:10001`; None starts Ray on this machine.

    Raises:
        InputError: if there is no cluster at the address.
    """
    if ray.is_initialized():
        return
    options: dict[str, Any] = {"log_to_driver": False, "logging_level": logging.CRITICAL}
    if address is None:
        options |= {"address": "local", "include_dashboard": False}
        options["object_store_memory"] = OBJECT_STORE
    else:
        options["address"] = address

    context = ray.data.DataContext.get_current()
    context.enable_progress_bars = False
    context.print_on_execution_start = False
    context.max_errored_blocks = -1  # what they should have given is noticed, and tried again
    logging.getLogger("ray.data").setLevel(logging.CRITICAL)
    warnings.filterwarnings("ignore", module=r"ray\.")
    warnings.filterwarnings("ignore", category=ray.util.annotations.RayDeprecationWarning)
    try:
        with _own_signals():
            ray.init(**options)
    except Exception as error:  # Ray raises this class itself
        reason = (str(error) or type(error).__name__).splitlines()[0]
        raise InputError(
            f"--ray {address or ''}: expected a Ray cluster, found {reason}; start one with "
            "ray start --head, or leave the address out"
        ) from None


@contextmanager
def _own_signals() -> Iterator[None]:
    """Keep the handlers of signals: Ray's would abort the process without a word."""
    handlers = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    yield
    if threading.current_thread() is threading.main_thread():
        for number, handler in handlers.items():
            signal.signal(number, handler)


def _check_address(address: str | None) -> None:
    """Raise InputError if a text is no address: it may be an input that follows --ray."""
    if address is not None and not ADDRESS.fullmatch(address):
        raise InputError(
            f"--ray: expected an address such as auto or ray://HOST:10001, found {address!r}; "
            "name the inputs before --ray"
        )


def _check_inputs(inputs: Sequence[str], out: Place, labelling: Labelling) -> None:
    """Check what can be told without listing.

    Raises:
        InputError: if an input is a dataset, or what is written among the scans looks like scans.
    """
    looks_like_scans = labelling.kind != "label" or labelling.scores or labelling.uncertain
    for text in inputs:
        if is_dataset(text):
            raise InputError(
                f"{text}: expected scan files for --ray, found a dataset; segment it without --ray"
            )
        url = Place.of(text).url
        if looks_like_scans and f"{out.url}/".startswith(f"{url}/"):
            raise InputError(
                f"{out.url}: expected a folder outside the inputs, found one in {url}; change --out"
            )


def pool_size(labelling: Labelling, workers: Workers | None) -> tuple[Workers, dict[str, float]]:
    """Return how many workers there are, and what each needs, as options of Ray.

    There is one for each GPU, or else for each few cores, unless the user says the numbers.

    Raises:
        InputError: if the device is a GPU, and the cluster has none.
    """
    available = ray.cluster_resources()
    cores = int(available.get("CPU", 1))
    gpus = int(available.get("GPU", 0))
    if labelling.device.startswith("cuda") and not gpus:
        raise InputError("--device: expected a cluster with a GPU, found none; leave it out")
    if gpus and labelling.device != "cpu":
        return workers or (1, gpus), {"num_gpus": 1, "num_cpus": 1}

    each = max(min(CORES, cores // (workers or (1, 1))[1]), 1)
    return workers or (1, max(cores // each, 1)), {"num_cpus": each}


class FleetRun:
    """A run over the blocks of a fleet, in windows that Ray Data executes.

    Args:
        labelling: how scans are labelled.
        results: takes the rows; has what an earlier run has done.
        workers: the least and the largest number of them.
        resources: what each needs, as options of Ray.

    Attributes:
        first: the first scans of each drive that is not measured yet.
    """

    def __init__(
        self,
        labelling: Labelling,
        results: Results,
        workers: Workers,
        resources: Mapping[str, float],
        progress: Progress = no_progress,
        say: Say = say_nothing,
    ) -> None:
        self.labelling = labelling
        self.results = results
        self.workers = workers
        self.resources = resources
        self._progress = progress
        self._say = say
        self._names = NameSet()
        self.first: dict[str, list[Row]] = {}  # scans of drives that are not measured
        self._planned = 0
        self._labelled = 0
        self._broken = 0
        self._faults: list[str] = []
        self._points: Counter[str] = Counter()  # by sensor
        self._uncertain: Counter[str] = Counter()

    def label(self, blocks: Iterable[Block]) -> None:
        """Label the scans that are not done.

        Raises:
            InputError: if two scans have the same name, or the workers cannot be started.
            OSError: if labels cannot be written.
        """
        for window in windows(self.plan(blocks), WINDOW):
            self._measure()
            lost = self._run(window)
            # Workers have ended: with one scan at a time, it is known which one ends them.
            lost = self._run([scan for block in lost for scan in block.singly()], queued=1)
            for block in lost:
                self._take(self._given_up(block))

    def plan(self, blocks: Iterable[Block]) -> Iterator[Block]:
        """Yield the scans that are not done, and note the first scans of new drives.

        Raises:
            InputError: if two scans have the same name.
        """
        for block in blocks:
            is_new = self._names.add(block.names)
            if not is_new.all():
                name = block.names[int(is_new.argmin())]
                raise InputError(
                    f"expected scans of different names, found {name} twice; "
                    "label them in two runs with two folders"
                )
            if block.drive not in self.results.drives and block.drive not in self.first:
                self.labelling.sensor_named(block.sensor)  # raises if it is unknown
                self.first[block.drive] = block.rows()[:MEASURED]

            remaining = block.select(~self.results.done.has(block.names))
            self._planned += len(remaining.names)
            if remaining.names:
                yield remaining

    def _measure(self) -> None:
        """Measure the drives of which only the first scans are known, and write them down."""
        measure = ray.remote(num_cpus=1, max_retries=RETRIES)(measure_drive)
        labelling = ray.put(self.labelling)
        jobs = {drive: measure.remote(labelling, rows) for drive, rows in self.first.items()}
        rows = []
        for drive, job in jobs.items():
            try:
                rows.append(ray.get(job))
            except ray.exceptions.WorkerCrashedError:
                rows.append(describe_drive(drive, self.first[drive][0]["sensor"], "", []))
        self.results.drives.add(rows)
        self.first.clear()

        for row in rows[:SAID]:
            self._say(row["assumed"] or f"{row['drive']}: expected scans to measure, found none")
        if len(rows) > SAID:
            place = self.results.folder / DRIVES
            self._say(f"what is assumed of {len(rows) - SAID} more drives is in {place.url}")

    def _run(self, blocks: Sequence[Block], queued: int = 2) -> list[Block]:
        """Label the scans of some blocks; return those whose workers have ended.

        Args:
            queued: blocks that a worker has at a time; if it ends, all of them may be lost.

        Raises:
            InputError: if the workers cannot be started.
            OSError: if labels cannot be written.
        """
        if not blocks:
            return []
        tables = [self.to_table(block) for block in blocks]
        least, most = self.workers
        pool = ray.data.ActorPoolStrategy(
            min_size=min(least, len(blocks)),
            max_size=most,
            max_tasks_in_flight_per_actor=queued,
        )
        dataset = ray.data.from_blocks(tables).map_batches(
            LabelScans,
            fn_constructor_args=[self.labelling],
            batch_size=None,
            batch_format="pyarrow",
            compute=pool,
            max_restarts=-1,
            max_task_retries=RETRIES,
            **self.resources,
        )
        labelled: set[str] = set()
        try:
            for rows in dataset.iter_batches(batch_size=None, batch_format="pyarrow"):
                labelled.update(rows["scan"].to_pylist())
                self._take(rows)
        except ray.exceptions.RayError as error:
            raise InputError(_reason(error)) from error

        lost = []
        for block in blocks:
            rest = block.select(np.array([name not in labelled for name in block.names]))
            if rest.names:
                lost.append(rest)
        return lost

    def to_table(self, block: Block) -> pa.Table:
        """Return a block as `LabelScans` takes it."""
        estimates = self.results.drives[block.drive]["estimates"]
        alike = {"drive": block.drive, "sensor": block.sensor, "estimates": estimates}
        columns = {key: pa.repeat(value, len(block.names)) for key, value in alike.items()}
        return pa.table({"path": list(block.urls), "name": list(block.names), **columns})

    def _take(self, rows: pa.Table) -> None:
        """Add rows to the results, and count them.

        Raises:
            OSError: if one says that labels cannot be written.
        """
        is_fatal = rows["is_fatal"]
        self.results.add(rows.filter(pc.invert(is_fatal)).drop_columns(["is_fatal"]))
        for line in rows["error"].filter(is_fatal).to_pylist():
            place, _, reason = line.rpartition(": ")
            raise OSError(errno.EIO, reason, place)

        for row in rows.select(["error", "sensor", "points", "uncertain"]).to_pylist():
            if row["error"] is not None:
                self._broken += 1
                self._faults += [row["error"]][: MOST_FAULTS - len(self._faults)]
                continue
            self._labelled += 1
            self._points[row["sensor"]] += row["points"]
            self._uncertain[row["sensor"]] += round(row["uncertain"] * row["points"])
        self._progress(self._labelled + self._broken, self._planned)

    def _given_up(self, block: Block) -> pa.Table:
        """Return the rows of scans that end the workers that read them."""
        rows = []
        for row in block.rows():
            line = (
                f"{row['path']}: expected a scan, found a file that ends its reader; leave it out"
            )
            place = {"scan": row["name"], "drive": row["drive"], "path": row["path"]}
            rows.append(place | {"error": line, "is_fatal": False})
        return pa.Table.from_pylist(rows, results_schema(self.labelling.taxonomy))

    def finish(self) -> int:
        """Say how sure the labels are; return the number of scans with labels.

        Raises:
            InputError: if all scans are broken.
            SomeBroken: if some are.
        """
        entries = []
        for sensor, points in self._points.items():
            entries.append(Entry("", "", sensor, points, self._uncertain[sensor]))
        if METHODS[self.labelling.method].has_two_networks:
            report(entries, self.labelling.usual_uncertain, self._say)

        total = len(self._names)
        if self._broken == total:
            others = total - 1
            more = f" (and {others} more scans, each broken)" if others else ""
            raise InputError(self._faults[0] + more)
        if self._broken:
            line = f"{total - self._broken} of {total} scans segmented, {self._broken} broken"
            raise SomeBroken(line, self._faults)
        return total


def _reason(error: BaseException) -> str:
    """Return the line of an error on a worker, without its traceback."""
    lines = [line.strip() for line in str(error).splitlines() if line.strip()]
    own = [line for line in lines if "InputError: " in line]
    if own:
        return own[-1].rpartition("InputError: ")[2]
    return f"--ray: expected workers that run, found {lines[-1] if lines else error!r}"
