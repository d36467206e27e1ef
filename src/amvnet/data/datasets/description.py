"""The YAML file that describes a user's own scans and classes (docs/own_data.md)."""

from __future__ import annotations

import dataclasses
import os
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from amvnet.config.yaml_files import read_yaml
from amvnet.data.formats.rows import UNKNOWN, USUAL_TYPE, RowLayout
from amvnet.data.taxonomy import INSTANCE_MASK, Taxonomy, class_entries, user_taxonomy
from amvnet.errors import InputError, did_you_mean, errors_of, shown

ENDINGS = (".yaml", ".yml")
ROW_KEYS = ("columns", "dtype")  # say what rows of numbers without names hold
KEYS = (
    *("name", "root", "classes", "ignored", "scans", "labels", "poses", "split", "sensor"),
    *ROW_KEYS,
)
OTHER_NAMES = {"names": "classes"}  # keys of the same meaning in other tools' files
SPLITS = ("train", "val", "test")
WILDCARDS = set("*?[")  # characters of patterns
PLACEHOLDER = re.compile(r"\{\w*\}")
REST = "rest"  # an entry of `ignored`: all ids that the file does not name


@dataclass(frozen=True)
class LabelPlace:
    """Where the labels of a scan are.

    Attributes:
        file: path of the label file, relative to the scan's folder, with `{name}` for the scan's
            name without its ending; None if the labels are in the scan's file.
        field: the column or array that holds the labels; None if the file holds nothing else.
    """

    file: str | None = None
    field: str | None = None

    def path_of(self, scan: Path, name: str) -> Path:
        """Return the file of the labels of a scan, given its file and its name."""
        return scan if self.file is None else below(scan.parent, self.file.replace("{name}", name))


def below(folder: Path, name: str) -> Path:
    """Return the path of a name relative to a folder, without `..` where there are no links.

    Messages show the path, and without `..` it is easier to read.
    """
    parts = Path(name).parts
    # The parent of a link is not the folder that `..` leads to.
    while parts[:1] == ("..",) and folder.name not in ("", "..") and not folder.is_symlink():
        folder = folder.parent
        parts = parts[1:]
    return folder.joinpath(*parts)


@dataclass(frozen=True)
class Description:
    """What the YAML file of a dataset says.

    Attributes:
        path: the YAML file.
        root: the folder of the data, absolute; all other paths are relative to it.
        taxonomy: the classes of predictions, and of labels unless there is `unread`.
        scans: the pattern of the scan files.
        labels: where labels are; None if scans have no labels.
        poses: the file of the poses of all scans in a folder, relative to this folder; empty if
            the poses are unknown.
        unread: the classes of the labels, if they are not the classes in `taxonomy`. Such labels
            are not read.
        split: names of folders and scans, and patterns, by split; empty if there is no split.
        sensor: the name of the sensor, or its attributes by name (`sensors.lidars.make_sensor`);
            None if it is to be measured.
        layout: what rows of numbers without names hold.
    """

    path: Path
    root: Path
    taxonomy: Taxonomy
    scans: str
    labels: LabelPlace | None = None
    poses: str = ""
    unread: Taxonomy | None = None
    split: Mapping[str, Sequence[str]] = field(default_factory=dict)
    sensor: str | Mapping[str, Any] | None = None
    layout: RowLayout = UNKNOWN


def is_description(text: str) -> bool:
    """Return whether a text names a YAML file."""
    return text.lower().endswith(ENDINGS) and Path(os.path.expanduser(text)).is_file()


def read_description(path: Path | str) -> Description:
    """Read what a YAML file says of a dataset.

    Raises:
        InputError: if the file cannot be read, lacks a key or has a wrong one.
    """
    path = Path(os.path.expanduser(path))
    tree = read_yaml(path, "a description of scans and classes")
    with errors_of(path):
        return _parse(path, tree)


def _parse(path: Path, tree: Any) -> Description:
    """Return the description that the tree of a YAML file holds; messages name the key only."""
    _check_keys("", tree, KEYS, required=("classes", "scans"))
    root = below(path.parent.absolute(), os.path.expanduser(_text(tree, "root", ".")))

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
        poses=_text(tree, "poses", ""),
        split=_parse_split(tree.get("split") or {}),
        sensor=tree.get("sensor"),
        layout=RowLayout(
            columns=_texts("columns", tree.get("columns", ())),
            dtypes=_texts("dtype", tree.get("dtype", USUAL_TYPE)),
            in_yaml=True,
        ),
    )


