"""Pack predictions for a benchmark's server, or check a packed archive, by the same rules."""

from __future__ import annotations

from collections.abc import Collection, Iterable
from dataclasses import dataclass
from pathlib import Path

from amvnet.errors import InputError
from amvnet.progress import Progress, no_progress
from amvnet.submission.rules import Rules, Sources
from amvnet.submission.zips import Archive, open_archive, write_archive

ENDING = ".zip"
SHOWN = 5  # names listed in a message


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
        rules: the rules of the archive.
        folder: predictions, under the file names of `rules`.
        out: NAME.zip; it appears whole or not at all.
        sources: the data that the method uses, if the benchmark asks for them.
        progress: called before each file and at the end.

    Returns:
        A summary of the archive.

    Raises:
        InputError: if a prediction is missing or breaks the rules.
    """
    _check_ending(out)
    if not folder.is_dir():
        raise InputError(f"{folder}: expected a folder of predictions, found none; check the path")

    possible_names = (*rules.texts, *sorted(rules.points))
    names = [name for name in possible_names if (folder / name).is_file()]
    _check_missing(rules.required, set(names), str(folder))
    for name in names:
        path = folder / name
        rules.check_size(name, path.stat().st_size, str(path))

    with write_archive(out) as archive:
        for name in rules.folders:
            archive.add(name, b"")
        if rules.meta is not None:
            archive.add(rules.meta, (sources or Sources()).to_json())

        for done, name in enumerate(names):
            progress(done, len(names))
            path = folder / name
            data = path.read_bytes()
            rules.check_content(name, data, str(path))
            archive.add(name, data)

    progress(len(names), len(names))
    return _submission(rules, names)


def check(rules: Rules, path: Path, progress: Progress = no_progress) -> Submission:
    """Check an archive that any tool has packed.

    All names and sizes are checked first, then the files one by one; one is in memory at a time.

    Raises:
        InputError: at the first rule that the archive breaks.
    """
    _check_ending(path)
    with open_archive(path) as archive:
        _check_names(rules, archive)
        for name, size in archive.sizes.items():
            rules.check_size(name, size, f"{path}: {name}")

        # Texts before predictions: they are short.
        names = sorted(archive.sizes, key=lambda name: name in rules.points)
        for done, name in enumerate(names):
            progress(done, len(names))
            rules.check_content(name, archive.read(name), f"{path}: {name}")

        progress(len(names), len(names))
        return _submission(rules, names)


def _submission(rules: Rules, names: Iterable[str]) -> Submission:
    """Return the summary of an archive that holds the files of these names."""
    point_counts = [rules.points[name] for name in names if name in rules.points]
    return Submission(
        len(point_counts), unmatched=point_counts.count(None), official=rules.official
    )


def _check_ending(path: Path) -> None:
    if path.suffix != ENDING:
        raise InputError(
            f"{path}: expected a name that ends in {ENDING}, "
            f"found {path.suffix or 'no ending'}; rename it"
        )


def _check_names(rules: Rules, archive: Archive) -> None:
    """Check which files and folders an archive has."""
    path = archive.path
    names = set(archive.sizes)
    top_names = _names_at_depth(names | archive.folders, 0)
    _check_not_nested(rules, names, top_names, path)

    missing_folders = [name for name in rules.folders if name not in archive.folders]
    if rules.needs_folders and missing_folders:
        raise InputError(
            f"{path}: expected an entry for every folder, found none for "
            f"{_first_of(missing_folders)}; pack folders as entries of their own, as zip -r does"
        )

    if rules.meta is not None and rules.meta not in names:
        listed = ", ".join(map(repr, sorted(top_names)[:SHOWN])) or "nothing"
        raise InputError(
            f"{path}: expected {rules.meta}, found only {listed}; "
            "add this file, or name the archive's split with --split"
        )

    _check_missing(rules.required, names, str(path))
    unexpected = sorted(names - {*rules.points, *rules.others})
    if unexpected:
        raise InputError(
            f"{path}: expected only predictions, found {_first_of(unexpected)}; leave these out"
        )


def _check_not_nested(rules: Rules, names: set[str], top_names: set[str], path: Path) -> None:
    """Check that the folders of the benchmark are not packed inside another folder."""
    expected = _names_at_depth(rules.folders, 0)
    if len(top_names) != 1 or top_names & expected:
        return

    (outer_folder,) = top_names
    if _names_at_depth(names, 1) & expected:
        raise InputError(
            f"{path}: expected {' and '.join(sorted(expected))} at the top, "
            f"found all below {outer_folder!r}; pack the content of that folder, not the folder"
        )


def _check_missing(required: Collection[str], names: set[str], source: str) -> None:
    """Check that no required prediction is missing; `source` begins the message."""
    missing = sorted(set(required) - names)
    if missing:
        raise InputError(
            f"{source}: expected a prediction for each of {len(required)} scans, "
            f"found no {_first_of(missing)}; predict these scans too, "
            "or select predicted ones with --sequences or --split"
        )


def _names_at_depth(paths: Iterable[str], depth: int) -> set[str]:
    """Return the names of files and folders at one depth of some paths; 0 is the top."""
    names = set()
    for path in paths:
        path_names = path.split("/")
        if depth < len(path_names):
            names.add(path_names[depth])

    return names


def _first_of(names: list[str]) -> str:
    """Return the first name and the number of further names, as text."""
    first = names[0] if names[0].isprintable() else repr(names[0])
    if len(names) == 1:
        return first
    return f"{first} and {len(names) - 1} more"
