"""List the scans of a fleet in tables; only a few names are in memory at a time."""

from __future__ import annotations

import posixpath
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from hashlib import blake2b
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.csv
import pyarrow.parquet
from numpy.typing import NDArray
from pyarrow.fs import FileType

from amvnet.data.datasets.open import is_dataset
from amvnet.data.formats.detect import BAGS, GZIP, named_ending
from amvnet.data.formats.find import is_scan_name
from amvnet.errors import InputError, reason_of
from amvnet.fleet.secrets import without_secrets
from amvnet.fleet.storage import Place

MANIFESTS = (".parquet", ".csv")
COLUMNS = ("path", "name", "drive")  # the columns of a manifest; only `path` is needed
SCANS_SCHEMA = pa.schema([(name, pa.string()) for name in COLUMNS])
CSV_BYTES = 16 << 20  # the bytes of a CSV file that are read at a time
TABLE_SCANS = 65_536  # largest number of scans of a folder in one table


class NameSet:
    """A set of names that takes 8 bytes for each: it holds the sorted digests of the names."""

    def __init__(self) -> None:
        self._digests = np.empty(0, np.uint64)

    def __len__(self) -> int:
        return len(self._digests)

    def add(self, names: Sequence[str]) -> NDArray[np.bool_]:
        """Add names; return (N,) bool, whether each is new."""
        digests = _digests(names)
        is_first = np.zeros(len(names), bool)
        _, first = np.unique(digests, return_index=True)
        is_first[first] = True
        is_new = is_first & ~self._has(digests)
        self._digests = np.sort(np.concatenate([self._digests, digests[is_new]]))
        return is_new

    def has(self, names: Sequence[str]) -> NDArray[np.bool_]:
        """Return (N,) bool, whether each name is in the set."""
        return self._has(_digests(names))

    def _has(self, digests: NDArray[np.uint64]) -> NDArray[np.bool_]:
        before = np.searchsorted(self._digests, digests)
        after = np.searchsorted(self._digests, digests, "right")
        return after > before


def _digests(names: Sequence[str]) -> NDArray[np.uint64]:
    content = [blake2b(name.encode(errors="surrogatepass"), digest_size=8) for name in names]
    return np.frombuffer(b"".join(each.digest() for each in content), np.uint64)


def list_scans(inputs: Iterable[str], out: Place) -> Iterator[pa.Table]:
    """Yield the scans of the inputs in tables with the columns of a manifest.

    The column `path` holds the URL of a scan file. The column `name` holds the path of its label
    file without the ending, relative to the output folder, so that equal names are equal paths. The
    column `drive` names the recording: the folder of the file, or the drive in the manifest. The
    scans of a folder are sorted by name.

    Args:
        inputs: URLs or paths. Each names a scan file, a folder of scan files and folders, or a
            manifest, which is a Parquet or CSV file with a row for each scan.

    Raises:
        InputError: if an input cannot be reached, is a dataset, has no scan, or has files with
            several scans; or if an input lies in the output folder, or the output folder in an
            input.
    """
    for text in inputs:
        if is_dataset(text):
            raise InputError(
                f"{text}: expected scan files or a manifest, found a dataset; segment it with "
                "amvnet predict"
            )
        place = Place.of(text)
        is_empty = True
        for table in _list_input(place, out):
            for path in table["path"].to_pylist():
                check_outside(Place.of(path), out)
            is_empty = False
            yield table
        if is_empty:
            raise InputError(
                f"{place.url}: expected scan files, found none; give the folder of scans"
            )


def _list_input(place: Place, out: Place) -> Iterator[pa.Table]:
    kind = place.kind()
    if kind == FileType.NotFound:
        raise InputError(
            f"{place.url}: expected scan files, a folder of scan files or a manifest, found "
            "nothing; check the URL"
        )
    if kind == FileType.File and place.path.lower().endswith(MANIFESTS):
        check_outside(place, out)
        yield from _read_manifest(place)
    elif kind == FileType.File:
        folder, _, file = place.address.rpartition("/")
        yield from _scans_in(folder, "", [file])
    elif out.is_in(place):
        raise InputError(
            f"{out.url}: expected a folder outside the inputs, found a folder in {place.url}; "
            "change --out"
        )
    else:
        for prefix, folder_place, names in place.walk():
            present = set(names)
            files = []
            for name in names:
                is_scores = name.endswith(".npz") and name.replace(".npz", ".label") in present
                if is_scan_name(name) and not is_scores:
                    files.append(name)
            yield from _scans_in(folder_place.address, prefix, files)


def check_outside(place: Place, out: Place) -> None:
    """Raise InputError if an input lies in the output folder, where outputs could replace it."""
    if place.is_in(out):
        raise InputError(
            f"{place.url}: expected an input outside the output folder, found an input in "
            f"{out.url}; change the output folder"
        )


