"""Labelled scans of a user in any layout, described by a YAML file (docs/own_data.md)."""

from __future__ import annotations

import dataclasses
import glob
import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from fnmatch import fnmatchcase
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from amvnet.data.datasets.base import Dataset, ScanRecord, check_split
from amvnet.data.formats.cloud import Cloud
from amvnet.data.formats.find import ANY_FOLDERS, NamedScan, list_scans, matching, scan_stem
from amvnet.data.formats.rows import UNKNOWN, USUAL_TYPE, RowLayout
from amvnet.data.labels.ids import train_ids
from amvnet.data.labels.readers import read_raw_labels
from amvnet.data.taxonomy import INSTANCE_MASK, Taxonomy, class_entries, user_taxonomy
from amvnet.errors import InputError, did_you_mean, errors_of, readable, reason_of, shown
from amvnet.files import read_yaml
from amvnet.scan import Scan

ENDINGS = (".yaml", ".yml")
KEYS = (
    *("name", "root", "classes", "ignored", "scans", "labels", "split", "sensor"),
    *("columns", "dtype"),
)
SPLITS = ("train", "val", "test")
WILDCARDS = set("*?[")  # characters of patterns
REST = "rest"  # among the ignored ids: all ids that the file does not name

# Turns the points of a file into a scan, given the name of the recording.
Normalise = Callable[[Cloud, str], Scan]


@dataclass(frozen=True)
class LabelPlace:
    """Where the labels of a scan are.

    Attributes:
        file: path of the label file, relative to the scan's folder, with `{name}` for the scan's
            name without its ending; None if the labels are in the scan's file.
        field: the column or array that holds them; None in a file of nothing else.
    """

    file: str | None = None
    field: str | None = None

    def path_of(self, scan: Path, name: str) -> Path:
        """Return the file of the labels of a scan, given its file and its name."""
        return scan if self.file is None else scan.parent / self.file.replace("{name}", name)


@dataclass(frozen=True)
class Description:
    """What the YAML file of a dataset says.

    Attributes:
        path: of the YAML file.
        root: the folder that everything is relative to.
        taxonomy: the classes.
        scans: pattern of the scan files.
        labels: where the labels are; None if there are none.
        reads_labels: whether the labels are read; not if they have other classes than `taxonomy`.
        split: names of folders and scans, and patterns, by split; empty if there is no split.
        sensor: name or attributes of the sensor; None if it is to be measured.
        layout: what rows of numbers without names hold.
    """

    path: Path
    root: Path
    taxonomy: Taxonomy
    scans: str
    labels: LabelPlace | None = None
    reads_labels: bool = True
    split: Mapping[str, Sequence[str]] = field(default_factory=dict)
    sensor: str | Mapping[str, Any] | None = None
    layout: RowLayout = UNKNOWN


