"""Write a YAML file with which a user begins to describe a folder of scans."""

from __future__ import annotations

import glob
import json
import os
import re
from collections import Counter, defaultdict
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from amvnet.data.datasets.description import ENDINGS, REST, LabelPlace
from amvnet.data.formats.cloud import Cloud
from amvnet.data.formats.detect import scan_stem
from amvnet.data.formats.find import list_scans
from amvnet.data.labels.readers import COLUMNS, read_raw_labels
from amvnet.data.labels.writers import read_legend
from amvnet.data.recordings import evenly_spaced
from amvnet.data.taxonomy import INSTANCE_MASK
from amvnet.errors import InputError, counted
from amvnet.files import atomic_write

COUNTED_FILES = 20  # number of label files whose ids are counted
MOST_CLASSES = 50  # largest number of ids that become classes
# Ids that usually stand for no label, as the YAML file writes them.
UNLABELLED: Mapping[int, int | str] = {0: 0, 255: 255, INSTANCE_MASK: -1}
FIRST_MOVING = 252  # SemanticKITTI's ids of moving things, of which 255 is one
TRIED_FILES = 3  # a group has scans if one of so many first files can be read as a scan

SUFFIX = re.compile(r"[_.-][A-Za-z]+$")  # the last word of a stem, as in 0001_label

# What files of one kind have in common: their ending, the name of their folder, and the SUFFIX.
Group = tuple[str, str, str]


@dataclass(frozen=True)
class Found:
    """The scans in a folder, and their labels.

    Attributes:
        scans: the files of the scans, sorted.
        pattern: a pattern that matches them, relative to the folder.
        first: the points of the first scan that could be read.
        labels: the place of the labels; None if there are none.
        labelled: the number of scans with labels.
        ids: the number of points by raw id in some of the labels, most first.
        unlabelled: the id that the labels themselves name as that of no class, if any.
    """

    scans: Sequence[Path]
    pattern: str
    first: Cloud
    labels: LabelPlace | None = None
    labelled: int = 0
    ids: Mapping[int, int] = field(default_factory=dict)
    unlabelled: int = 0

    def lines(self) -> Iterator[str]:
        """Yield lines that say what was found."""
        columns = ["x", "y", "z"]
        for name in ("intensity", "ring"):
            if getattr(self.first, name) is not None:
                columns.append(name)
        yield (
            f"{counted(len(self.scans), 'scan')} {self.pattern} with {', '.join(columns)}; "
            f"{len(self.first.xyz):,} points in the first one"
        )
        if self.labels is None:
            yield f"no file with a label for each point of {self.scans[0]}"
        else:
            ids = ", ".join(f"{raw} ({count:,})" for raw, count in self.ids.items())
            place = _yaml(_entry(self.labels))
            yield f"labels of {counted(self.labelled, 'scan')} at {place}; points by id: {ids}"

    def text(self, root: str) -> str:
        """Return the YAML file, which lies beside the folder `root`."""
        total = sum(self.ids.values())
        unlabelled = {self.unlabelled: self.unlabelled, **UNLABELLED}
        if any(FIRST_MOVING <= raw < INSTANCE_MASK and raw != 255 for raw in self.ids):
            unlabelled.pop(255)
        classes = [raw for raw in self.ids if raw not in unlabelled][:MOST_CLASSES]
        ignored: Counter[int | str] = Counter()
        for raw, count in self.ids.items():
            if raw not in classes:
                ignored[unlabelled.get(raw, REST)] += count
        shares = ", ".join(f"{raw}: {count / total:.1%}" for raw, count in ignored.items())
        lines = [
            "# Give each class a name; one class may have several ids, as [1, 2].",
            "# docs/own_data.md explains all keys.",
            f"root: {_yaml(root)}",
            f"scans: {_yaml(self.pattern)}",
        ]
        if self.labels is None:
            lines.append('# labels: "{name}.label"  # where the file with a label per point is')
            lines += ["classes:", "  first: 1  # the name of a class, and its id", "  second: 2"]
        else:
            lines += [f"labels: {_yaml(_entry(self.labels))}", "classes:"]
            lines += [f"  class_{raw}: {raw}  # {self.ids[raw] / total:.1%}" for raw in classes]
        lines.append(
            f"ignored: {_yaml(list(ignored))}  # ids without a class; {shares}".rstrip("; ")
        )
        return "\n".join([*lines, ""])


def write_starter(folder: Path) -> tuple[Path, Found]:
    """Write the YAML file of a folder beside it; return its path, and what is in the folder.

    If the place beside it is read-only, the file comes into the current folder.

    Raises:
        InputError: if there is no scan in the folder or below it, a name cannot be in a YAML file,
            or the file cannot be written.
    """
    folder = folder.absolute()
    found = find_labelled(folder)
    path = folder.with_name(f"{folder.name}{ENDINGS[0]}")
    text = found.text(folder.name)
    if not os.access(folder.parent, os.W_OK):
        path = Path.cwd() / path.name
        text = found.text(str(folder))
        if path.exists():
            raise InputError(
                f"{folder}: expected no YAML file of this name here, as the folder above is "
                f"read-only, found {path}; run amvnet check {path.name}, or remove it"
            )
    if not (folder.name + text.replace("\n", "")).isprintable():
        raise InputError(
            f"{folder}: expected names of printable characters, which a YAML file can hold, found "
            "others; rename the folders"
        )
    with atomic_write(path) as part:
        part.write_text(text, encoding="utf-8")
    return path, found


