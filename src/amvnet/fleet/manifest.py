"""List the scans of a fleet in blocks, with few names in memory at a time."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from hashlib import blake2b
from pathlib import Path, PurePosixPath
from typing import Any, NamedTuple

import numpy as np
import pyarrow as pa
import pyarrow.csv
import pyarrow.parquet
from pyarrow.fs import FileType

from amvnet.data.formats.detect import PACKED, TEXT, named_ending
from amvnet.data.formats.registry import RECORDINGS
from amvnet.errors import InputError
from amvnet.fleet.storage import Place, reaching

BLOCK = 64  # scans
MANIFESTS = (".parquet", ".csv")
COLUMNS = ("path", "name", "drive", "sensor")  # of a manifest; only the first is needed
MOST_PENDING = 1_000_000  # rows of a manifest that wait for others of their drives
MOST_RECENT = 1_000_000  # names that are not sorted yet


@dataclass(frozen=True)
class Block:
    """Scans of one drive that one worker labels together.

    Attributes:
        drive: the recording; its scans are normalised alike.
        names: of the files of the labels, without an ending, relative to the output folder.
        urls: of the files of the scans.
        sensor: name of the LiDAR; empty if unknown.
    """

    drive: str
    names: Sequence[str]
    urls: Sequence[str]
    sensor: str = ""

    def select(self, is_wanted: np.ndarray) -> Block:
        """Return the block with only those of its scans for which an (N,) bool array is true."""
        indices = np.flatnonzero(is_wanted).tolist()
        names = [self.names[index] for index in indices]
        return Block(self.drive, names, [self.urls[index] for index in indices], self.sensor)

    def singly(self) -> Iterator[Block]:
        """Yield each scan as a block."""
        for name, url in zip(self.names, self.urls, strict=True):
            yield Block(self.drive, [name], [url], self.sensor)

    def rows(self) -> list[dict[str, str]]:
        """Return a row for each scan, as of a manifest."""
        rows = []
        for name, url in zip(self.names, self.urls, strict=True):
            rows.append({"path": url, "name": name, "drive": self.drive, "sensor": self.sensor})
        return rows


class NameSet:
    """A set of names that takes 8 bytes each: it holds their digests."""

    def __init__(self) -> None:
        self._sorted = np.empty(0, np.uint64)
        self._recent: set[int] = set()

    def __len__(self) -> int:
        return len(self._sorted) + len(self._recent)

    def add(self, names: Sequence[str]) -> np.ndarray:
        """Add names; return for each, (N,) bool, whether it is new."""
        digests = _digests(names)
        is_first = np.zeros(len(names), bool)
        is_first[np.unique(digests, return_index=True)[1]] = True
        is_new = is_first & ~self._has(digests)

        self._recent.update(digests[is_new].tolist())
        if len(self._recent) > MOST_RECENT:
            recent = np.fromiter(self._recent, np.uint64, len(self._recent))
            self._sorted = np.union1d(self._sorted, recent)
            self._recent.clear()
        return is_new

    def has(self, names: Sequence[str]) -> np.ndarray:
        """Return for each name, (N,) bool, whether it is in the set."""
        return self._has(_digests(names)) if len(self) else np.zeros(len(names), bool)

    def _has(self, digests: np.ndarray) -> np.ndarray:
        is_recent = [digest in self._recent for digest in digests.tolist()]
        places = np.searchsorted(self._sorted, digests)
        is_sorted = np.zeros(len(digests), bool)
        inside = places < len(self._sorted)
        is_sorted[inside] = self._sorted[places[inside]] == digests[inside]
        return is_sorted | np.array(is_recent, bool)


def _digests(names: Sequence[str]) -> np.ndarray:
    """Return (N,) uint64 digests of names."""
    content = [blake2b(name.encode(errors="surrogatepass"), digest_size=8) for name in names]
    return np.frombuffer(b"".join(each.digest() for each in content), np.uint64)


def list_blocks(inputs: Iterable[str]) -> Iterator[Block]:
    """Yield the scans of the inputs, drive by drive.

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
            file = File.of(PurePosixPath(place.path).name)
            blocks = _in_blocks(place.url.rpartition("/")[0], "", [file])
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