class OwnScans(Dataset):
    """A user's labelled scans. `Dataset` documents the arguments and errors of its methods.

    A scan's sequence is the first folder below the part of the pattern that has no wildcards. If
    the split cuts through a folder, its parts are sequences: `site-train`, `site-val`.

    Args:
        description: what the YAML file says.
        normalise: makes scans of the points in the files; None takes them as they are.
    """

    def __init__(
        self,
        description: Description,
        normalise: Normalise | None = None,
    ) -> None:
        super().__init__(description.root, description.taxonomy, str(description.path))
        self.description = description
        self.normalise = normalise
        self._counts: dict[str, int] = {}  # points of the scans that have been read, by name

    @property
    def is_split(self) -> bool:
        """Whether the file has a split; what it does not name is not chosen by default."""
        return bool(self.description.split)

    def official(self, split: str) -> tuple[str, ...]:
        """Return the sequences of "train", "val" or "test" by the file's split, or "all"."""
        check_split(self.spec, split, (*SPLITS, "all"))
        names = set()
        for record, split_of_scan in self._listing:
            if split in ("all", split_of_scan):
                names.add(record.sequence)

        if not names:
            found = f"only {' and '.join(self.description.split)}"
            if not self.is_split:
                labelled = {record.sequence for record, _ in self._listing if record.has_labels}
                alone = f", and labels of {min(labelled)} alone" if len(labelled) == 1 else ""
                found = f"no split{alone}"
            raise InputError(
                f"{self.spec}: expected scans of the split {split}, found {found}; name them under "
                "split, or give --split all or the names of sequences"
            )
        return tuple(sorted(names))

    def left_out(self) -> list[ScanRecord]:
        """Return the scans that the file's split does not name."""
        return [record for record, split in self._listing if self.is_split and not split]

    def records(self, sequences: Sequence[str]) -> list[ScanRecord]:
        """Return the scans of these sequences, in order."""
        present = self.sequences("all")
        for name in sequences:
            if name not in present:
                raise InputError(
                    f"{self.spec}: expected a sequence of {', '.join(present[:20])}, "
                    f"found {name!r}; name one of them"
                )

        chosen = [record for record, _ in self._listing if record.sequence in sequences]
        return sorted(chosen, key=lambda record: (record.sequence, record.name))

    def labelled(self, records: Sequence[ScanRecord]) -> list[ScanRecord]:
        """Return the scans that have labels."""
        labelled = [record for record in records if record.labels_path is not None]

        if records and not labelled:
            place = self.description.labels
            found = "no labels in the description"
            if not self.description.reads_labels:
                found = f"no labels of the classes of {self.taxonomy.name}"
            elif place is not None:
                scan = self._scans[records[0].name]
                path = os.path.normpath(place.path_of(scan.path, scan.name))
                found = f"no {path}"
                if len(records) > 1:
                    found += f", and none for the other {len(records) - 1} scans"
            raise InputError(
                f"{self.spec}: expected labelled scans, found {found}; "
                "correct labels in the file, or name other sequences"
            )
        return labelled

    def read(self, record: ScanRecord, labels: bool = True) -> Scan:
        """Read one scan."""
        named = self._scans[record.name]
        cloud = named.read()
        scan = cloud.to_scan() if self.normalise is None else self.normalise(cloud, named.source)
        self._counts[record.name] = len(scan)

        ids = None
        path = record.labels_path
        if labels and path is not None:
            ids = train_ids(path, self.raw_labels(record, len(scan)), self.taxonomy)
        return dataclasses.replace(scan, labels=ids, name=record.name)

    def read_unchanged(self, record: ScanRecord) -> Scan:
        """Read the points of one scan as they are in its file."""
        scan = self._scans[record.name].read().to_scan()
        self._counts[record.name] = len(scan)
        return dataclasses.replace(scan, name=record.name)

    def raw_labels(self, record: ScanRecord, count: int) -> np.ndarray:
        """Read the (N,) raw ids of one scan."""
        place = self.description.labels
        assert place is not None
        assert record.labels_path is not None
        layout = self.description.layout
        missing = self.taxonomy.train_to_raw[0]
        return read_raw_labels(record.labels_path, count, place.field, layout, missing=missing)

    def reading_key(self) -> str:
        """Return what the file says of how scans and labels are read."""
        described = self.description
        missing = described.taxonomy.train_to_raw[0]
        return repr((self.root, described.scans, described.labels, described.layout, missing))

    def count_points(self, record: ScanRecord) -> int:
        """Return the number of points of a scan; the file is not read a second time."""
        if record.name not in self._counts:
            self._counts[record.name] = len(self._scans[record.name].read().xyz)
        return self._counts[record.name]

    def recordings(self) -> dict[str, list[NamedScan]]:
        """Return the scans of each recording, in order; each has one folder and one ending."""
        recordings: dict[str, list[NamedScan]] = {}
        for scan in self._scans.values():
            recordings.setdefault(scan.source, []).append(scan)
        return recordings

    def with_classes(self, taxonomy: Taxonomy) -> OwnScans:
        """Return the scans for predictions of other classes; their labels are not read."""
        description = dataclasses.replace(self.description, taxonomy=taxonomy, reads_labels=False)
        return OwnScans(description, self.normalise)

    def files_of(self, record: ScanRecord) -> list[Path]:
        """Return the files of a scan: its labels are the user's even if they are not read."""
        files = super().files_of(record)
        place = self.description.labels
        if place is not None:
            scan = self._scans[record.name]
            files.append(place.path_of(scan.path, scan.name))
        return files

    @cached_property
    def _scans(self) -> dict[str, NamedScan]:
        """The scans by name: the path from `root`, without the ending."""
        pattern = self.description.scans
        try:
            matches = sorted(self.root.glob(pattern))
            if ANY_FOLDERS in Path(pattern).parts:  # Python's own does not follow links
                matches = matching(Path(glob.escape(str(self.root))) / pattern)
        except (ValueError, NotImplementedError, IndexError, OSError) as error:
            reason = "" if isinstance(error, IndexError) else f" ({reason_of(error)[:160]})"
            raise InputError(
                f"{self.spec}: scans: expected a pattern, found {shown(pattern)}{reason}; "
                "correct it, or root"
            ) from None
        paths = [path for path in matches if path.is_file() and not path.name.startswith(".")]

        # Files of labels may also match the pattern of the scans.
        place = self.description.labels
        label_paths = set()
        if place is not None and place.file is not None:
            label_paths = {place.path_of(path, scan_stem(path)) for path in paths}

        scans: dict[str, NamedScan] = {}
        for path in paths:
            if path in label_paths:
                continue

            for scan in list_scans(path, layout=self.description.layout):
                name = (scan.path.parent.relative_to(self.root) / scan.name).as_posix()
                if name in scans:
                    raise InputError(
                        f"{self.spec}: expected one scan named {name}, found "
                        f"{scans[name].path.name} and {scan.path.name}; make the pattern of the "
                        "scans narrower"
                    )
                scans[name] = scan

        if not scans:
            raise InputError(
                f"{self.root}: expected scan files {pattern}, found none; correct scans or root"
            )
        return scans

    @cached_property
    def _listing(self) -> list[tuple[ScanRecord, str]]:
        """The records of all scans, each with its split ("" if it is in none)."""
        splits = self._splits()
        splits_of_folder: dict[str, set[str]] = {}
        for name, split in splits.items():
            splits_of_folder.setdefault(self._folder_of(name), set()).add(split)

        listing = []
        for name, scan in self._scans.items():
            sequence = self._folder_of(name)
            if len(splits_of_folder[sequence]) > 1:
                sequence = f"{sequence}-{splits[name] or 'rest'}"

            place = self.description.labels
            labels_path = None if place is None else place.path_of(scan.path, scan.name)
            with readable(f"{self.spec}: labels: {shown(str(labels_path))}"):
                has_labels = labels_path is not None and labels_path.is_file()

            record = ScanRecord(
                name=name,
                sequence=sequence,
                points_path=scan.path,
                labels_path=labels_path if has_labels and self.description.reads_labels else None,
                prediction=f"{name}.label",
            )
            listing.append((record, splits[name]))
        return listing

    def _folder_of(self, name: str) -> str:
        """Return the name of the folder that is the sequence of a scan."""
        fixed = _fixed_part(self.description.scans)
        parts = Path(name).relative_to(fixed).parts
        if len(parts) > 1:
            return parts[0]
        return fixed.name or "all"

    def _splits(self) -> dict[str, str]:
        """Return the split of each scan, by its name; "" if it is in none.

        If the file names a split but no "train", all scans that it does not name are of it.

        Raises:
            InputError: if an entry of the split matches no scan, or a scan is in two splits.
        """
        entries = []
        for split, names in self.description.split.items():
            entries += [(split, entry) for entry in names]
        usual = "train" if self.is_split and "train" not in self.description.split else ""

        splits = {}
        matched = set()
        for name, scan in self._scans.items():
            found = self._entries_of(name, scan.path, entries)
            of_scan = sorted({split for split, _ in found}, key=SPLITS.index)
            if len(of_scan) > 1:
                raise InputError(
                    f"{self.spec}: expected a scan in one split, found {name} in "
                    f"{' and '.join(of_scan)}; correct the split"
                )
            splits[name] = of_scan[0] if of_scan else usual
            matched |= found

        for split, entry in entries:
            if (split, entry) not in matched:
                folders = dict.fromkeys(map(self._folder_of, self._scans))
                advice = f"name a folder ({', '.join(list(folders)[:20])}), a scan or a pattern"
                raise InputError(
                    f"{self.spec}: split: {split}: expected entries that match scans, found "
                    f"{shown(entry)}, which matches none" + did_you_mean(entry, folders, advice)
                )
        return splits

    def _entries_of(
        self, name: str, path: Path, entries: Sequence[tuple[str, str]]
    ) -> set[tuple[str, str]]:
        """Return the entries of the split, each with its split, that match a scan."""
        folders = map(Path.as_posix, Path(name).parents)
        file = path.relative_to(self.root).as_posix()
        texts = {name, file, self._folder_of(name), *folders}

        found = set()
        for split, entry in entries:
            if entry in texts or (set(entry) & WILDCARDS and fnmatchcase(name, entry)):
                found.add((split, entry))
        return found