def _scans_in(folder: str, prefix: str, files: Sequence[str]) -> Iterator[pa.Table]:
    """Yield the scans of one folder; files of different formats are different drives."""
    for start in range(0, len(files), TABLE_SCANS):
        rows = []
        for file in files[start : start + TABLE_SCANS]:
            stem, ending = split_name(file)
            if ending in BAGS:
                raise InputError(
                    f"{without_secrets(folder)}/{file}: expected files of one scan, found a "
                    "recording of several scans; segment it with amvnet predict"
                )
            drive = f"{without_secrets(folder)}/*{ending}"
            rows.append(
                {"path": f"{folder}/{file}", "name": _as_path(prefix + stem), "drive": drive}
            )
        yield pa.Table.from_pylist(rows, SCANS_SCHEMA)


def split_name(name: str) -> tuple[str, str]:
    """Return a file's name without its ending, which names its labels, and the ending.

    The ending of a packed file includes the ending of the file in it, such as `.bin.gz`.
    """
    ending = named_ending(Path(name)) or ""
    stem = name[: len(name) - len(ending)]
    if ending == GZIP:
        stem, packed = split_name(stem)
        ending = packed + ending
    return stem, ending


def _as_path(name: str) -> str:
    """Return the same spelling for all names of one path, such as x/a for x//a and ./x/a."""
    return posixpath.normpath(name)


def _read_manifest(place: Place) -> Iterator[pa.Table]:
    folder = place.address.rpartition("/")[0]
    for rows in _read_rows(place):
        yield pa.Table.from_pylist([_resolve(row, folder) for row in rows], SCANS_SCHEMA)


def _resolve(row: dict[str, Any], folder: str) -> dict[str, str]:
    """Return the URL, the name and the drive of a row.

    A relative path starts at the folder of the manifest. The name is the path without its ending.
    The name of a URL leaves out the scheme and the bucket.
    """
    path = row["path"]
    _, is_url, _ = path.partition("://")
    is_absolute = bool(is_url) or path.startswith("/")
    url = path if is_absolute else f"{folder}/{path}"
    shown_url = without_secrets(url)
    relative = path.lstrip("/")
    if is_url:
        relative = without_secrets(path).partition("://")[2].partition("/")[2].lstrip("/")

    parent, slash, file = relative.rpartition("/")
    stem, ending = split_name(file)
    name = _as_path(row.get("name") or f"{parent}{slash}{stem}")
    drive = row.get("drive") or f"{shown_url.rpartition('/')[0]}/*{ending}"
    return {"path": url, "name": name, "drive": without_secrets(drive)}


def _read_rows(place: Place) -> Iterator[list[dict[str, Any]]]:
    """Yield the rows of a manifest; raise InputError if it cannot be used."""
    with _reading(place), place.filesystem.open_input_file(place.path) as file:
        if place.path.lower().endswith(".csv"):
            in_parts = pa.csv.ReadOptions(block_size=CSV_BYTES)
            as_texts = pa.csv.ConvertOptions(column_types=dict.fromkeys(COLUMNS, pa.string()))
            batches = pa.csv.open_csv(file, in_parts, convert_options=as_texts)
            names = _check_columns(place, batches.schema.names)
        else:
            table = pa.parquet.ParquetFile(file)
            names = _check_columns(place, table.schema_arrow.names)
            batches = table.iter_batches(columns=names)

        for batch in batches:
            texts = pa.schema([(name, pa.string()) for name in names])
            rows = pa.Table.from_batches([batch]).select(names).cast(texts)
            if not all(rows["path"].to_pylist()):
                raise InputError(
                    f"{place.url}: expected a path in each row, found a row without a path; "
                    "correct the row"
                )
            yield rows.to_pylist()


def _check_columns(place: Place, names: Sequence[str]) -> list[str]:
    """Return the columns to read; raise InputError if `path` is missing or a column is double."""
    present = [name for name in names if name in COLUMNS]
    if "path" not in present:
        raise InputError(
            f"{place.url}: expected a manifest with a column path, found "
            f"{', '.join(names)[:200]}; give the column of scan files the name path"
        )
    for name in present:
        if present.count(name) > 1:
            raise InputError(
                f"{place.url}: expected one column {name}, found {present.count(name)}; "
                "remove the others"
            )
    return present


@contextmanager
def _reading(place: Place) -> Iterator[None]:
    """Turn errors of a manifest that cannot be read into an `InputError` of one line."""
    try:
        yield
    except (OSError, pa.ArrowException) as error:
        raise InputError(
            f"{place.url}: expected a manifest, a Parquet or CSV file with a column path, found "
            f"{without_secrets(reason_of(error))}; write it again"
        ) from None
