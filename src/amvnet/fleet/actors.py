"""Label scan files on the workers of a cluster; the callables that Ray Data runs."""

from __future__ import annotations

import hashlib
import os
import socket
import time
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import cached_property, partial
from itertools import groupby
from operator import itemgetter
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import pyarrow as pa

from amvnet import load
from amvnet.config.bounds import Checked, Count
from amvnet.data.class_maps import ClassMap
from amvnet.data.formats.cloud import Cloud
from amvnet.data.formats.detect import ending_of
from amvnet.data.formats.find import NamedScan
from amvnet.data.formats.registry import read_file
from amvnet.data.formats.rows import UNKNOWN, RowLayout
from amvnet.data.labels.writers import check_kind
from amvnet.data.taxonomy import Taxonomy
from amvnet.errors import InputError
from amvnet.fleet.manifest import split_name
from amvnet.fleet.results import describe_drive, parse_estimate
from amvnet.fleet.storage import Place
from amvnet.inference.listing import FileReader, FileScan
from amvnet.inference.pipeline import Outcome, OutputOptions, Pipeline
from amvnet.inference.predict import segment_by
from amvnet.inference.reading import normaliser_for
from amvnet.inference.scan_stream import AHEAD
from amvnet.inference.segmentation import Segmentation, uncertain_share
from amvnet.models.assertion import Disagreement
from amvnet.models.methods import Compute, MethodName, check_method, check_two_networks
from amvnet.progress import Say, say_nothing
from amvnet.runtime.memory import keep_freed_memory
from amvnet.sensors.lidars import Sensor
from amvnet.weights.file import Weights

TRANSFERS = 8  # files that are read from, or written to, object storage at the same time

UNKNOWN_SENSOR = Sensor()
DEFAULTS = Compute()

Row = dict[str, Any]


@dataclass(frozen=True)
class Labelling(Checked):
    """How the scans of a fleet are labelled, and what is written: the same on every worker.

    Attributes:
        weights: trained weights.
        out: URL or path of the output folder.
        kind: the format of the labels, one of `writers.KINDS`.
        scores: whether to write the probabilities of both networks, too.
        uncertain: whether to write the uncertain points, too.
        method, tau: as `Segmenter` takes them.
        compute: where and how the networks are computed.
        batch: scans that go through the networks together.
        sensor: what is known of the sensor of all scans.
        layout: of rows of numbers without names, what they hold.
        classes: maps the classes of the weights to those that are written; None writes these.

    Raises:
        InputError: if the format is unknown, the method has no uncertain points to write, or a
            number is out of its range.
    """

    weights: Weights
    out: str
    kind: str = "label"
    scores: bool = False
    uncertain: bool = False
    method: MethodName = "amvnet"
    tau: float | None = None
    compute: Compute = DEFAULTS
    batch: Count = 1
    sensor: Sensor = UNKNOWN_SENSOR
    layout: RowLayout = UNKNOWN
    classes: ClassMap | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        check_kind(self.kind)
        check_method(self.method, self.weights.parts)
        if self.tau is not None:
            Disagreement(self.tau)
        if self.uncertain:
            check_two_networks(self.method)

    @property
    def taxonomy(self) -> Taxonomy:
        """The classes that are written."""
        return self.weights.taxonomy if self.classes is None else self.classes.target

    @cached_property
    def settings(self) -> dict[str, Any]:
        """What the written files depend on, as JSON types."""
        return {
            "weights": self.weights.digests(),
            "method": self.method,
            "tau": self.tau,
            "precision": self.compute.precision,
            # No other engine changes labels.
            "engine": "int8" if self.compute.engine == "int8" else "",
            "format": self.kind,
            "scores": self.scores,
            "uncertain": self.uncertain,
            "sensor": repr(self.sensor),
            "layout": repr(self.layout),
            "classes": "" if self.classes is None else repr(self.classes),
        }

    def make_reader(self, say: Say = say_nothing) -> FileReader:
        """Return what reads the scans of a drive."""
        return FileReader(normaliser_for(self.weights, self.sensor, say))