def _fixed_part(pattern: str) -> Path:
    """Return the folders at the beginning of a pattern that have no wildcards."""
    fixed = Path()
    for part in Path(pattern).parts[:-1]:
        if set(part) & WILDCARDS:
            break
        fixed /= part
    return fixed


def is_description(text: str) -> bool:
    """Return whether a text names a YAML file."""
    return text.lower().endswith(ENDINGS) and Path(os.path.expanduser(text)).is_file()


def open_own(path: Path | str) -> OwnScans:
    """Open the dataset that a YAML file describes.

    Raises:
        InputError: if the file cannot be read, lacks a key or has a wrong one, or there is no scan.
    """
    path = Path(os.path.expanduser(path))
    tree = read_yaml(path, "a description of scans and classes")
    with errors_of(path):
        dataset = OwnScans(_parse(path, tree))
    dataset.sequences("all")
    return dataset


def _parse(path: Path, tree: Any) -> Description:
    """Return what the YAML file says."""
    _check_keys("the file", tree, KEYS, required=("classes", "scans"))
    root = (path.parent / os.path.expanduser(_text(tree, "root", "."))).absolute()

    scans = _text(tree, "scans")
    if Path(scans).is_absolute() or ".." in Path(scans).parts:
        raise InputError(
            f"scans: expected a pattern below the file's folder, found {scans!r}; "
            "name the folder of the data as root"
        )

    return Description(
        path,
        root,
        taxonomy=_parse_classes(_text(tree, "name", path.stem), tree),
        scans=scans,
        labels=_parse_labels(tree.get("labels")),
        split=_parse_split(tree.get("split") or {}),
        sensor=tree.get("sensor"),
        layout=RowLayout(
            columns=_texts("columns", tree.get("columns", ())),
            dtypes=_texts("dtype", tree.get("dtype", USUAL_TYPE)),
        ),
    )


