"""A record next to the output of what a run has done, so that an interrupted run can be resumed."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from amvnet.distributed import ALONE, Processes
from amvnet.errors import InputError
from amvnet.files import PARTS, atomic_write, make_folder

PATTERN = ".unfinished-*.jsonl"  # one file per process; a run that ends removes them


class Journal:
    """A file with the names of the scans that are done, each added after its output.

    Args:
        folder: of the output.
        settings: what the output depends on, as JSON types.
        resume: whether to continue an interrupted run with the same settings; else start over.
        processes: those that share the run.

    Raises:
        InputError: if the interrupted run had other settings.
    """

    def __init__(
        self,
        folder: Path,
        settings: Mapping[str, Any],
        resume: bool = False,
        processes: Processes = ALONE,
    ) -> None:
        self.folder = folder
        self.processes = processes
        self.path = folder / PATTERN.replace("*", str(processes.rank))
        self.done = self._read_all(dict(settings)) if resume else set()
        processes.wait()  # until all have read, before the first one removes files

        make_folder(folder)
        if processes.first:
            self._remove_old_files()
        processes.wait()

        with atomic_write(self.path) as part, part.open("w") as file:
            file.write(_to_line(dict(settings)))
            for name in sorted(self.done):
                file.write(_to_line(name))

    def _read_all(self, settings: dict[str, Any]) -> set[str]:
        """Return the names that the interrupted run's journals hold, if it had these settings."""
        done: set[str] = set()
        for path in self.folder.glob(PATTERN):
            earlier_settings, names = _read(path)
            if earlier_settings != settings:
                changed = ", ".join(_changed_keys(earlier_settings, settings))
                raise InputError(
                    f"{self.folder}: expected the settings of the interrupted run, found another "
                    f"{changed}; resume it with the same, or leave --resume out to start over"
                )

            done.update(names)
        return done

    def _remove_old_files(self) -> None:
        """Remove the journals of an interrupted run, and the files that it did not finish."""
        journals = list(self.folder.glob(PATTERN))
        if journals:
            for path in [*journals, *self.folder.rglob(PARTS)]:
                path.unlink()

    def add(self, name: str) -> None:
        """Write down that a scan is done."""
        with self.path.open("a") as file:
            file.write(_to_line(name))

    def close(self) -> None:
        """Remove the journal at the end of the run."""
        self.processes.wait()
        self.path.unlink(missing_ok=True)


def _to_line(value: Any) -> str:
    return f"{json.dumps(value)}\n"


def _read(path: Path) -> tuple[Any, list[str]]:
    """Return the settings and the names in a journal; None for settings that cannot be read."""
    lines = path.read_text(errors="replace").splitlines(keepends=True)
    settings = _from_line(lines[0]) if lines else None

    names = []
    for line in lines[1:]:
        name = _from_line(line)
        if isinstance(name, str):
            names.append(name)
    return settings, names


def _from_line(line: str) -> Any:
    """Return the value in a line; None if a killed process left it unfinished, or it is corrupt."""
    if not line.endswith("\n"):
        return None
    try:
        return json.loads(line)
    except ValueError:
        return None


def _changed_keys(earlier: Any, settings: dict[str, Any]) -> list[str]:
    """Return the keys of the settings whose values differ from those of an earlier run."""
    if not isinstance(earlier, dict):
        return list(settings)
    keys = {**earlier, **settings}  # an option that was left out may have no key
    return [key for key in keys if earlier.get(key) != settings.get(key)]