def results_schema(taxonomy: Taxonomy) -> pa.Schema:
    """Return the columns of the table of results for some classes."""
    counts = pa.struct([(name, pa.int32()) for name in taxonomy.classes])
    means = pa.struct([(name, pa.float32()) for name in taxonomy.classes])
    return pa.schema(
        {
            "scan": pa.string(),
            "drive": pa.string(),
            "path": pa.string(),
            "labels": pa.string(),  # URL of the label file
            "points": pa.int32(),  # that are valid
            "uncertain": pa.float32(),  # share of the points
            "class_points": counts,
            "class_uncertain": counts,
            "class_confidence": means,  # of the largest score of each point
            "seconds": pa.float32(),  # of the worker
            "worker": pa.string(),
            "weights": pa.string(),  # digest
            "error": pa.string(),
            "is_fatal": pa.bool_(),  # whether no other scan can be written either
        }
    )


class LabelScans:
    """Labels scan files, for `map_batches` of Ray Data with `batch_format="pyarrow"`.

    A batch has a row for each scan with the columns `path`, `name`, `drive` and `estimates`, of
    which only the first is needed. The column `estimates` holds what `measure` has found out about
    the drive's sensor; without it, the sensor is measured on the first scans of the drive in the
    batch. So scans of one drive should follow one another.
    """

    def __init__(self, labelling: Labelling) -> None:
        self.labelling = labelling
        self._segmenter = load(
            labelling.weights,
            labelling.compute.device,
            labelling.method,
            labelling.compute.precision,
            labelling.compute.engine,
            tau=labelling.tau,
        )
        if labelling.compute.at_once is not None:
            self._segmenter.at_once = labelling.compute.at_once
        if self._segmenter.device == "cpu":
            keep_freed_memory()
        self._schema = results_schema(labelling.taxonomy)
        self._out = Place.of(labelling.out)
        self._worker = f"{socket.gethostname()}:{os.getpid()}"
        digests = "".join(labelling.settings["weights"].values())
        self._digest = hashlib.sha256(digests.encode()).hexdigest()[:16]

    def __call__(self, batch: pa.Table) -> pa.Table:
        """Return the rows of the table of results for the scans of a batch."""
        rows: list[Row] = []
        scans = [_complete(row) for row in batch.to_pylist()]
        for _, scans_of_drive in groupby(scans, key=itemgetter("drive")):
            drive = list(scans_of_drive)
            try:
                rows += self._label(drive)
            except Exception as error:  # a fault in a library, for example
                if len(drive) > 1:
                    raise  # the scans are tried again one by one
                line = f"{drive[0]['path']}: expected a scan, found {type(error).__name__}: {error}"
                rows.append(self._row(drive[0], error=" ".join(line.split())))
        return pa.Table.from_pylist(rows, self._schema)

    def measure(self, scans: pa.Table) -> Row:
        """Measure the sensor of a drive on its first scans; return its row in the table of drives.

        Args:
            scans: a row for each, with the columns `path`, `name` and `drive`.
        """
        rows = scans.to_pylist()
        source = rows[0]["drive"]
        assumed: list[str] = []
        reader = self.labelling.make_reader(assumed.append)
        with self._fetch(rows, reader) as (files, _):
            assert reader.normaliser is not None
            usual = reader.normaliser.measure(source).usual
            for scan in files:
                with suppress(InputError):  # the line about the first scan that can be read
                    scan.load()
                    break
            line = assumed[0].replace(str(scan.path), scan.name) if assumed else ""
        return describe_drive(source, line, usual)

    @contextmanager
    def _fetch(
        self, drive: Sequence[Row], reader: FileReader
    ) -> Iterator[tuple[list[FileScan], Path]]:
        """Yield the scans of a drive, whose files are fetched ahead, and a temporary folder."""
        with (
            TemporaryDirectory(prefix="amvnet-") as temporary,
            ThreadPoolExecutor(TRANSFERS) as pool,
        ):
            scans = []
            for index, row in enumerate(drive):
                folder = Path(temporary, str(index))
                fetching = pool.submit(_fetch_file, row["path"], folder)
                read = partial(_read_fetched, fetching, self.labelling.layout)
                path = folder / Path(row["path"]).name
                scan = NamedScan(row["name"], row["drive"], path, ending="", read=read)
                reader.expect(scan)
                scans.append(FileScan(scan, reader))
            yield scans, Path(temporary, "labels")

    def _label(self, drive: Sequence[Row]) -> list[Row]:
        """Label scans of one drive."""
        start = time.perf_counter()
        labelling = self.labelling
        reader = labelling.make_reader()
        if drive[0]["estimates"]:
            assert reader.normaliser is not None
            reader.normaliser.recall(drive[0]["drive"], parse_estimate(drive[0]["estimates"]))

        with self._fetch(drive, reader) as (scans, folder):
            pipeline = Pipeline(
                scans,
                segment_by(self._segmenter, labelling.classes),
                OutputOptions(
                    self._out.local or folder,
                    labelling.kind,
                    scores=labelling.scores,
                    uncertain=labelling.uncertain,
                ),
                labelling.taxonomy,
                batch=labelling.batch,
                at_once=self._segmenter.at_once,
            )
            row_of = {scan.name: row for scan, row in zip(scans, drive, strict=True)}
            rows = list(pipeline.stream(scans, partial(self._write, pipeline, row_of), AHEAD))

        seconds = (time.perf_counter() - start) / len(drive)
        return [row | {"seconds": seconds} for row in rows]

    def _write(self, pipeline: Pipeline, row_of: Mapping[str, Row], outcome: Outcome) -> Row:
        """Write the files of a scan, the labels last, and return its row of results."""
        scan, loaded, result = outcome
        row = row_of[scan.name]
        if loaded is None or isinstance(result, InputError):
            return self._row(row, error=str(result).replace(str(scan.path), row["path"]))

        paths = list(pipeline.output.files_of(scan))
        try:
            entry = pipeline.write(scan, loaded, result)
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
        counts = statistics(result, self.labelling.taxonomy)
        return self._row(row, labels=labels, points=entry.points, **counts)

    def _row(self, row: Row, **values: Any) -> Row:
        """Return a row of results: what is known of the scan, and some values."""
        return {
            "scan": row["name"],
            "drive": row["drive"],
            "path": row["path"],
            "worker": self._worker,
            "weights": self._digest,
            "is_fatal": False,
            **values,
        }


