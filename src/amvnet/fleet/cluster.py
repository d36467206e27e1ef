"""Label a fleet of scans on a Ray cluster."""

from __future__ import annotations

import errno
from collections import Counter
from collections.abc import Sequence
from contextlib import closing
from itertools import chain, islice
from operator import itemgetter

import pyarrow as pa
import pyarrow.compute as pc

from amvnet.data.datasets.open import is_dataset
from amvnet.errors import InputError
from amvnet.fleet.actors import Labelling, Row, results_schema
from amvnet.fleet.manifest import NameSet, list_blocks
from amvnet.fleet.results import DRIVES, Results, describe_drive
from amvnet.fleet.storage import Place
from amvnet.fleet.workers import QUEUED, Workers, connect
from amvnet.inference.journal import Entry
from amvnet.inference.pipeline import check_faults
from amvnet.inference.predict import report
from amvnet.models.methods import METHODS
from amvnet.progress import Progress, Say, no_progress, say_nothing
from amvnet.sensors.measure import MEASURED

WINDOW = 4_000  # blocks that are planned together, up to 256,000 scans
SAID = 10  # drives whose assumptions are printed


def label_fleet(
    inputs: Sequence[str],
    labelling: Labelling,
    address: str | None = None,
    most: int | None = None,
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
        most: number of workers, as `Workers` takes it.
        resume: go on with an earlier run into the same folder.
        overwrite: write into a folder that has other files.
        say: takes lines about what was assumed of the sensors, and how sure the labels are.

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
    listing = list_blocks(inputs)
    first = next(listing)  # raises if there is no scan
    connect(address)
    results = Results(out, labelling.settings, resume=resume, overwrite=overwrite)

    with closing(Workers(labelling, most)) as workers:
        run = FleetRun(labelling, results, workers, progress, say)
        blocks = chain([first], listing)
        try:
            while window := list(islice(blocks, WINDOW)):
                remaining = run.plan(window)
                run.measure()
                run.label(remaining)
        finally:
            results.flush()
    return run.finish()


def _check_inputs(inputs: Sequence[str], out: Place, labelling: Labelling) -> None:
    """Raise InputError for datasets, and if what is written among the scans looks like scans."""
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


class FleetRun:
    """A run over the blocks of a fleet, window by window: plan, measure the drives, label.

    Args:
        labelling: how scans are labelled.
        results: takes the rows; has what an earlier run has done.
        workers: measure and label.
    """

    def __init__(
        self,
        labelling: Labelling,
        results: Results,
        workers: Workers,
        progress: Progress = no_progress,
        say: Say = say_nothing,
    ) -> None:
        self.labelling = labelling
        self.results = results
        self.workers = workers
        self._progress = progress
        self._say = say
        self._names = NameSet()
        self._first: dict[str, pa.Table] = {}  # scans of the drives that are not measured
        self._planned = 0
        self._labelled = 0
        self._faults: list[str] = []
        self._points: Counter[str] = Counter()  # by drive
        self._uncertain: Counter[str] = Counter()

    def plan(self, window: Sequence[pa.Table]) -> list[pa.Table]:
        """Return the scans that are not done; raise InputError if two have the same name."""
        names = pa.concat_tables(window)["name"].to_pylist()
        is_new = self._names.add(names)
        if not is_new.all():
            raise InputError(
                f"expected scans of different names, found {names[is_new.argmin()]} twice; "
                "label them in two runs with two folders"
            )

        remaining = []
        for block in window:
            drive = block["drive"][0].as_py()
            if drive not in self.results.drives and drive not in self._first:
                self._first[drive] = block.slice(0, MEASURED)
            is_done = self.results.done.has(block["name"].to_pylist())
            rest = block.filter(~is_done) if is_done.any() else block
            if len(rest):
                remaining.append(rest)
        self._planned += sum(map(len, remaining))
        return remaining

    def measure(self) -> None:
        """Measure the drives that are new in the planned blocks, and write their table."""
        rows = []
        for scans, row in self.workers.run("measure", list(self._first.values())):
            rows.append(row or describe_drive(scans["drive"][0].as_py(), "", None))
        self._first.clear()
        self.results.add_drives(rows)

        rows.sort(key=itemgetter("drive"))
        for row in rows[:SAID]:
            self._say(row["assumed"] or f"{row['drive']}: expected scans to measure, found none")
        if len(rows) > SAID:
            place = self.results.folder / DRIVES
            self._say(f"what is assumed of {len(rows) - SAID} more drives is in {place.url}")

    def label(self, blocks: Sequence[pa.Table]) -> None:
        """Label scans of drives that are measured.

        Raises:
            InputError: if the workers cannot be started.
            OSError: if labels cannot be written.
        """
        lost = self._run([self._with_estimates(block) for block in blocks])
        # A scan in these blocks ends its worker. One scan at a time shows which one.
        singles = [block.slice(index, 1) for block in lost for index in range(len(block))]
        for scan in self._run(singles, queued=1):
            self._take(self._lost_row(scan.to_pylist()[0]))

    def _with_estimates(self, block: pa.Table) -> pa.Table:
        """Return a block as `LabelScans` takes it."""
        estimates = self.results.drives[block["drive"][0].as_py()]["estimates"]
        return block.append_column("estimates", pa.repeat(estimates, len(block)))

    def _run(self, blocks: Sequence[pa.Table], queued: int = QUEUED) -> list[pa.Table]:
        """Label the scans of some blocks; return those whose workers have ended."""
        lost = []
        for block, rows in self.workers.run("__call__", blocks, queued):
            if rows is None:
                lost.append(block)
            else:
                self._take(rows)
        return lost

    def _take(self, rows: pa.Table) -> None:
        """Add rows to the results; raise OSError if one says that labels cannot be written."""
        is_fatal = rows["is_fatal"]
        self.results.add(rows.filter(pc.invert(is_fatal)).drop_columns(["is_fatal"]))
        for line in rows["error"].filter(is_fatal).to_pylist():
            place, _, reason = line.rpartition(": ")
            raise OSError(errno.EIO, reason, place)

        for row in rows.select(["error", "drive", "points", "uncertain"]).to_pylist():
            if row["error"] is not None:
                self._faults.append(row["error"])
                continue
            self._labelled += 1
            self._points[row["drive"]] += row["points"]
            self._uncertain[row["drive"]] += round(row["uncertain"] * row["points"])
        self._progress(self._labelled + len(self._faults), self._planned)

    def _lost_row(self, scan: Row) -> pa.Table:
        """Return the row of a scan that ends every worker that reads it."""
        line = f"{scan['path']}: expected a scan, found a file that ends its reader; leave it out"
        row = {"scan": scan["name"], "drive": scan["drive"], "path": scan["path"], "error": line}
        schema = results_schema(self.labelling.taxonomy)
        return pa.Table.from_pylist([row | {"is_fatal": False}], schema)

    def finish(self) -> int:
        """Say how sure the labels are; return the number of scans with labels.

        Raises:
            InputError: if all scans are broken.
            SomeBroken: if some are.
        """
        entries = []
        for drive, points in self._points.items():
            uncertain = self._uncertain[drive]
            entries.append(Entry("", "", sensor=drive, points=points, uncertain=uncertain))
        if METHODS[self.labelling.method].has_two_networks:
            usual = self.labelling.weights.usual_uncertain_at(self.labelling.tau)
            report(entries, usual, self._say)
        check_faults(self._faults, len(self._names))
        return len(self._names)