def find_labelled(folder: Path) -> Found:
    """Find the scans in a folder and below it, and their labels.

    Raises:
        InputError: if there is no scan.
    """
    groups = _groups_in(folder)
    readable = {}
    for group, paths in groups.items():
        first_scan = _first_scan(paths)
        if first_scan is not None:
            readable[group] = first_scan

    places: dict[Group, LabelPlace] = {}
    label_groups = set()  # an array of labels can also be readable as points
    for group, (scan, cloud) in readable.items():
        count = len(cloud.xyz)
        for other, candidates in groups.items():
            if other == group:
                continue
            place = _place_among(candidates, scan, count)
            if place is not None:
                places[group] = place
                label_groups.add(other)
        elsewhere = _place_inside(scan, count) or _place_beside(folder, scan, count)
        if elsewhere is not None:
            places.setdefault(group, elsewhere)

    scan_groups = [group for group in readable if group not in label_groups]
    if not scan_groups:
        raise InputError(f"{folder}: expected scans, found none that can be read; name others")
    best = max(scan_groups, key=lambda group: (group in places, len(groups[group])))
    # Scans of one ending belong together, even if their folders have different names.
    ending = best[0]
    paths = sorted(path for group in scan_groups if group[0] == ending for path in groups[group])
    pattern = _pattern_of([path.relative_to(folder) for path in paths], ending)
    first = readable[best][1]
    place = places.get(best)
    if place is None:
        return Found(paths, pattern, first)

    labelled = [path for path in paths if place.path_of(path, scan_stem(path)).is_file()]
    legend = read_legend(place.path_of(labelled[0], scan_stem(labelled[0])))
    unlabelled = 0 if legend is None else legend.train_to_raw[0]
    ids = _ids_of(labelled, place)
    return Found(paths, pattern, first, place, len(labelled), ids, unlabelled)


def _groups_in(folder: Path) -> Mapping[Group, Sequence[Path]]:
    """Return the files in a folder and below it by their groups, without hidden ones, sorted."""
    groups: dict[Group, list[Path]] = defaultdict(list)
    for path in sorted(folder.rglob("*")):
        is_hidden = any(part.startswith(".") for part in path.relative_to(folder).parts)
        if path.is_file() and not is_hidden:
            stem = scan_stem(path)
            suffix = SUFFIX.search(stem)
            ending = path.name[len(stem) :]
            groups[ending, path.parent.name, suffix[0] if suffix else ""].append(path)
    return groups


def _first_scan(paths: Sequence[Path]) -> tuple[Path, Cloud] | None:
    """Return the first file that can be read as a scan, and its points.

    Return None if none of the first `TRIED_FILES` can be read.
    """
    for path in paths[:TRIED_FILES]:
        with suppress(InputError):
            return path, next(iter(list_scans(path))).read()
    return None


def _place_among(paths: Sequence[Path], scan: Path, count: int) -> LabelPlace | None:
    """Return the place of the labels of a scan with `count` points, if they are among some files.

    Only the nearest file that has the scan's name in its own counts.
    """
    stem = scan_stem(scan)
    named = [path for path in paths if stem in path.name]
    if not named:
        return None
    nearest = min(named, key=lambda path: len(os.path.relpath(path, scan.parent)))
    with suppress(InputError):
        read_raw_labels(nearest, count, missing=0)
        folder = Path(os.path.relpath(nearest.parent, scan.parent))
        return LabelPlace((folder / nearest.name.replace(stem, "{name}", 1)).as_posix())
    return None


def _place_beside(folder: Path, scan: Path, count: int) -> LabelPlace | None:
    """Return the place of the labels of a scan if a folder beside that of all scans holds them."""
    below = scan.parent.relative_to(folder)
    named = f"*{glob.escape(scan_stem(scan))}*"
    for other in sorted(folder.parent.glob("*")):
        paths = sorted((other / below).glob(named)) if other != folder else []
        for path in paths:
            place = _place_among([path], scan, count)
            if place is not None:
                return place
    return None


def _place_inside(scan: Path, count: int) -> LabelPlace | None:
    """Return the place of the labels of a scan if a column of its own file holds them."""
    for column in COLUMNS:
        with suppress(InputError):
            read_raw_labels(scan, count, column, missing=0)
            return LabelPlace(field=column)
    return None


def _ids_of(scans: Sequence[Path], place: LabelPlace) -> dict[int, int]:
    """Return the number of points by raw id in the labels of some of the scans, most first."""
    ids: Counter[int] = Counter()
    for scan in evenly_spaced(scans, COUNTED_FILES):
        with suppress(InputError):
            count = len(next(iter(list_scans(scan))).read().xyz)
            labels = read_raw_labels(
                place.path_of(scan, scan_stem(scan)), count, place.field, missing=0
            )
            values, counts = np.unique(labels & INSTANCE_MASK, return_counts=True)
            ids.update(dict(zip(values.tolist(), counts.tolist(), strict=True)))
    return dict(ids.most_common())


def _pattern_of(paths: Sequence[Path], ending: str) -> str:
    """Return a pattern that matches all files with an ending in the folders of some paths.

    It has `*` where names of folders differ, and `**` if folders are at different depths.
    """
    depths = {len(path.parts) for path in paths}
    if len(depths) > 1:
        return f"**/*{ending}"
    levels = zip(*(path.parent.parts for path in paths), strict=True)
    folders = [glob.escape(names[0]) if len(set(names)) == 1 else "*" for names in levels]
    return "/".join([*folders, f"*{ending}"])


def _entry(place: LabelPlace) -> str | dict[str, str]:
    """Return the place of labels as the key `labels` of a description holds it."""
    return {"field": place.field} if place.field is not None else place.file or ""


def _yaml(value: object) -> str:
    """Return a value on one line of YAML; JSON is YAML."""
    return json.dumps(value, ensure_ascii=False)
