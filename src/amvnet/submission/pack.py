"""Archives for the benchmarks' servers: written from a folder of predictions, or checked, by the same rules."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable
from dataclasses import dataclass
from pathlib import Path

from amvnet.errors import InputError
from amvnet.submission.rules import Rules, Sources
from amvnet.submission.zips import Archive, open_archive, write_archive

ENDING = ".zip"
SHOWN = 5  # folders in a message
Progress = Callable[[int, int], None]  # done, in all


@dataclass(frozen=True)
class Submission:
    """An archive that keeps to the rules.

    Attributes:
        predictions: how many are in it.
        unmatched: how many of them are of scans that are not on disk, whose number of points is not known.
        official: how many its server wants, or None where it has no such number.
    """

    predictions: int
    unmatched: int
    official: int | None

    @property
    def notes(self) -> list[str]:
        """What a user should know of an archive that keeps to the rules all the same."""
        notes = []
        if self.unmatched:
            notes.append(
                f"{self.unmatched} predictions are of scans that are not on disk; their length is not checked"
            )
        if self.official is not None and self.predictions < self.official:
            notes.append(
                f"the benchmark has {self.official} scans in this split; its server refuses an archive of fewer"
            )
        return notes


def write(
    rules: Rules,
    folder: Path,
    out: Path,
    sources: Sources | None = None,
    progress: Progress = lambda done, total: None,
) -> Submission:
    """Check a folder of predictions and pack it; the same predictions give the same bytes.

    What the archive has no place for (scores, other splits) is left out. One scan is in memory at a time.

    Args:
        folder: with the names of `rules` in it.
        out: NAME.zip; it appears whole or not at all.
        sources: what the method was given, where the benchmark asks for it.

    Raises:
        InputError: where a prediction is missing or breaks the rules.
    """
    _check_ending(out)
    if not folder.is_dir():
        raise InputError(f"{folder}: expected a folder of predictions, found none; check the path")
    names = [name for name in (*rules.texts, *sorted(rules.points)) if (folder / name).is_file()]
    _check_missing(rules.required, set(names), str(folder))
    for name in names:
        rules.check_size(name, (folder / name).stat().st_size, str(folder / name))
    with write_archive(out) as add:
        for entry in rules.folders:
            add(entry, b"")
        if rules.meta is not None:
            add(rules.meta, (sources or Sources()).to_json())
        for done, name in enumerate(names):
            progress(done, len(names))
            data = (folder / name).read_bytes()
            rules.check_content(name, data, str(folder / name))
            add(name, data)
    progress(len(names), len(names))
    return _submission(rules, names)


def check(rules: Rules, path: Path, progress: Progress = lambda done, total: None) -> Submission:
    """Check an archive of any tool; names and sizes first, then file by file, one in memory at a time.

    Raises:
        InputError: at the first rule that it breaks.
    """
    _check_ending(path)
    with open_archive(path) as archive:
        _check_tree(rules, archive)
        for name, size in archive.sizes.items():
            rules.check_size(name, size, f"{path}: {name}")
        for done, name in enumerate(
            sorted(archive.sizes, key=lambda name: name in rules.points)
        ):  # short ones first
            progress(done, len(archive.sizes))
            rules.check_content(name, archive.read(name), f"{path}: {name}")
        progress(len(archive.sizes), len(archive.sizes))
        return _submission(rules, archive.sizes)


def _submission(rules: Rules, names: Iterable[str]) -> Submission:
    points = [rules.points[name] for name in names if name in rules.points]
    return Submission(len(points), points.count(None), rules.official)


def _check_ending(path: Path) -> None:
    if path.suffix != ENDING:
        raise InputError(
            f"{path}: expected a name that ends in {ENDING}, found {path.suffix or 'no ending'}; name it so"
        )


def _check_tree(rules: Rules, archive: Archive) -> None:
    """Check names alone."""
    names, path = set(archive.sizes), archive.path
    top = {name.partition("/")[0] for name in (*names, *archive.folders)}
    _check_top(rules, names, top, path)
    if rules.needs_folders and (
        lacking := [entry for entry in rules.folders if entry not in archive.folders]
    ):
        raise InputError(
            f"{path}: expected an entry for every folder, found none for {_one_of(lacking)}; pack folders as entries "
            "of their own, as zip -r does"
        )
    if rules.meta is not None and rules.meta not in names:
        raise InputError(
            f"{path}: expected {rules.meta}, found only {', '.join(map(repr, sorted(top)[:SHOWN])) or 'nothing'}; "
            "add this file, or name the archive's split with --split"
        )
    _check_missing(rules.required, names, str(path))
    if other := sorted(names - {*rules.points, *rules.others}):
        raise InputError(
            f"{path}: expected predictions alone, found {_one_of(other)}; pack it without"
        )


def _check_top(rules: Rules, names: set[str], top: set[str], path: Path) -> None:
    """Tell an archive of a folder from one of what is in it."""
    wanted = {name.partition("/")[0] for name in rules.folders}
    second = {name.split("/")[1] for name in names if "/" in name}
    if len(top) == 1 and not top & wanted and second & wanted:
        raise InputError(
            f"{path}: expected {' and '.join(sorted(wanted))} at the top, found all below {top.pop()!r}; "
            "pack what is in that folder, not the folder itself"
        )


def _check_missing(required: Collection[str], names: set[str], shown: str) -> None:
    if missing := sorted(set(required) - names):
        raise InputError(
            f"{shown}: expected a prediction for each of {len(required)} scans, found no {_one_of(missing)}; "
            "predict these scans too, or name those that there are with --sequences or --split"
        )


def _one_of(names: list[str]) -> str:
    """The first of some names, and how many more there are."""
    first = names[0] if names[0].isprintable() else repr(names[0])
    return first + (f" and {len(names) - 1} more" if len(names) > 1 else "")
