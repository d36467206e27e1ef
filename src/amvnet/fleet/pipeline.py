"""Label a fleet of scans with a pipeline of Ray Data on a Ray cluster."""

from __future__ import annotations

import errno
import logging
import os
import re
import signal
import threading
import warnings
from collections import Counter
from collections.abc import Generator, Iterator, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass, replace
from itertools import chain
from operator import itemgetter
from typing import Any

import pyarrow as pa
import pyarrow.compute as pc

from amvnet.engines.compute import Compute, choose_precision
from amvnet.errors import InputError, reason_of
from amvnet.fleet.labelling import DEFAULTS, IS_FATAL, LabelScans, MeasureSensors
from amvnet.fleet.labelling import choose_weights as choose_for_drive
from amvnet.fleet.manifest import NameSet, list_scans
from amvnet.fleet.results import DRIVES, DRIVES_SCHEMA, Results, describe_drive, results_schema
from amvnet.fleet.storage import Place
from amvnet.inference.journal import Entry
from amvnet.inference.pipeline import check_faults
from amvnet.inference.predict import report_certainty
from amvnet.inference.request import LabellingRequest
from amvnet.progress import Progress, Reporter, no_progress, report_nothing
from amvnet.sensors.measure import MEASURED_SCANS
from amvnet.sensors.reading import Reading

os.environ.setdefault("RAY_BACKEND_LOG_LEVEL", "fatal")  # Ray's C++ code prints to stderr
# Workers get the niceness of `predict`; Ray's default is 15.
os.environ.setdefault("RAY_worker_niceness", "0")
os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")  # a Ray that starts here reports nothing
import ray
import ray.data
from ray.exceptions import RayError

WINDOW = 256_000  # number of scans that are planned together
BLOCK = 64  # number of scans that a worker takes at a time
REPORTED_DRIVES = 10  # largest number of drives whose assumptions are printed

# The shared memory of a Ray that starts on this machine, bytes.
OBJECT_STORE = 500_000_000
WORKER_CORES = 4  # largest number of cores of a worker without a GPU
# Largest number of blocks that a worker has at a time; with two, it need not wait for the next one.
WORKER_BLOCKS = 2
RETRIES = 2  # number of times that a block is tried again after its worker has ended
MAX_LOST_BLOCKS = 100  # largest number of blocks in a window that may end their workers
ADDRESS = re.compile(r"auto|local|(ray://)?[\w.\-\[\]]+:\d+")


@dataclass(frozen=True)
class Cluster:
    """The workers of a run.

    Attributes:
        address: the address of a Ray cluster, such as `auto` or `ray://HOST:10001`; by default, Ray
            is started on this machine.
        workers: the largest number of workers; by default, Ray starts as many workers as the
            cluster has room for.
    """

    address: str | None = None
    workers: int | None = None
    compute: Compute = DEFAULTS
    batch: int = 1


def label_fleet(
    inputs: Sequence[str],
    request: LabellingRequest,
    out: str,
    cluster: Cluster,
    *,
    resume: bool = False,
    progress: Progress = no_progress,
    report: Reporter = report_nothing,
) -> int:
    """Label scan files on a Ray cluster, and write a table of results.

    Args:
        report: takes lines about what was assumed of the sensors, and how sure the labels are.

    Returns:
        The number of label files of these scans that exist, counted in the output folder.

    Raises:
        InputError: if an input or the output folder cannot be used, the earlier run had another
            request, the workers cannot run, or all scans are broken; or if two scans have the same
            name (earlier windows are then labelled).
        SomeBroken: if some scans are broken; all others are then labelled.
        OSError: if labels cannot be written.
    """
    place = Place.of(out)
    tables = list_scans(inputs, place)
    first = next(tables)  # raises before a cluster is started
    connect(cluster.address)
    resources = share_cluster(cluster)
    request = replace(request, precision=_precision(request, cluster, resources))
    results = Results(place, request, resume=resume)

    run = FleetRun(request, results, cluster, resources, progress, report)
    try:
        for window in _windows(chain([first], tables)):
            remaining = run.plan(window)
            run.measure(window)
            run.label(remaining)
    finally:
        results.flush()
    return run.finish()


def choose_weights(inputs: Sequence[str], out: str, reading: Reading) -> tuple[str, str]:
    """Return the name of the built-in weights for the first drive, and in words why these.

    Raises:
        InputError: if an input or the output folder cannot be used.
    """
    table = next(list_scans(inputs, Place.of(out)))
    drive = table.filter(pc.equal(table["drive"], table["drive"][0]))
    return choose_for_drive(drive.slice(0, MEASURED_SCANS).to_pylist(), reading)