def _parse_classes(name: str, tree: Mapping[str, Any]) -> Taxonomy:
    """Return the classes: names, raw ids and, if the file has them, colours."""
    entries = class_entries(tree["classes"], "ids", "road: [1, 2]")
    train_to_raw = []
    raw_to_train: dict[int | str, int] = {}
    for train_id, (title, values) in enumerate(entries.items(), start=1):
        _check_keys(f"classes: {title}", values, ("ids", "color"), required=("ids",))
        ids = _ids(f"classes: {title}", values["ids"])
        if not ids:
            raise InputError(f"classes: {title}: expected ids, found none; name one or more")
        train_to_raw.append(ids[0])
        for raw_id in ids:
            _add(raw_to_train, raw_id, train_id)

    entries_ignored = tree.get("ignored", [])
    if not isinstance(entries_ignored, list):
        entries_ignored = [entries_ignored]
    ignored = _ids("ignored", [entry for entry in entries_ignored if entry != REST])
    for raw_id in ignored:
        _add(raw_to_train, raw_id, 0)

    if not ignored:  # predictions need an id for points without a class
        ignored = [next(raw for raw in range(INSTANCE_MASK) if raw not in raw_to_train)]
        raw_to_train[ignored[0]] = 0
    taxonomy = user_taxonomy(name, entries, raw_to_train, (ignored[0], *train_to_raw))
    return dataclasses.replace(taxonomy, ignores_rest=REST in entries_ignored)