def _parse_classes(name: str, tree: Mapping[str, Any]) -> Taxonomy:
    """Return the classes: names, raw ids and, if the file has them, colours."""
    entries = class_entries(tree["classes"], "ids", "road: [1, 2]")
    train_to_raw = []
    raw_to_train: dict[int | str, int] = {}
    for train_id, (class_name, values) in enumerate(entries.items(), start=1):
        title = f"classes: {class_name}"
        _check_keys(title, values, ("ids", "color"), required=("ids",))
        ids = _ids(title, values["ids"], smallest=0)
        if not ids:
            raise InputError(f"{title}: expected ids, found none; name one or more")
        train_to_raw.append(ids[0])
        for raw_id in ids:
            _add_id(raw_to_train, raw_id, train_id)

    ignored = tree.get("ignored", [])
    if not isinstance(ignored, list):
        ignored = [ignored]
    ids = _ids("ignored", [entry for entry in ignored if entry != REST], smallest=-1)
    for raw_id in ids:
        _add_id(raw_to_train, raw_id, 0)

    if not ids:  # predictions need an id for points without a class: the first that no class has
        ids = [next(raw_id for raw_id in range(INSTANCE_MASK) if raw_id not in raw_to_train)]
        raw_to_train[ids[0]] = 0
    taxonomy = user_taxonomy(name, entries, raw_to_train, (ids[0], *train_to_raw))
    return dataclasses.replace(taxonomy, ignores_rest=REST in ignored)


def _add_id(raw_to_train: dict[int | str, int], raw_id: int, train_id: int) -> None:
    """Add a raw id to the ids of a class, or raise InputError if it has a class already."""
    if raw_id in raw_to_train:
        raise InputError(f"classes: expected each id once, found {raw_id} twice; correct the ids")
    raw_to_train[raw_id] = train_id


def _ids(title: str, values: Any, smallest: int) -> list[int]:
    """Return one or several raw ids as a list; raise InputError if one is no raw id.

    An id of -1, which many tools write for no label, becomes the largest id.
    """
    ids = []
    for raw_id in values if isinstance(values, list) else [values]:
        if type(raw_id) is not int or not smallest <= raw_id <= INSTANCE_MASK:
            raise InputError(
                f"{title}: expected whole numbers from {smallest} to {INSTANCE_MASK} as ids, "
                f"found {shown(raw_id)}; correct them"
            )
        ids.append(raw_id & INSTANCE_MASK)

    return ids


def _parse_labels(entry: Any) -> LabelPlace | None:
    """Return the place of the labels: a path, an ending such as .label, or a file and a field."""
    if entry is None:
        return None
    if isinstance(entry, str):
        entry = {"file": entry}

    _check_keys("labels", entry, ("file", "field"))
    file = _text(entry, "file", "") or None
    column = entry.get("field")
    if file is None and column is None:
        raise InputError("labels: expected a file or a field, found neither; name one")

    others = set(PLACEHOLDER.findall(file or "")) - {"{name}"}
    if others:
        raise InputError(
            f"labels: expected {{name}} for the scan's name, found {min(others)}; correct it"
        )
    if file is not None and "{name}" not in file:
        is_ending = file.startswith(".") and "/" not in file
        if not is_ending:
            raise InputError(
                f"labels: expected the scan's name in the file, found {file!r}; "
                "write for example ../labels/{name}.label"
            )
        file = "{name}" + file
    return LabelPlace(file, None if column is None else str(column))


def _parse_split(entry: Any) -> dict[str, tuple[str, ...]]:
    """Return the names and patterns of each split, without a / at their ends."""
    _check_keys("split", entry, SPLITS)
    splits = {}
    for split, values in entry.items():
        names = _texts(f"split: {split}", values)
        if not names:
            raise InputError(f"split: {split}: expected names, found none; add some")
        splits[split] = tuple(name.rstrip("/") for name in names)
    return splits


def _check_keys(title: str, tree: Any, keys: Sequence[str], required: Sequence[str] = ()) -> None:
    """Raise InputError if a mapping lacks a key or has an unknown one, or is no mapping.

    `title` is the key that holds the mapping; it is empty for the whole file.
    """
    prefix = f"{title}: " if title else ""
    if not isinstance(tree, Mapping):
        raise InputError(
            f"{prefix}expected the keys {', '.join(keys)}, found {shown(tree)}; "
            "see docs/own_data.md"
        )

    for key in tree:
        if key not in keys:
            raise InputError(
                f"{prefix}expected keys of {', '.join(keys)}, found {shown(key)}"
                + did_you_mean(OTHER_NAMES.get(key, str(key)), keys, "correct the key")
            )
    for key in required:
        if key not in tree:
            raise InputError(f"{prefix}expected the key {key}, found none; add it")


def _text(tree: Mapping[str, Any], key: str, usual: str | None = None) -> str:
    """Return the text of a key; without a `usual` one, the key is needed."""
    value = tree.get(key, usual)
    if not isinstance(value, str):
        raise InputError(f"{key}: expected a text, found {shown(value)}; correct it")
    return value


def _texts(title: str, values: Any) -> tuple[str, ...]:
    """Return one or several texts; a number, such as the name of the folder 7, is a text, too."""
    entries = values if isinstance(values, list | tuple) else [values]
    for entry in entries:
        if not isinstance(entry, str | int):
            raise InputError(f"{title}: expected names, found {shown(entry)}; correct them")
    return tuple(map(str, entries))