def _windows(tables: Iterator[pa.Table]) -> Iterator[pa.Table]:
    """Yield joined tables of at least `WINDOW` scans; the last one may have fewer scans."""
    waiting: list[pa.Table] = []
    for table in tables:
        waiting.append(table)
        if sum(map(len, waiting)) >= WINDOW:
            yield pa.concat_tables(waiting)
            waiting.clear()
    if waiting:
        yield pa.concat_tables(waiting)


@dataclass(eq=False)
class FleetRun:
    """A run over the scans of a fleet, window by window: plan, measure the drives, label.

    Attributes:
        progress: called with the number of scans that are done, and their total so far.
    """

    request: LabellingRequest
    results: Results
    cluster: Cluster
    resources: dict[str, Any]
    progress: Progress = no_progress
    report: Reporter = report_nothing

    def __post_init__(self) -> None:
        self._paths = NameSet()  # names of the files that are written
        self._names = NameSet()  # names of the scans
        self._planned = 0  # number of scans to label in all windows so far
        self._done = 0

    def plan(self, window: pa.Table) -> pa.Table:
        """Return the scans that are not done; raise InputError if two would write the same file."""
        names = window["name"].to_pylist()
        for ending in self.request.files.endings:
            is_new = self._paths.add([f"{name}{ending}" for name in names])
            if not is_new.all():
                raise InputError(
                    f"expected scans of different names, found {names[is_new.argmin()]} twice; "
                    "label them in two runs with two folders"
                )
        self._names.add(names)
        remaining = window.filter(~self.results.done.has(names))
        self._planned += len(remaining)
        return remaining

    def measure(self, window: pa.Table) -> None:
        """Measure the drives that are new in a window, and write their table."""
        first: dict[str, list[int]] = {}  # the first scans of each drive
        for index, drive in enumerate(window["drive"].to_pylist()):
            if drive not in self.results.estimates:
                scans = first.setdefault(drive, [])
                if len(scans) < MEASURED_SCANS:
                    scans.append(index)
        if not first:
            return

        size = max(BLOCK // MEASURED_SCANS, 1)  # number of drives in a block
        drives = list(first.values())
        groups = [drives[start : start + size] for start in range(0, len(drives), size)]
        blocks = [window.take(list(chain.from_iterable(group))) for group in groups]
        rows = {drive: describe_drive(drive, "", None) for drive in first}
        workers = self._on_workers(MeasureSensors, (self.request,), blocks, {"num_cpus": 1})
        for table in workers:
            rows |= {row["drive"]: row for row in table.to_pylist()}
        self.results.add_drives(pa.Table.from_pylist(list(rows.values()), DRIVES_SCHEMA))
        self._report_assumptions(sorted(rows.values(), key=itemgetter("drive")))

    def _report_assumptions(self, rows: Sequence[dict[str, Any]]) -> None:
        """Report what is assumed of the sensors of some drives, given by their rows."""
        for row in rows[:REPORTED_DRIVES]:
            self.report(row["assumed"] or f"{row['drive']}: expected scans to measure, found none")
        more = len(rows) - REPORTED_DRIVES
        if more > 0:
            place = self.results.folder / DRIVES
            self.report(f"what is assumed of {more} more drives is in {place.url}")

    def label(self, scans: pa.Table) -> None:
        """Label scans of drives that are measured.

        Raises:
            InputError: if the workers cannot run.
            OSError: if labels cannot be written.
        """
        lost = self._label_in_blocks(_with_estimates(scans, self.results.estimates), BLOCK)
        # Some of these scans end their workers. Label them one by one to find out which.
        lost = self._label_in_blocks(lost, 1)
        if len(lost):
            self._add_rows(self._rows_of_lost(lost))

    def _label_in_blocks(self, scans: pa.Table, size: int) -> pa.Table:
        """Label scans in blocks of a size; return the scans whose workers have ended."""
        blocks = [scans.slice(start, size) for start in range(0, len(scans), size)]
        if not blocks:
            return scans
        cluster = self.cluster
        arguments = (self.request, self.results.out.address, cluster.compute, cluster.batch)
        done: set[str] = set()
        max_lost = MAX_LOST_BLOCKS if size > 1 else len(blocks)
        tables = self._on_workers(LabelScans, arguments, blocks, self.resources, max_lost)
        with closing(tables):
            for rows in tables:
                done.update(rows["scan"].to_pylist())
                self._add_rows(rows)
        return scans.filter(pa.array([name not in done for name in scans["name"].to_pylist()]))

    def _add_rows(self, rows: pa.Table) -> None:
        """Add rows to the results; raise OSError if a row says that labels cannot be written."""
        is_fatal = rows[IS_FATAL.name]
        self.results.add(rows.filter(pc.invert(is_fatal)).drop_columns([IS_FATAL.name]))
        for line in rows["error"].filter(is_fatal).to_pylist():
            place, _, reason = line.rpartition(": ")
            raise OSError(errno.EIO, reason, place)

        self._done += len(rows)
        self.progress(self._done, self._planned)

    def _rows_of_lost(self, scans: pa.Table) -> pa.Table:
        """Return the rows of scans that end every worker that reads them."""
        rows = []
        for scan in scans.to_pylist():
            path = Place.of(scan["path"]).url
            line = f"{path}: expected a scan, found a file that ends its reader; leave it out"
            row = {"scan": scan["name"], "drive": scan["drive"], "path": path, "error": line}
            rows.append(row | {IS_FATAL.name: False})
        return pa.Table.from_pylist(rows, results_schema(self.request.taxonomy).append(IS_FATAL))

    def _on_workers(
        self,
        kind: type[LabelScans] | type[MeasureSensors],
        arguments: tuple[Any, ...],
        blocks: Sequence[pa.Table],
        resources: dict[str, Any],
        max_lost: int = -1,
    ) -> Generator[pa.Table]:
        """Yield the table that a worker returns for each block, except for lost blocks.

        A block is lost if every worker that takes it ends; at most `max_lost` may be, or any number
        if this is -1.
        """
        context = ray.data.DataContext.get_current()
        context.enable_progress_bars = False
        context.max_errored_blocks = max_lost
        # If a worker ends, the blocks that wait for it are lost as well. Blocks of one scan
        # therefore never wait.
        queued = WORKER_BLOCKS if max(map(len, blocks)) > 1 else 1
        workers = self.cluster.workers
        dataset = ray.data.from_arrow(list(blocks)).map_batches(
            Worker,
            fn_constructor_args=(kind, ray.put(arguments)),
            batch_size=None,
            batch_format="pyarrow",
            compute=ray.data.ActorPoolStrategy(
                min_size=1,
                max_size=None if workers is None else min(workers, len(blocks)),
                max_tasks_in_flight_per_actor=queued,
            ),
            max_task_retries=RETRIES,
            **resources,
        )
        try:
            yield from dataset.iter_batches(batch_size=None, batch_format="pyarrow")
        except RayError as error:
            raise InputError(_reason(error)) from error

    def finish(self) -> int:
        """Report how sure the labels are; return the number of label files that exist.

        Raises:
            InputError: if all scans are broken.
            SomeBroken: if some scans are broken.
        """
        faults: list[str] = []
        written = 0
        points: Counter[str] = Counter()  # by drive
        uncertain: Counter[str] = Counter()
        for _, table, is_done in self.results.read():
            is_ours = self._names.has(table["scan"].to_pylist())
            written += int((is_ours & is_done).sum())
            columns = ["path", "labels", "drive", "points", "uncertain", "error"]
            rows = table.select(columns).filter(pa.array(is_ours)).to_pylist()
            for row, has_labels in zip(rows, is_done[is_ours], strict=True):
                if has_labels:
                    points[row["drive"]] += row["points"]
                    uncertain[row["drive"]] += round(row["uncertain"] * row["points"])
                else:
                    lost = f"{row['path']}: expected its labels in {row['labels']}, found none; "
                    faults.append(row["error"] or f"{lost}label it again with --resume")

        usual = self.request.weights.usual_uncertain_at(self.request.tau)
        drives = [Entry("", "", drive, points[drive], uncertain[drive], []) for drive in points]
        report_certainty(drives, self.request.method, usual, self.report)
        check_faults(faults, len(self._names))
        return written


class Worker:
    """An actor of Ray Data, whose `arguments` Ray copies to each machine once."""

    def __init__(self, kind: type[LabelScans] | type[MeasureSensors], arguments: Any) -> None:
        self.work = kind(*ray.get(arguments))

    def __call__(self, batch: pa.Table) -> pa.Table:
        """Return the table that the worker makes of a table of scans."""
        return self.work(batch)


def _with_estimates(scans: pa.Table, estimates: dict[str, str]) -> pa.Table:
    """Return scans with the column `estimates`, grouped by drive, as `LabelScans` takes them."""
    order: dict[str, list[int]] = {}
    for index, drive in enumerate(scans["drive"].to_pylist()):
        order.setdefault(drive, []).append(index)
    scans = scans.take(pa.array(chain.from_iterable(order.values()), pa.int64()))
    drive_estimates = [estimates[drive] for drive in scans["drive"].to_pylist()]
    column = pa.array(drive_estimates, pa.string())
    return scans.append_column("estimates", column).combine_chunks()


# ---- Ray


def connect(address: str | None = None) -> None:
    """Connect this process to the cluster of an address (`Cluster`), unless it is connected.

    Raises:
        InputError: if the text is not an address, or no cluster has it.
    """
    if address is not None and not ADDRESS.fullmatch(address):
        raise InputError(
            f"--address: expected an address such as auto or ray://HOST:10001, found {address!r}; "
            "leave it out to start Ray on this machine"
        )

    warnings.filterwarnings("ignore", module=r"ray\.")
    # Without max_task_retries, Ray Data would try a scan that ends its workers for ever.
    warnings.filterwarnings("ignore", message="`ray_remote_args` is deprecated")
    if ray.is_initialized():
        return
    options: dict[str, Any] = {"address": address or "local"}
    if address is None:
        options |= {"include_dashboard": False, "object_store_memory": OBJECT_STORE}

    try:
        with _own_signals():
            ray.init(**options, log_to_driver=False, logging_level=logging.CRITICAL)
    except Exception as error:  # Ray raises this class itself
        raise InputError(
            f"--address {address or ''}: expected a Ray cluster, found {reason_of(error)}; start "
            "one with ray start --head, or leave the address out"
        ) from None
    for name in ("ray.data", "ray.data._internal"):
        logging.getLogger(name).setLevel(logging.CRITICAL)


@contextmanager
def _own_signals() -> Iterator[None]:
    """Restore the signal handlers: Ray's handlers would abort the process without a message."""
    handlers = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    is_stopped = False
    try:
        yield
    except SystemExit:  # by Ray's handler of SIGTERM, while Ray starts
        is_stopped = True
    if threading.current_thread() is threading.main_thread():
        for number, handler in handlers.items():
            signal.signal(number, handler)
    if is_stopped:
        signal.raise_signal(signal.SIGTERM)


def share_cluster(cluster: Cluster) -> dict[str, Any]:
    """Return the resources of each worker, as options of Ray: a GPU or, without GPUs, some cores.

    Raises:
        InputError: if the device is a GPU, and the cluster has none.
    """
    available = ray.cluster_resources()
    cores = int(available.get("CPU", 1))
    gpus = int(available.get("GPU", 0))
    device = cluster.compute.device
    if device.startswith("cuda") and not gpus:
        raise InputError("--device: expected a cluster with a GPU, found none; leave it out")
    if gpus and device != "cpu":
        return {"num_gpus": 1, "num_cpus": 1}
    node_cores = [int(node["Resources"].get("CPU", 0)) for node in ray.nodes() if node["Alive"]]
    # Some clusters start without any node for workers.
    smallest = min(filter(None, node_cores), default=WORKER_CORES)
    return {"num_cpus": max(min(WORKER_CORES, smallest, cores // (cluster.workers or 1)), 1)}


def _precision(request: LabellingRequest, cluster: Cluster, resources: dict[str, Any]) -> Any:
    """Return the precision of all workers; with GPUs, a worker chooses it for "auto"."""
    if request.precision != "auto" or "num_gpus" not in resources:
        return choose_precision(request.precision, "cpu")
    device = cluster.compute.device
    choose = ray.remote(**resources)(choose_precision)
    return ray.get(choose.remote("auto", "cuda" if device == "auto" else device))


def _reason(error: BaseException) -> str:
    """Return the line of an error on a worker, without its traceback."""
    lines = [line.strip() for line in str(error).splitlines() if line.strip()]
    own = [line for line in lines if "InputError: " in line]
    if own:
        return own[-1].rpartition("InputError: ")[2]
    reason = lines[-1] if lines else repr(error)
    return f"expected workers that run, found {reason[:200]}; check the logs of the cluster"