def _add(raw_to_train: dict[int | str, int], raw_id: int, train_id: int) -> None:
    if raw_id in raw_to_train:
        raise InputError(f"classes: expected each id once, found {raw_id} twice; correct the ids")
    raw_to_train[raw_id] = train_id


def _ids(title: str, values: Any) -> list[int]:
    """Return raw ids; -1, which many tools write for no label, becomes the largest id."""
    ids = []
    for raw_id in values if isinstance(values, list) else [values]:
        if type(raw_id) is not int or not -1 <= raw_id <= INSTANCE_MASK:
            raise InputError(
                f"{title}: expected whole numbers from -1 to {INSTANCE_MASK} as ids, "
                f"found {shown(raw_id)}; correct them"
            )
        ids.append(raw_id & INSTANCE_MASK)

    return ids


def _parse_labels(entry: Any) -> LabelPlace | None:
    """Return where the labels are."""
    if entry is None:
        return None
    if isinstance(entry, str):
        entry = {"file": entry}

    _check_keys("labels", entry, ("file", "field"))
    file = _text(entry, "file", "") or None
    column = entry.get("field")
    if file is None and column is None:
        raise InputError("labels: expected a file or a field, found neither; name one")

    if file is not None and "{name}" not in file:
        if not file.startswith("."):
            raise InputError(
                f"labels: expected the scan's name in the file, found {file!r}; "
                "write for example ../labels/{name}.label"
            )
        file = "{name}" + file  # only an ending
    return LabelPlace(file, None if column is None else str(column))


def _parse_split(entry: Any) -> dict[str, tuple[str, ...]]:
    """Return the names by split."""
    _check_keys("split", entry, SPLITS)
    splits = {}
    for split, values in entry.items():
        names = _texts(f"split: {split}", values)
        if not names:
            raise InputError(f"split: {split}: expected names, found none; add some")
        splits[split] = tuple(name.rstrip("/") for name in names)
    return splits


def _check_keys(title: str, tree: Any, keys: Sequence[str], required: Sequence[str] = ()) -> None:
    """Raise InputError if a mapping lacks a key or has an unknown one, or is none."""
    if not isinstance(tree, Mapping):
        raise InputError(
            f"{title}: expected the keys {', '.join(keys)}, found {shown(tree)}; "
            "see docs/own_data.md"
        )

    for key in tree:
        if key not in keys:
            raise InputError(
                f"{title}: expected keys of {', '.join(keys)}, found {shown(key)}; correct the key"
            )
    for key in required:
        if key not in tree:
            raise InputError(f"{title}: expected the key {key}, found none; add it")


def _text(tree: Mapping[str, Any], key: str, usual: str | None = None) -> str:
    value = tree.get(key, usual)
    if not isinstance(value, str):
        raise InputError(f"{key}: expected a text, found {shown(value)}; correct it")
    return value


def _texts(title: str, values: Any) -> tuple[str, ...]:
    """Return one or several texts; numbers, such as the sequence 07, count as texts."""
    entries = values if isinstance(values, list | tuple) else [values]
    for entry in entries:
        if not isinstance(entry, str | int):
            raise InputError(f"{title}: expected names, found {shown(entry)}; correct them")
    return tuple(map(str, entries))
