"""Check predictions by the rules of a benchmark's server, and pack them into an archive."""

from __future__ import annotations

import stat
import zipfile
from dataclasses import dataclass
from pathlib import Path

from amvnet.errors import InputError
from amvnet.files import atomic_write
from amvnet.progress import Progress, no_progress
from amvnet.submission.rules import Rules, Sources

ENDING = ".zip"
LEVEL = 6  # of deflate: 9 takes five to eight times as long and saves a sixth
# Time of every entry, the earliest of the format: the same content gives the same bytes.
LONG_AGO = (1980, 1, 1, 0, 0, 0)
UNIX = 3  # code of the system that wrote an entry
FOLDER_BIT = 0x10  # of an entry's MS-DOS attributes


@dataclass(frozen=True)
class Submission:
    """An archive that keeps to the rules.

    Attributes:
        predictions: number of predictions in it.
        unmatched: number of predictions whose scan is not on disk, so that its number of points
            is unknown.
        official: how many predictions the server expects, or None if it has no fixed number.
    """

    predictions: int
    unmatched: int
    official: int | None

    @property
    def notes(self) -> list[str]:
        """Remarks that a user should read, although the archive keeps to the rules."""
        notes = []
        if self.unmatched:
            notes.append(
                f"{self.unmatched} predictions are of scans that are not on disk; "
                "their length is not checked"
            )

        if self.official is not None and self.predictions < self.official:
            notes.append(
                f"the benchmark has {self.official} scans in this split; "
                "its server refuses an archive with fewer"
            )

        return notes


def write(
    rules: Rules,
    folder: Path,
    out: Path,
    sources: Sources | None = None,
    progress: Progress = no_progress,
) -> Submission:
    """Check a folder of predictions and pack it; the same predictions give the same bytes.

    Files that have no place in the archive (scores, other splits) are left out. One scan is in
    memory at a time.

    Args:
        folder: predictions, under the file names of `rules`.
        out: NAME.zip; it appears whole or not at all.
        sources: the data that the method uses, if the benchmark asks for them.
        progress: called before each file and at the end.

    Returns:
        A summary of the archive.

    Raises:
        InputError: if a prediction is missing or breaks the rules, or the archive cannot be
            written.
    """
    if out.suffix != ENDING:
        raise InputError(
            f"{out}: expected a name that ends in {ENDING}, "
            f"found {out.suffix or 'no ending'}; rename it"
        )
    if not folder.is_dir():
        raise InputError(f"{folder}: expected a folder of predictions, found none; check the path")

    names = [name for name in sorted(rules.points) if (folder / name).is_file()]
    _check_missing(rules, names, folder)

    for name in names:
        rules.check_size(name, (folder / name).stat().st_size, folder / name)

    with atomic_write(out) as part, zipfile.ZipFile(part, "w") as archive:
        for name in rules.folders:
            _add(archive, name, b"")
        if rules.meta is not None:
            _add(archive, rules.meta, (sources or Sources()).to_json())
        for name in rules.texts:
            if (folder / name).is_file():
                _add(archive, name, (folder / name).read_bytes())

        unmatched = 0
        for done, name in enumerate(names):
            progress(done, len(names))
            unmatched += rules.points[name] is None
            data = (folder / name).read_bytes()
            rules.check_ids(data, folder / name)
            _add(archive, name, data)

    progress(len(names), len(names))
    return Submission(len(names), unmatched, rules.official)


def _check_missing(rules: Rules, names: list[str], folder: Path) -> None:
    """Check that no required prediction is missing, given the names of the present ones."""
    missing = sorted(set(rules.required) - set(names))
    if missing:
        others = f" and {len(missing) - 1} more" if len(missing) > 1 else ""
        raise InputError(
            f"{folder}: expected a prediction for each of {len(rules.required)} scans, "
            f"found no {missing[0]}{others}; predict these scans too, "
            "or select predicted ones with --sequences or --split"
        )


def _add(archive: zipfile.ZipFile, name: str, data: bytes) -> None:
    """Add a file, or a folder (NAME/), by an entry that is the same everywhere and at any time."""
    entry = zipfile.ZipInfo(name, LONG_AGO)
    entry.create_system = UNIX

    if name.endswith("/"):
        entry.external_attr = (stat.S_IFDIR | 0o755) << 16 | FOLDER_BIT
    else:
        entry.external_attr = (stat.S_IFREG | 0o644) << 16
        entry.compress_type = zipfile.ZIP_DEFLATED

    archive.writestr(entry, data, compresslevel=LEVEL)
