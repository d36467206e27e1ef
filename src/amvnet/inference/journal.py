"""A record in the output folder of the scans that are done, so that a run can be resumed."""

from __future__ import annotations

import fcntl
import json
import os
from collections.abc import Iterable, Iterator, Mapping, Set
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, NamedTuple

from amvnet.errors import InputError
from amvnet.files import PARTS, atomic_write, make_folder
from amvnet.progress import counted

JOURNAL = ".amvnet-journal.jsonl"  # of a run that has ended
UNFINISHED = ".unfinished.jsonl"  # until the run ends


class Entry(NamedTuple):
    """A scan that is done.

    Attributes:
        scan: its name.
        origin: a digest of the size and time of its file; of a normalised scan, also of those of
            the first files of its recording, on which the sensor is measured.
        sensor: a title of what recorded it.
        points: how many of its points are valid.
        uncertain: how many are uncertain.
    """

    scan: str
    origin: str
    sensor: str
    points: int
    uncertain: int


class Journal:
    """A file of the scans that are done, each added after its output.

    If the process is killed, at most one line is lost. After a power cut, the last lines may be
    missing or torn: these scans are done again. The output of a scan in the journal is on the
    disk, because `atomic_write` puts it there first.

    Args:
        settings: what the output depends on, as JSON types.
        done: entries of an earlier run that stay valid, from `read_journals`.

    Raises:
        InputError: if another run is writing into the folder.
    """

    def __init__(
        self, folder: Path, settings: Mapping[str, Any], done: Iterable[Entry] = ()
    ) -> None:
        self.folder = folder
        self.path = folder / UNFINISHED

        make_folder(folder)
        with _lock(folder):
            _check_alone(folder)
            _write(self.path, settings, done)
            self._file = self.path.open("a")
            with suppress(OSError):  # some network file systems have no locks
                fcntl.flock(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            (folder / JOURNAL).unlink(missing_ok=True)
            for path in folder.rglob(PARTS):  # files that earlier runs did not finish
                if path.is_file():
                    path.unlink()

    def add(self, entry: Entry) -> None:
        """Write down that a scan is done."""
        self._file.write(_to_line(entry))
        self._file.flush()

    def close(self) -> dict[str, Entry]:
        """End the run; return all entries by the name of the scan."""
        self._file.close()
        _, entries = _read(self.path)
        if entries:
            self.path.replace(self.folder / JOURNAL)
        else:
            self.path.unlink()
        return {entry.scan: entry for entry in entries}


def read_journals(folder: Path, settings: Mapping[str, Any]) -> dict[str, Entry]:
    """Return what an earlier run into a folder has done, by the name of the scan.

    Raises:
        InputError: if that run had other settings.
    """
    done: dict[str, Entry] = {}
    for path in (folder / JOURNAL, folder / UNFINISHED):
        if not path.is_file():
            continue
        earlier_settings, entries = _read(path)
        advice = "start over with --overwrite instead of --resume"
        check_settings(folder, settings, earlier=earlier_settings, advice=advice)
        for entry in entries:
            done[entry.scan] = entry
    return done


def describe_other_run(folder: Path, settings: Mapping[str, Any], scans: Set[str]) -> str:
    """Say what an earlier run left in a folder that a run is about to write into; empty if nothing.

    Args:
        settings: of the run, as for `Journal`.
        scans: the names of its scans, whose files it replaces.
    """
    others: set[str] = set()
    changed: set[str] = set()
    for path in (folder / JOURNAL, folder / UNFINISHED):
        if path.is_file():
            earlier_settings, entries = _read(path)
            others |= {entry.scan for entry in entries} - scans
            changed |= {key for key in settings if settings[key] != earlier_settings.get(key)}
    if not others:
        return ""

    text = f"{folder} has the labels of {counted(len(others), 'scan')} of an earlier run"
    if changed:
        text += f", made with another {', '.join(sorted(changed))}"
    return f"{text}; give each run a folder of its own"


def check_settings(
    place: object, settings: Mapping[str, Any], earlier: Mapping[str, Any], advice: str
) -> None:
    """Raise InputError if the earlier run in a place had other settings.

    Args:
        advice: what to do instead of resuming it with the same settings.
    """
    changed = [key for key in settings if settings[key] != earlier.get(key)]
    if changed:
        raise InputError(
            f"{place}: expected the settings of the earlier run, found another "
            f"{', '.join(changed)}; resume it with the same, or {advice}"
        )


@contextmanager
def _lock(folder: Path) -> Iterator[None]:
    """Keep other processes out of this block for the same folder."""
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        with suppress(OSError):
            fcntl.flock(descriptor, fcntl.LOCK_EX)
        yield
    finally:
        os.close(descriptor)


def _check_alone(folder: Path) -> None:
    """Raise InputError if another run has locked the journal."""
    with suppress(OSError), (folder / UNFINISHED).open() as file:
        try:
            fcntl.flock(file, fcntl.LOCK_SH | fcntl.LOCK_NB)
        except BlockingIOError:
            raise InputError(
                f"{folder}: expected a folder for this run alone, found another run that is "
                "writing into it; wait until it ends, or change --out"
            ) from None


def _write(path: Path, settings: Mapping[str, Any], entries: Iterable[Entry]) -> None:
    with atomic_write(path) as part, part.open("w") as file:
        file.write(_to_line(settings))
        for entry in entries:
            file.write(_to_line(entry))


def _to_line(value: Any) -> str:
    return f"{json.dumps(value)}\n"


def _read(path: Path) -> tuple[dict[str, Any], list[Entry]]:
    """Return the settings, empty if they cannot be read, and the entries in a journal."""
    lines = path.read_text(errors="replace").splitlines(keepends=True)
    settings = _from_line(lines[0]) if lines else None
    if not isinstance(settings, dict):
        settings = {}

    entries = []
    for line in lines[1:]:
        values = _from_line(line)
        if isinstance(values, list) and list(map(type, values)) == [str, str, str, int, int]:
            entries.append(Entry(*values))
    return settings, entries


def _from_line(line: str) -> Any:
    """Return the value in a line; None if it was not written to its end, or is corrupt."""
    if not line.endswith("\n"):
        return None
    try:
        return json.loads(line)
    except (ValueError, RecursionError):
        return None
