"""A journal in the output folder lists the scans that are done, so that a run can be resumed."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from amvnet.errors import InputError
from amvnet.files import atomic_write, remove_unfinished

JOURNAL = ".amvnet-journal.jsonl"  # the name of the journal after the run has ended
UNFINISHED = ".unfinished.jsonl"  # the name of the journal during the run
KINDS = [str, str, str, int, int, list, int, str]  # the types of the values in JSON


class Entry(NamedTuple):
    """A scan that is done.

    Attributes:
        origin: a digest of the size and time of its file, and of the first files of its recording,
            on which the sensor is measured; of a drive, also of the files in reach.
        sensor: the name of the recording, whose scans have one sensor.
        uncertain: the number of uncertain points: `points` times `Segmentation.doubt`.
        counts: the number of points of each train id that was written, from 0.
        own: the number of points of the car's own body, which are not in `counts`.
        place: the whole path of its file without links; empty in journals of earlier versions.
    """

    scan: str
    origin: str
    sensor: str
    points: int
    uncertain: int
    counts: list[int]
    own: int = 0
    place: str = ""

    @classmethod
    def from_json(cls, values: Any) -> Entry | None:
        """Return the entry that a line of a journal holds; None if it holds anything else."""
        if not isinstance(values, list) or list(map(type, values)) not in (KINDS, KINDS[:-1]):
            return None
        entry = cls(*values)
        numbers = [entry.points, entry.uncertain, entry.own, *entry.counts]
        return entry if all(type(number) is int and number >= 0 for number in numbers) else None


class Journal:
    """A file that lists the scans that are done. A scan is added after its output.

    If the process is killed, at most one line is lost. After a power cut, the last lines may be
    missing or torn: these scans are done again. If a scan is in the journal, its output is on the
    disk, because `atomic_write` puts it there first.

    The caller keeps other runs out of the folder (`alone_in`).

    Leaving a `with` block closes the file; the run stays unfinished unless `close` ended it.

    Args:
        done: entries of an earlier run that stay valid, from `read_journals`.
    """

    def __init__(
        self, folder: Path, settings: Mapping[str, Any], done: Iterable[Entry] = ()
    ) -> None:
        self.folder = folder
        self.path = folder / UNFINISHED

        remove_unfinished(folder)
        _write(self.path, settings, done)
        self._file = self.path.open("a")
        (folder / JOURNAL).unlink(missing_ok=True)

    def __enter__(self) -> Journal:
        return self

    def __exit__(self, *_: object) -> None:
        self._file.close()

    def add(self, entry: Entry) -> None:
        """Add the entry of a scan that is done."""
        self._file.write(_to_line(entry))
        self._file.flush()

    def close(self) -> dict[str, Entry]:
        """End the run; return all entries, by the name of the scan."""
        self._file.close()
        _, entries = _read(self.path)
        if entries:
            self.path.replace(self.folder / JOURNAL)
        else:
            self.path.unlink()
        return {entry.scan: entry for entry in entries}


class EarlierRun(NamedTuple):
    """What the journals of an earlier run say: the scans that are done, by name, and settings."""

    entries: dict[str, Entry]
    settings: list[dict[str, Any]]

    def changed(self, settings: Mapping[str, Any]) -> list[str]:
        """Return the settings that have another value in the earlier run."""
        return [key for earlier in self.settings for key in changed_settings(settings, earlier)]


def read_journals(folder: Path) -> EarlierRun:
    """Read the journals in a folder; a folder without an earlier run has none."""
    run = EarlierRun({}, [])
    for path in (folder / JOURNAL, folder / UNFINISHED):
        if path.is_file():
            settings, entries = _read(path)
            run.settings.append(settings)
            run.entries.update((entry.scan, entry) for entry in entries)
    return run


def changed_settings(settings: Mapping[str, Any], earlier: Mapping[str, Any]) -> list[str]:
    """Return the settings of a run that have another value in an earlier run."""
    return [key for key in settings if settings[key] != earlier.get(key)]


def check_unchanged(place: object, changed: Sequence[str], advice: str) -> None:
    """Raise InputError if the earlier run in a place had other settings, which `changed` lists."""
    if changed:
        raise InputError(
            f"{place}: expected the settings of the earlier run, found other values of "
            f"{', '.join(changed)}; resume it with the same settings, or {advice}"
        )


def _write(path: Path, settings: Mapping[str, Any], entries: Iterable[Entry]) -> None:
    with atomic_write(path) as part, part.open("w") as file:
        file.write(_to_line(settings))
        for entry in entries:
            file.write(_to_line(entry))


def _to_line(value: Any) -> str:
    return f"{json.dumps(value)}\n"


def _read(path: Path) -> tuple[dict[str, Any], list[Entry]]:
    lines = path.read_text(errors="replace").splitlines(keepends=True)
    settings = _from_line(lines[0]) if lines else None
    if not isinstance(settings, dict):
        settings = {}

    entries = [entry for line in lines[1:] if (entry := Entry.from_json(_from_line(line)))]
    return settings, entries


def _from_line(line: str) -> Any:
    """Return the value of a line; None if the line is incomplete or corrupt."""
    if not line.endswith("\n"):
        return None
    try:
        return json.loads(line)
    except (ValueError, RecursionError):
        return None