def _walk(folder: Place, prefix: str) -> Iterator[Block]:
    """Yield the scans of a folder, and then those of its folders.

    Args:
        prefix: the beginning of the names of the scans.
    """
    names, folders = folder.children()
    present = set(names)
    files = [File.of(name) for name in names]
    yield from _in_blocks(folder.url, prefix, [file for file in files if file.is_scan(present)])
    for name in folders:
        if not name.startswith("."):
            yield from _walk(folder / name, f"{prefix}{name}/")


class File(NamedTuple):
    """A file's name, without its ending, and the ending; `.bin.gz` ends in `.gz`."""

    name: str
    stem: str
    ending: str

    @classmethod
    def of(cls, name: str) -> File:
        """Return the parts of a name."""
        return cls(name, *split_name(name))

    def is_scan(self, present: set[str]) -> bool:
        """Return whether it is a scan by its name, and not of predictions.

        Args:
            present: the names of all files in the folder.
        """
        if self.name.startswith(".") or self.name.endswith(".uncertain.npy"):
            return False
        if self.ending == ".npz" and f"{self.stem}.label" in present:
            return False
        if self.ending in PACKED:
            inner = named_ending(Path(self.name[: -len(self.ending)])) or ""
            return inner not in ("", *PACKED, *TEXT)
        return self.ending not in ("", *TEXT)


def _in_blocks(folder: str, prefix: str, files: Sequence[File]) -> Iterator[Block]:
    """Yield the scans of one folder; files of different formats are different drives."""
    by_ending: dict[str, list[File]] = {}
    for file in files:
        by_ending.setdefault(file.ending, []).append(file)

    for ending, alike in by_ending.items():
        if ending in RECORDINGS:
            raise InputError(
                f"{folder}/{alike[0].name}: expected files of one scan for --ray, found a "
                "recording; segment it without --ray"
            )
        for start in range(0, len(alike), BLOCK):
            part = alike[start : start + BLOCK]
            names = [f"{prefix}{file.stem}" for file in part]
            yield Block(f"{folder}/*{ending}", names, [f"{folder}/{file.name}" for file in part])


def split_name(name: str) -> tuple[str, str]:
    """Return a file's name without its ending, and the ending; `.bin.gz` ends in `.gz`."""
    ending = named_ending(Path(name)) or ""
    stem = name[: len(name) - len(ending)]
    return (split_name(stem)[0] if ending in PACKED else stem), ending


def _read_manifest(place: Place) -> Iterator[Block]:
    """Yield the scans of a manifest; rows of one drive need not follow one another."""
    folder = place.url.rpartition("/")[0]
    pending: dict[tuple[str, str], list[tuple[str, str]]] = {}
    count = 0
    for row in _rows(place):
        name, url, drive = _resolve(row, folder)
        key = (drive, row.get("sensor") or "")
        pending.setdefault(key, []).append((name, url))
        count += 1
        if len(pending[key]) == BLOCK:
            yield _block(key, pending.pop(key))
            count -= BLOCK
        if count > MOST_PENDING:
            yield from (_block(*item) for item in pending.items())
            pending.clear()
            count = 0
    yield from (_block(*item) for item in pending.items())


def _block(key: tuple[str, str], scans: Sequence[tuple[str, str]]) -> Block:
    drive, sensor = key
    names, urls = zip(*scans, strict=True)
    return Block(drive, names, urls, sensor)


def _resolve(row: dict[str, Any], folder: str) -> tuple[str, str, str]:
    """Return the name, the URL and the drive of a row.

    A path is relative to the folder of the manifest. The name is that path without an ending; of a
    URL, what follows the bucket.
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
    return name, url, drive


def _rows(place: Place) -> Iterator[dict[str, Any]]:
    """Yield the rows of a manifest as dictionaries of texts.

    Raises:
        InputError: if it cannot be read, or has no column `path`.
    """
    with reaching(place.url), place.filesystem.open_input_file(place.path) as file:
        if place.path.lower().endswith(".csv"):
            batches = pa.csv.open_csv(file)
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

        columns = [name for name in COLUMNS if name in names]
        for batch in batches:
            texts = [batch.column(name).cast(pa.string()).to_pylist() for name in columns]
            for values in zip(*texts, strict=True):
                yield dict(zip(columns, values, strict=True))


def windows(blocks: Iterable[Block], most: int) -> Iterator[list[Block]]:
    """Yield the blocks in lists of at most `most`."""
    window: list[Block] = []
    for block in blocks:
        window.append(block)
        if len(window) == most:
            yield window
            window = []
    if window:
        yield window
