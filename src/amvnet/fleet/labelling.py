"""The work of a fleet's workers: measure the sensors of drives, and label scan files."""

from __future__ import annotations

import os
import socket
import time
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager, suppress
from dataclasses import replace
from functools import partial
from itertools import groupby
from operator import itemgetter
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa

from amvnet.data.datasets.files import ScanFiles
from amvnet.data.formats.cloud import Cloud
from amvnet.data.formats.detect import BAGS, FOLDER, ending_of
from amvnet.data.formats.registry import read_file
from amvnet.data.formats.rows import RowLayout
from amvnet.data.recordings import Recording, ScanFile
from amvnet.data.taxonomy import Taxonomy
from amvnet.engines.compute import Compute
from amvnet.errors import InputError
from amvnet.files import digest, temporary_folder
from amvnet.fleet.manifest import check_outside, split_name
from amvnet.fleet.results import DRIVES_SCHEMA, describe_drive, parse_estimate, results_schema
from amvnet.fleet.secrets import without_secrets
from amvnet.fleet.storage import Place
from amvnet.inference.drive import Broken, Outcome
from amvnet.inference.listing import Inputs
from amvnet.inference.loading import load_with
from amvnet.inference.pipeline import Pipeline
from amvnet.inference.predict import segment_by
from amvnet.inference.request import LabellingRequest
from amvnet.inference.scan_stream import READ_AHEAD
from amvnet.inference.segmentation import Segmentation
from amvnet.runtime.memory import keep_freed_memory
from amvnet.sensors.normalise import Normalised, Normaliser
from amvnet.sensors.reading import Reading

TRANSFERS = 8  # number of files that are fetched from object storage at the same time
# The column that says whether an error stops the run, because no labels can be written.
IS_FATAL = pa.field("is_fatal", pa.bool_())
DEFAULTS = Compute()

Row = dict[str, Any]


class LabelScans:
    """A labeller of scan files, for `map_batches` of Ray Data with `batch_format="pyarrow"`.

    A batch is a table with a row for each scan and the columns `path`, `name`, `drive` and
    `estimates`; only `path` is needed. The column `estimates` holds what `MeasureSensors` has
    measured of the drive's sensor. Without it, the sensor is measured on the first scans of the
    drive in the batch, so scans of one drive should follow one another.

    Args:
        compute: the device, and the number of scans that are computed at the same time. The engine
            and the precision are in the request.

    Raises:
        InputError: if this machine lacks the device, or a library for the engine.
    """

    def __init__(
        self, request: LabellingRequest, out: str, compute: Compute = DEFAULTS, batch: int = 1
    ) -> None:
        self.request = request
        self.batch = batch
        compute = replace(compute, engine=request.engine, precision=request.precision)
        self._segmenter = load_with(compute, request.weights, request.method, request.tau)
        if self._segmenter.device == "cpu":
            keep_freed_memory()
        self._schema = results_schema(request.taxonomy).append(IS_FATAL)
        self._out = Place.of(out)
        self._worker = f"{socket.gethostname()}:{os.getpid()}"
        digests = "".join(request.settings["weights"].values())
        self._digest = digest(digests)

    def __call__(self, batch: pa.Table) -> pa.Table:
        """Label the scans of a batch; return their rows in the table of results."""
        rows: list[Row] = []
        scans = [_complete(row) for row in batch.to_pylist()]
        for _, drive in groupby(scans, key=itemgetter("drive")):
            rows += self._label_or_explain(list(drive))
        return pa.Table.from_pylist(rows, self._schema)

    def _label_or_explain(self, drive: Sequence[Row]) -> list[Row]:
        """Label scans of one drive; if a library fails, label them one by one to find the cause."""
        try:
            return self._label(drive)
        except Exception as error:
            if len(drive) == 1:
                line = str(error)
                if not isinstance(error, InputError):
                    found = f"{type(error).__name__}: {line}"
                    line = f"{_shown_path(drive[0])}: expected a scan, found {found}"
                return [self._row(drive[0], error=" ".join(line.split()))]
        # The sensor is measured on the first scans of the drive, even for a scan on its own.
        estimates = drive[0]["estimates"] or measure(drive, self.request)["estimates"]
        rows = []
        for row in drive:
            rows += self._label_or_explain([row | {"estimates": estimates}])
        return rows

    def _label(self, drive: Sequence[Row]) -> list[Row]:
        start = time.perf_counter()
        for row in drive:
            check_outside(Place.of(row["path"]), self._out)

        request = self.request
        with _fetch(drive, request.reading.layout) as (files, folder):
            known = None
            if drive[0]["estimates"]:
                (recording,) = files.recordings()
                known = (recording, parse_estimate(drive[0]["estimates"]))
            normaliser = Normaliser(request.weights.expects, request.reading.sensor, known=known)
            files = files.with_classes(request.weights.taxonomy)
            scans = files.normalised_by(normaliser).records()
            pipeline = Pipeline(
                scans,
                segment_by(self._segmenter, request.classes),
                request.output(self._out.local or folder),
                batch=self.batch,
                at_once=self._segmenter.at_once,
            )
            row_of = {scan.name: row for scan, row in zip(scans, drive, strict=True)}
            rows = list(pipeline.stream(scans, partial(self._write, pipeline, row_of), READ_AHEAD))

        seconds = (time.perf_counter() - start) / len(drive)
        return [row | {"seconds": seconds} for row in rows]

    def _write(self, pipeline: Pipeline, row_of: Mapping[str, Row], outcome: Outcome) -> Row:
        """Write the files of a scan, the labels last, and return its row of results."""
        scan = outcome.scan
        row = row_of[scan.name]
        if isinstance(outcome, Broken):
            line = str(outcome.error).replace(str(scan.path), _shown_path(row))
            return self._row(row, error=line)

        paths = list(pipeline.output.files.of(scan))
        try:
            entry = pipeline.write(outcome)
            if self._out.local is None:
                for path in reversed(paths):
                    place = self._out / path.as_posix()
                    place.write((pipeline.output.folder / path).read_bytes())
        except InputError as error:
            return self._row(row, error=str(error))
        except OSError as error:
            place_name = error.filename or self._out.url
            return self._row(row, error=f"{place_name}: {error.strerror or error}", is_fatal=True)

        labels = (self._out / paths[0].as_posix()).url
        counts = statistics(outcome.result, self.request.taxonomy)
        return self._row(row, labels=labels, points=entry.points, **counts)

    def _row(self, row: Row, **values: Any) -> Row:
        """Return a row of the table of results, with the scan and some values."""
        return {
            "scan": row["name"],
            "drive": without_secrets(row["drive"]),
            "path": _shown_path(row),
            "worker": self._worker,
            "weights": self._digest,
            "is_fatal": False,
            **values,
        }


