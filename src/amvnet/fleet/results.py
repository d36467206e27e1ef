"""The tables of a fleet: results, in parts that are also its journal, and drives."""

from __future__ import annotations

import dataclasses
import json
import time
from collections.abc import Mapping, Sequence
from contextlib import suppress
from io import BytesIO
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet
from pyarrow.fs import FileType

from amvnet.errors import InputError
from amvnet.fleet.manifest import NameSet
from amvnet.fleet.storage import Place, reaching
from amvnet.inference.journal import check_settings
from amvnet.sensors.frame import Frame
from amvnet.sensors.lasers import SensorGeometry
from amvnet.sensors.measure import Estimate

FOLDER = "results"  # in the output folder
SETTINGS = "run.json"
DRIVES = "drives.parquet"
PART_BYTES = 64 << 20
PART_SECONDS = 60.0  # between two parts; what a killed driver loses

DRIVES_SCHEMA = pa.schema(
    {
        "drive": pa.string(),
        "assumed": pa.string(),
        "height": pa.float64(),  # metres over the ground
        "pitch": pa.float64(),  # degrees that turn the scans level
        "roll": pa.float64(),
        "estimates": pa.string(),  # JSON
    }
)


class Results:
    """The table of results in an output folder, `results/part-000000.parquet` and so on.

    A part is written when it is large enough, or after some time. A scan is done if a part has it
    without an error. Rows with an error are removed when a run is resumed, so that each scan has
    one row.

    Args:
        settings: what the results depend on, as JSON types.
        resume: whether to go on with an earlier run.
        overwrite: whether the folder may hold other files.

    Attributes:
        done: the names of the scans that an earlier run has done.
        drives: the row of each drive, from `describe_drive`.

    Raises:
        InputError: if the folder cannot be written, holds something else, or the earlier run had
            other settings.
    """

    def __init__(
        self, out: Place, settings: Mapping[str, Any], resume: bool = False, overwrite: bool = False
    ) -> None:
        self.folder = out / FOLDER
        self.done = NameSet()
        self._pending: list[pa.Table] = []
        self._last = time.monotonic()  # when the last part was written
        self._number = 0  # of the next part

        self.drives: dict[str, dict[str, Any]] = {}
        place = self.folder / SETTINGS
        if place.kind() == FileType.File:
            if not resume:
                raise InputError(
                    f"{out.url}: expected a new folder, found the results of an earlier run; say "
                    "--resume to go on with it, or change --out"
                )
            _check_same(place, settings)
            self._read_parts()
            self._read_drives()
        else:
            if not overwrite:
                _check_empty(out)
            _write_settings(place, settings)

    def _read_parts(self) -> None:
        """Read which scans are done, and remove the rows of the others."""
        files, _ = self.folder.children()
        for file in files:
            if not file.startswith("part-"):
                continue
            place = self.folder / file
            table = _read(place)
            is_done = pc.is_null(table["error"]).to_numpy()
            is_done[is_done] = self.done.add(table["scan"].filter(is_done).to_pylist())
            if not is_done.all():
                _replace(place, table.filter(is_done))
            self._number = int(file[len("part-") : -len(".parquet")]) + 1

    def _read_drives(self) -> None:
        place = self.folder / DRIVES
        if place.kind() == FileType.File:
            self.drives = {row["drive"]: row for row in _read(place).to_pylist()}

    def add_drives(self, rows: Sequence[dict[str, Any]]) -> None:
        """Add rows of drives, and write the table of all."""
        if not rows:
            return
        self.drives |= {row["drive"]: row for row in rows}
        table = pa.Table.from_pylist(list(self.drives.values()), DRIVES_SCHEMA)
        _replace(self.folder / DRIVES, table)

    def add(self, rows: pa.Table) -> None:
        """Add rows, and write a part if it is time."""
        if len(rows):
            self._pending.append(rows)
        size = sum(table.nbytes for table in self._pending)
        if size >= PART_BYTES or time.monotonic() - self._last >= PART_SECONDS:
            self.flush()

    def flush(self) -> None:
        """Write what has been added."""
        if self._pending:
            table = pa.concat_tables(self._pending)
            _replace(self.folder / f"part-{self._number:06d}.parquet", table)
            self._number += 1
            self._pending.clear()
        self._last = time.monotonic()


def _read(place: Place) -> pa.Table:
    """Return a table; raise InputError if it cannot be read."""
    with reaching(place.url):
        return pa.parquet.read_table(BytesIO(place.read()))


def _replace(place: Place, table: pa.Table) -> None:
    """Write a part with some rows; remove it if there are none."""
    if not len(table):
        place.remove()
        return
    buffer = BytesIO()
    pa.parquet.write_table(table, buffer, compression="zstd")
    place.write(buffer.getvalue())


def _check_empty(out: Place) -> None:
    """Raise InputError if a folder has files."""
    if out.kind() != FileType.Directory:
        return
    files, folders = out.children()
    if files or folders:
        raise InputError(
            f"{out.url}: expected a new folder, found {(files + folders)[0]} in it; change --out, "
            "or say --overwrite to keep it and write, too"
        )


def _check_same(place: Place, settings: Mapping[str, Any]) -> None:
    """Raise InputError if the file of an earlier run holds other settings."""
    earlier = None
    with suppress(UnicodeDecodeError, json.JSONDecodeError, RecursionError):
        earlier = json.loads(place.read())
    known = earlier if isinstance(earlier, dict) else {}
    check_settings(place.url, settings, earlier=known, advice="change --out")


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
    """Return the row of a drive in the table of drives, for all workers and later runs.

    Args:
        assumed: a line about the first scan.
        usual: measured of the first scans; None if these could not be read, or are of several
            sensors.
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
    """Return the estimate in a row of a drive."""
    values = json.loads(text)
    if values is None:
        return None
    quantiles = values["quantiles"]
    values["frame"] = Frame(**values["frame"])
    values["lasers"] = SensorGeometry(**values["lasers"])
    values["quantiles"] = None if quantiles is None else np.array(quantiles)
    return Estimate(**values)
