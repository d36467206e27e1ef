"""Write and read the tables of a fleet: the results of its scans, and its drives."""

from __future__ import annotations

import dataclasses
import json
import re
import time
from collections.abc import Iterator, Mapping
from contextlib import suppress
from io import BytesIO
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet
from pyarrow.fs import FileType

from amvnet.data.taxonomy import Taxonomy
from amvnet.errors import InputError
from amvnet.files import remove_unfinished
from amvnet.fleet.manifest import NameSet
from amvnet.fleet.storage import Place, reaching
from amvnet.inference.journal import changed_settings, check_unchanged
from amvnet.inference.request import LabellingRequest
from amvnet.sensors.frame import Frame
from amvnet.sensors.lasers import SensorGeometry
from amvnet.sensors.measure import Estimate

FOLDER = "results"  # the folder of the tables in the output folder
SETTINGS = "run.json"  # the file with the settings of the run
DRIVES = "drives.parquet"  # the table of drives
PART = re.compile(r"part-(\d{6})\.parquet")  # the names of the parts of the table of results
PART_BYTES = 64 << 20  # the size of the rows in memory from which on a part is written, bytes
PART_SECONDS = 60.0  # the longest time between two parts; a killed run loses as much, seconds

DRIVES_SCHEMA = pa.schema(
    {
        "drive": pa.string(),
        "assumed": pa.string(),
        "height": pa.float64(),  # the height of the sensor over the ground, metres
        "pitch": pa.float64(),  # the rotation that levels the scans, degrees
        "roll": pa.float64(),  # the rotation that levels the scans, degrees
        "estimates": pa.string(),  # all measurements, as JSON
    }
)


def results_schema(taxonomy: Taxonomy) -> pa.Schema:
    """Return the columns of the table of results for some classes."""
    counts = pa.struct([(name, pa.int32()) for name in taxonomy.classes])
    means = pa.struct([(name, pa.float32()) for name in taxonomy.classes])
    return pa.schema(
        {
            "scan": pa.string(),
            "drive": pa.string(),
            "path": pa.string(),
            "labels": pa.string(),  # the URL of the label file
            "points": pa.int32(),  # the number of valid points
            "uncertain": pa.float32(),  # the share of uncertain points, or the entropy
            "class_points": counts,
            "class_uncertain": counts,
            "class_confidence": means,  # the mean of the points' largest scores
            "seconds": pa.float32(),  # the time that the worker took
            "worker": pa.string(),
            "weights": pa.string(),  # a digest of the weights
            "error": pa.string(),
        }
    )


class Results:
    """The table of results in an output folder, and the table of drives.

    The table of results has the parts `results/part-000000.parquet` and so on. A part is written
    when it is large enough, or after some time. A scan is done if a part has its row without an
    error, and its label file exists. When a run is resumed, the rows of all other scans are
    removed, so that each scan has one row.

    Attributes:
        estimates: the `estimates` of `describe_drive`, for each drive that is measured.

    Raises:
        InputError: if the folder cannot be written or holds something else, or the earlier run had
            another request.
    """

    def __init__(self, out: Place, request: LabellingRequest, resume: bool = False) -> None:
        self.out = out
        self.folder = out / FOLDER
        self.done = NameSet()
        self.estimates: dict[str, str] = {}
        self._schema = results_schema(request.taxonomy)
        self._endings = request.files.endings
        self._pending: list[pa.Table] = []
        self._last = time.monotonic()  # the time at which the last part was written
        self._number = 0  # the number of the next part

        place = self.folder / SETTINGS
        if place.kind() != FileType.File:
            _check_empty(out)
            _write_settings(place, request.settings)
            return
        if not resume:
            raise InputError(
                f"{out.url}: expected a new folder, found the results of an earlier run; say "
                "--resume to continue it, or change --out"
            )
        _check_same(place, request.settings)
        if self.out.local is not None:
            remove_unfinished(self.out.local)
        self._keep_done()
        self._take_estimates(self._read_drives())

    def read(self) -> Iterator[tuple[Place, pa.Table, np.ndarray]]:
        """Yield each part, its table, and (N,) bool: whether the scan of each row is done.

        Raises:
            InputError: if a file in the folder is no table of a fleet.
        """
        present = NameSet()
        label_ending = self._endings[0]
        for prefix, _, files in self.out.walk():
            present.add([f"{prefix}{file}" for file in files if file.endswith(label_ending)])

        for name in self._part_names():
            table = _read(self.folder / name, self._schema)
            is_done = pc.is_null(table["error"]).to_numpy()
            labels = [f"{scan}{label_ending}" for scan in table["scan"].to_pylist()]
            yield self.folder / name, table, is_done & present.has(labels)

    def _part_names(self) -> list[str]:
        """Return the names of the parts; raise InputError if there are any other files."""
        files, _ = self.folder.children()
        names = []
        for file in files:
            match = PART.fullmatch(file)
            if match is not None:
                names.append(file)
                self._number = max(self._number, int(match[1]) + 1)
            elif file not in (SETTINGS, DRIVES) and not file.startswith("."):
                raise InputError(
                    f"{self.folder.url}/{file}: expected only tables of a fleet in this folder, "
                    "found another file; move it away"
                )
        return names

    def _keep_done(self) -> None:
        """Collect the scans that are done, and remove the rows of all other scans."""
        for place, table, is_done in self.read():
            names = table["scan"].filter(is_done).to_pylist()
            is_done[is_done] = self.done.add(names)
            if not is_done.all():
                _replace(place, table.filter(is_done))

    def _read_drives(self) -> pa.Table:
        place = self.folder / DRIVES
        if place.kind() != FileType.File:
            return DRIVES_SCHEMA.empty_table()
        return _read(place, DRIVES_SCHEMA)

    def add_drives(self, drives: pa.Table) -> None:
        """Add rows of drives to their table."""
        _replace(self.folder / DRIVES, pa.concat_tables([self._read_drives(), drives]))
        self._take_estimates(drives)

    def _take_estimates(self, drives: pa.Table) -> None:
        for row in drives.select(["drive", "estimates"]).to_pylist():
            self.estimates[row["drive"]] = row["estimates"]

    def add(self, rows: pa.Table) -> None:
        """Add rows; write a part if it is large enough or the last part is old."""
        if len(rows):
            self._pending.append(rows)
        size = sum(table.nbytes for table in self._pending)
        if size >= PART_BYTES or time.monotonic() - self._last >= PART_SECONDS:
            self.flush()

    def flush(self) -> None:
        """Write all rows that have been added."""
        if self._pending:
            table = pa.concat_tables(self._pending)
            _replace(self.folder / f"part-{self._number:06d}.parquet", table)
            self._number += 1
            self._pending.clear()
        self._last = time.monotonic()