class MeasureSensors:
    """A class for `map_batches` that measures the sensors of drives on their first scans."""

    def __init__(self, request: LabellingRequest) -> None:
        self.request = request

    def __call__(self, batch: pa.Table) -> pa.Table:
        """Return a row of the table of drives for each drive of a batch."""
        rows = []
        for _, drive in groupby(batch.to_pylist(), key=itemgetter("drive")):
            rows.append(measure([_complete(row) for row in drive], self.request))
        return pa.Table.from_pylist(rows, DRIVES_SCHEMA)


def measure(drive: Sequence[Row], request: LabellingRequest) -> Row:
    """Measure the sensor of a drive on its first scans; return its row in the table of drives."""
    assumed = ""
    usual = None
    # A scan that cannot be read is reported as broken when it is labelled.
    normaliser = Normaliser(request.weights.expects, request.reading.sensor)
    with suppress(Exception), _fetch(drive, request.reading.layout) as (files, _):
        files = files.normalised_by(normaliser)
        (recording,) = files.recordings()
        assert isinstance(recording, Normalised)
        usual = recording.measured.usual
        for scan, row in zip(files.records(), drive, strict=True):
            with suppress(InputError):  # the first scan that can be read gives the line
                assumed = scan.load().assumed.replace(str(scan.path), _shown_path(row))
                break
    return describe_drive(drive[0]["drive"], assumed, usual)


def choose_weights(drive: Sequence[Row], reading: Reading) -> tuple[str, str]:
    """Return the name of built-in weights for a drive, and why, as `Inputs.choose_weights`."""
    with _fetch(drive, reading.layout) as (scans, _):
        return Inputs([scans], reading).choose_weights()


@contextmanager
def _fetch(drive: Sequence[Row], layout: RowLayout) -> Iterator[tuple[ScanFiles, Path]]:
    """Yield the scans of a drive and a temporary folder for labels; fetch the files ahead."""
    recording = Recording(drive[0]["drive"])
    with temporary_folder() as temporary, ThreadPoolExecutor(TRANSFERS) as pool:
        for index, row in enumerate(drive):
            folder = temporary / str(index)
            place = Place.of(row["path"])
            path = place.local or folder / Path(place.path).name
            read = partial(_read_fetched, pool.submit(place.fetch, folder), layout)
            name = row["name"]
            scan = ScanFile(name, recording, path, prediction=f"{name}.label", read=read)
            recording.scans.append(scan)
        yield ScanFiles(recording.scans), temporary / "labels"


def _read_fetched(fetching: Future[Path], layout: RowLayout) -> Cloud:
    path = fetching.result()
    ending = ending_of(path)
    if ending in (FOLDER, *BAGS):
        found = "a recording of several scans" if ending in BAGS else "a folder"
        raise InputError(
            f"{path}: expected a file of one scan, found {found}; name the files of scans, or "
            "segment it with amvnet predict"
        )
    return read_file(path, ending, layout)


def _complete(row: Row) -> Row:
    name = row.get("name") or split_name(Path(row["path"]).name)[0]
    others = {key: row.get(key) or "" for key in ("drive", "estimates")}
    return {"path": row["path"], "name": name, **others}


def _shown_path(row: Row) -> str:
    """Return the URL of a scan without credentials, to show and to store."""
    return without_secrets(row["path"])


def statistics(result: Segmentation, taxonomy: Taxonomy) -> Row:
    """Return the statistics of a scan's labels for the table of results, by column."""
    ids = result.labels
    size = taxonomy.size + 1
    counts = np.bincount(ids, minlength=size)
    uncertain = np.bincount(ids[result.uncertain], minlength=size)
    sums = np.bincount(ids, weights=result.scores.max(axis=1, initial=0), minlength=size)
    means = [total / count if count else None for total, count in zip(sums, counts, strict=True)]

    names = taxonomy.classes
    return {
        "uncertain": result.doubt,
        "class_points": dict(zip(names, counts[1:].tolist(), strict=True)),
        "class_uncertain": dict(zip(names, uncertain[1:].tolist(), strict=True)),
        "class_confidence": dict(zip(names, means[1:], strict=True)),
    }
