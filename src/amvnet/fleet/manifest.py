"""List the scans of a fleet in blocks, with few names in memory at a time."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from hashlib import blake2b
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.csv
import pyarrow.parquet
from pyarrow.fs import FileType

from amvnet.data.formats.detect import BAGS, named_ending
from amvnet.data.formats.find import is_scan_name
from amvnet.errors import InputError
from amvnet.fleet.storage import Place, reaching

BLOCK = 64  # scans
MANIFESTS = (".parquet", ".csv")
COLUMNS = ("path", "name", "drive")  # of a manifest; only the first is needed
CSV_BYTES = 16 << 20  # of a manifest, read at a time


class NameSet:
    """A set of names that takes 8 bytes each: it holds their digests, sorted."""

    def __init__(self) -> None:
        self._digests = np.empty(0, np.uint64)

    def __len__(self) -> int:
        return len(self._digests)

    def add(self, names: Sequence[str]) -> np.ndarray:
        """Add many names; return for each, (N,) bool, whether it is new."""
        digests = _digests(names)
        is_first = np.zeros(len(names), bool)
        _, first = np.unique(digests, return_index=True)
        is_first[first] = True
        is_new = is_first & ~self._has(digests)
        self._digests = np.sort(np.concatenate([self._digests, digests[is_new]]))
        return is_new

    def has(self, names: Sequence[str]) -> np.ndarray:
        """Return for each name, (N,) bool, whether it is in the set."""
        return self._has(_digests(names))

    def _has(self, digests: np.ndarray) -> np.ndarray:
        before = np.searchsorted(self._digests, digests)
        after = np.searchsorted(self._digests, digests, "right")
        is_present: np.ndarray = after > before
        return is_present


def _digests(names: Sequence[str]) -> np.ndarray:
    """Return (N,) uint64 digests of names."""
    content = [blake2b(name.encode(errors="surrogatepass"), digest_size=8) for name in names]
    return np.frombuffer(b"".join(each.digest() for each in content), np.uint64)


def list_blocks(inputs: Iterable[str]) -> Iterator[pa.Table]:
    """Yield the scans of the inputs in blocks, each of scans of one drive.

    A block is a table with the columns of a manifest: `path` is a URL, `name` that of the label
    file, without an ending, relative to the output folder.

    A drive is a folder, or of a manifest what its column `drive` says. The scans of a folder have
    the order of their names.

    Args:
        inputs: each the URL or the path of a folder of scan files and folders, of a scan file, or
            of a manifest: a Parquet or CSV file with a row for each scan.

    Raises:
        InputError: if an input cannot be reached, has no scan, or has recordings of several scans
            in a file.
    """
    for text in inputs:
        place = Place.of(text)
        kind = place.kind()
        if kind == FileType.Directory:
            blocks = _walk(place, "")
        elif kind == FileType.File and place.path.lower().endswith(MANIFESTS):
            blocks = _read_manifest(place)
        elif kind == FileType.File:
            folder, _, file = place.url.rpartition("/")
            blocks = _in_blocks(folder, "", [file])
        else:
            raise InputError(
                f"{text}: expected scan files, a folder of them or a manifest, found nothing; "
                "check the URL"
            )

        is_empty = True
        for block in blocks:
            is_empty = False
            yield block
        if is_empty:
            raise InputError(f"{text}: expected scan files, found none; give the folder of scans")


def _walk(folder: Place, prefix: str) -> Iterator[pa.Table]:
    """Yield the scans of a folder, and then those of its folders.

    Args:
        prefix: the beginning of the names of the scans.
    """
    names, folders = folder.children()
    present = set(names)
    files = []
    for name in names:
        is_scores = name.endswith(".npz") and name.replace(".npz", ".label") in present
        if is_scan_name(name) and not is_scores:
            files.append(name)
    yield from _in_blocks(folder.url, prefix, files)
    for name in folders:
        if not name.startswith("."):
            yield from _walk(folder / name, f"{prefix}{name}/")


def _in_blocks(folder: str, prefix: str, files: Iterable[str]) -> Iterator[pa.Table]:
    """Yield the scans of one folder; files of different formats are different drives."""
    drives: dict[str, list[tuple[str, str]]] = {}  # by ending
    for file in files:
        stem, ending = split_name(file)
        drives.setdefault(ending, []).append((f"{folder}/{file}", f"{prefix}{stem}"))

    for ending, scans in drives.items():
        if ending in BAGS:
            raise InputError(
                f"{scans[0][0]}: expected files of one scan for --ray, found a "
                "recording; segment it without --ray"
            )
        yield from _cut(scans, f"{folder}/*{ending}")


def _cut(scans: Sequence[tuple[str, str]], drive: str) -> Iterator[pa.Table]:
    """Yield the scans of a drive, each a URL and a name, in blocks."""
    for start in range(0, len(scans), BLOCK):
        urls, names = zip(*scans[start : start + BLOCK], strict=True)
        yield pa.table([urls, names, len(urls) * [drive]], names=COLUMNS)


def split_name(name: str) -> tuple[str, str]:
    """Return a file's name without its ending, and the ending."""
    ending = named_ending(Path(name)) or ""
    return name[: len(name) - len(ending)], ending


def _read_manifest(place: Place) -> Iterator[pa.Table]:
    """Yield the scans of a manifest; rows of one drive need not follow one another."""
    folder = place.url.rpartition("/")[0]
    for rows in _read_batches(place):
        drives: dict[str, list[tuple[str, str]]] = {}
        for row in rows:
            url, name, drive = _resolve(row, folder)
            drives.setdefault(drive, []).append((url, name))
        for drive, scans in drives.items():
            yield from _cut(scans, drive)


def _resolve(row: dict[str, Any], folder: str) -> tuple[str, str, str]:
    """Return the URL, the name and the drive of a row.

    A path is relative to the folder of the manifest. The name is the path without its ending; if
    the path is a URL, only what follows the bucket.
    """
    path = row["path"] or ""
    _, is_url, rest = path.partition("://")
    is_absolute = bool(is_url) or path.startswith("/")
    url = path if is_absolute else f"{folder}/{path}"
    relative = rest.partition("/")[2] if is_url else path.lstrip("/")

    parent, slash, file = relative.rpartition("/")
    stem, ending = split_name(file)
    name = row.get("name") or f"{parent}{slash}{stem}"
    drive = row.get("drive") or f"{url.rpartition('/')[0]}/*{ending}"
    return url, name, drive


def _read_batches(place: Place) -> Iterator[list[dict[str, Any]]]:
    """Yield the rows of a manifest; raise InputError if it is unusable."""
    with reaching(place.url), place.filesystem.open_input_file(place.path) as file:
        if place.path.lower().endswith(".csv"):
            in_parts = pa.csv.ReadOptions(block_size=CSV_BYTES)
            as_texts = pa.csv.ConvertOptions(column_types=dict.fromkeys(COLUMNS, pa.string()))
            batches = pa.csv.open_csv(file, in_parts, convert_options=as_texts)
            names = batches.schema.names
        else:
            table = pa.parquet.ParquetFile(file)
            names = table.schema_arrow.names
            batches = table.iter_batches(columns=[name for name in COLUMNS if name in names])
        if "path" not in names:
            raise InputError(
                f"{place.url}: expected a manifest with a column path, found "
                f"{', '.join(names)[:200]}; name the column of the scans' files path"
            )

        texts = pa.schema([(name, pa.string()) for name in COLUMNS if name in names])
        for batch in batches:
            yield pa.Table.from_batches([batch]).select(texts.names).cast(texts).to_pylist()
