"""What a run over many scans has done so far, beside its output, so that an interrupted one can go on."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from amvnet.distributed import ALONE, Processes
from amvnet.errors import InputError
from amvnet.files import PARTS, atomic_write, make_folder

PATTERN = ".unfinished-*.jsonl"  # one of each process; they are gone when the run is over


class Journal:
    """The names that are done, each written down after its output is there.

    Args:
        folder: of the output.
        settings: what the output depends on, as JSON types.
        resume: go on with what an interrupted run with the same settings has left; else begin anew.

    Raises:
        InputError: where the interrupted run had other settings.
    """

    def __init__(
        self,
        folder: Path,
        settings: Mapping[str, Any],
        resume: bool = False,
        processes: Processes = ALONE,
    ) -> None:
        self.processes, self.folder = processes, folder
        self.done = self._left(dict(settings)) if resume else set()
        processes.wait()  # all have read before any writes
        make_folder(folder)
        if processes.first and (left := list(folder.glob(PATTERN))):
            # And what a run that was killed in the midst of writing left half-written.
            for path in [*left, *folder.rglob(PARTS)]:
                path.unlink()
        processes.wait()
        self.path = folder / PATTERN.replace("*", str(processes.rank))
        with atomic_write(self.path) as part:
            part.write_text(
                "".join(f"{json.dumps(line)}\n" for line in (dict(settings), *sorted(self.done)))
            )

    def _left(self, settings: dict[str, Any]) -> set[str]:
        done: set[str] = set()
        for path in self.folder.glob(PATTERN):
            begun, *names = _lines(path)
            if begun != settings:
                other = [
                    key
                    for key in settings
                    if not isinstance(begun, dict) or begun.get(key) != settings[key]
                ]
                raise InputError(
                    f"{self.folder}: expected what the interrupted run was begun with, found another "
                    f"{', '.join(other)}; go on with that, or leave --resume out to begin anew"
                )
            done.update(names)
        return done

    def add(self, name: str) -> None:
        """Write down that a name is done."""
        with self.path.open("a") as file:
            file.write(f"{json.dumps(name)}\n")

    def close(self) -> None:
        """The run is over."""
        self.processes.wait()
        self.path.unlink(missing_ok=True)


def _lines(path: Path) -> list[Any]:
    """The lines of a journal; one that a killed process has not finished counts for nothing."""
    found: list[Any] = []
    for line in path.read_text(errors="replace").splitlines(keepends=True):
        try:
            found.append(json.loads(line) if line.endswith("\n") else None)
        except ValueError:
            found.append(None)
    return [found[0], *(one for one in found[1:] if isinstance(one, str))] if found else [None]
