"""The table of results of a fleet: Parquet in parts, which are also the journal."""

from __future__ import annotations

import json
import time
from collections.abc import Mapping
from io import BytesIO
from typing import Any

import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet
from pyarrow.fs import FileType

from amvnet.errors import InputError
from amvnet.fleet.drives import Drives
from amvnet.fleet.manifest import NameSet
from amvnet.fleet.storage import Place, reaching

FOLDER = "results"  # in the output folder
SETTINGS = "run.json"
DRIVES = "drives.parquet"
PART_BYTES = 64 << 20
PART_SECONDS = 10.0  # between two parts
PART_SHARE = 0.02  # of the time of the run so far: long runs have fewer, larger parts


class Results:
    """The table of results in an output folder, `results/part-000000.parquet` and so on.

    A part is written when it is large enough, or after some time. A scan is done if a part has it
    without an error. Rows with an error are removed when a run is resumed, so that each scan has
    one row.

    Args:
        out: the output folder.
        settings: what the results depend on, as JSON types.
        resume: whether to go on with an earlier run.
        overwrite: whether the folder may hold other files.

    Attributes:
        done: the names of the scans that an earlier run has done.
        drives: what was measured of each drive.

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
        self._start = self._last = time.monotonic()
        self._number = 0

        earlier = self._read_settings()
        if earlier is None:
            if not overwrite:
                _check_empty(out)
            self._write_settings(settings)
        elif not resume:
            raise InputError(
                f"{out.url}: expected a new folder, found the results of an earlier run; say "
                "--resume to go on with it, or change --out"
            )
        else:
            _check_same(out, earlier, settings)
            self._read_parts()
        self.drives = Drives(self.folder / DRIVES)

    def _read_settings(self) -> Any:
        """Return the settings of the earlier run; None if there is none."""
        place = self.folder / SETTINGS
        if place.kind() != FileType.File:
            return None
        try:
            return json.loads(place.read())
        except (ValueError, RecursionError):
            return {}

    def _write_settings(self, settings: Mapping[str, Any]) -> None:
        place = self.folder / SETTINGS
        try:
            place.write(json.dumps(settings).encode())
        except OSError as error:
            if place.local is not None:
                raise
            raise InputError(
                f"{place.url}: expected a place to write to, found {error.strerror}; check the URL "
                "and the credentials"
            ) from None

    def _read_parts(self) -> None:
        """Read which scans are done, and remove the rows of the others."""
        files, _ = self.folder.children()
        for file in files:
            if not file.startswith("part-"):
                continue
            place = self.folder / file
            with reaching(place.url):
                table = pa.parquet.read_table(BytesIO(place.read()))
            is_done = pc.is_null(table["error"]).to_numpy()
            is_done[is_done] = self.done.add(table["scan"].filter(is_done).to_pylist())
            if not is_done.all():
                _replace(place, table.filter(is_done))
            self._number = int(file[len("part-") : -len(".parquet")]) + 1

    def add(self, rows: pa.Table) -> None:
        """Add rows, and write a part if it is time."""
        if len(rows):
            self._pending.append(rows)
        now = time.monotonic()
        patience = max(PART_SECONDS, PART_SHARE * (now - self._start))
        size = sum(table.nbytes for table in self._pending)
        if size >= PART_BYTES or now - self._last >= patience:
            self.flush()

    def flush(self) -> None:
        """Write what has been added."""
        if self._pending:
            table = pa.concat_tables(self._pending)
            _replace(self.folder / f"part-{self._number:06d}.parquet", table)
            self._number += 1
            self._pending.clear()
        self._last = time.monotonic()


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
            "or say --overwrite to write beside it"
        )


def _check_same(out: Place, earlier: Any, settings: Mapping[str, Any]) -> None:
    """Raise InputError if an earlier run had other settings."""
    known = earlier if isinstance(earlier, dict) else {}
    changed = [key for key in settings if known.get(key) != settings[key]]
    if changed:
        raise InputError(
            f"{out.url}: expected the settings of the earlier run, found another "
            f"{', '.join(changed)}; resume it with the same, or change --out"
        )