def _complete(row: Row) -> Row:
    """Return the row of a scan with all columns; what is not known is empty."""
    name = row.get("name") or split_name(Path(row["path"]).name)[0]
    others = {key: row.get(key) or "" for key in ("drive", "estimates")}
    return {"path": row["path"], "name": name, **others}


def statistics(result: Segmentation, taxonomy: Taxonomy) -> Row:
    """Return what the table of results says of the labels of a scan."""
    ids = result.labels
    size = taxonomy.size + 1
    counts = np.bincount(ids, minlength=size)
    uncertain = np.bincount(ids[result.uncertain], minlength=size)
    sums = np.bincount(ids, weights=result.scores.max(axis=1, initial=0), minlength=size)
    means = [total / count if count else None for total, count in zip(sums, counts, strict=True)]

    names = taxonomy.classes
    return {
        "uncertain": uncertain_share(ids, result.uncertain),
        "class_points": dict(zip(names, counts[1:].tolist(), strict=True)),
        "class_uncertain": dict(zip(names, uncertain[1:].tolist(), strict=True)),
        "class_confidence": dict(zip(names, means[1:], strict=True)),
    }


def _fetch_file(url: str, folder: Path) -> Path:
    return Place.of(url).fetch(folder)


def _read_fetched(fetching: Future[Path], layout: RowLayout) -> Cloud:
    path = fetching.result()
    return read_file(path, ending_of(path), layout)