def _read(place: Place, schema: pa.Schema) -> pa.Table:
    with reaching(place.url):
        table = pa.parquet.read_table(BytesIO(place.read()))
    found = ""
    if table.column_names != schema.names:
        found = f"the columns {', '.join(table.column_names)[:200]}"
    else:
        with suppress(pa.ArrowException):
            table = table.cast(schema)
        if table.schema != schema:
            found = "columns of other types"
        elif table.column(0).null_count:
            found = f"a row without {schema.names[0]}"
    if found:
        raise InputError(
            f"{place.url}: expected a table that amvnet fleet has written, found {found}; change "
            "--out, or move the file away"
        )
    return table


def _replace(place: Place, table: pa.Table) -> None:
    if not len(table):
        place.remove()
        return
    buffer = BytesIO()
    pa.parquet.write_table(table, buffer, compression="zstd")
    place.write(buffer.getvalue())


def _check_empty(out: Place) -> None:
    if out.kind() != FileType.Directory:
        return
    files, folders = out.children()
    if files or folders:
        raise InputError(
            f"{out.url}: expected a new folder, found {(files + folders)[0]} in it; change --out"
        )


def _check_same(place: Place, settings: Mapping[str, Any]) -> None:
    content = place.read()
    earlier = None
    with suppress(ValueError, RecursionError):  # no text, no JSON, or a number with too many digits
        earlier = json.loads(content)
    known = earlier if isinstance(earlier, dict) else {}
    check_unchanged(place.url, changed_settings(settings, known), advice="change --out")


def _write_settings(place: Place, settings: Mapping[str, Any]) -> None:
    try:
        place.write(json.dumps(settings).encode())
    except OSError as error:
        if place.local is not None:
            raise
        raise InputError(
            f"{place.url}: expected a place to write to, found {error.strerror}; check the URL "
            "and the credentials"
        ) from None


def describe_drive(drive: str, assumed: str, usual: Estimate | None) -> dict[str, Any]:
    """Return the row of a drive in the table of drives, which all workers and later runs use.

    Args:
        usual: the median of what the first scans show of the sensor; None if they cannot be read,
            or have several sensors.
    """
    frame = Frame() if usual is None else usual.frame
    values = None if usual is None else dataclasses.asdict(usual)
    return {
        "drive": drive,
        "assumed": assumed,
        "height": frame.height,
        "pitch": frame.pitch,
        "roll": frame.roll,
        "estimates": json.dumps(values, default=np.ndarray.tolist),  # keeps all digits
    }


def parse_estimate(text: str) -> Estimate | None:
    """Return the estimate that `describe_drive` wrote; None if there was none."""
    values = json.loads(text)
    if values is None:
        return None
    quantiles = values["quantiles"]
    values["frame"] = Frame(**values["frame"])
    values["lasers"] = SensorGeometry(**values["lasers"])
    values["quantiles"] = None if quantiles is None else np.array(quantiles)
    return Estimate(**values)
