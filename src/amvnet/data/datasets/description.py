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
KEYS = (
    *("name", "root", "classes", "ignored", "scans", "labels", "poses", "split", "sensor"),
    *("columns", "dtype"),
)
OTHER_NAMES = {"names": "classes"}  # keys of the same meaning in other tools' files
SPLITS = ("train", "val", "test")
WILDCARDS = set("*?[")  # characters of patterns
PLACEHOLDER = re.compile(r"\{\w*\}")
REST = "rest"  # among the ignored ids: all ids that the file does not name


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
        root: the folder that all other paths are relative to.
        unread: the classes of the labels, if they are not the classes in `taxonomy`. Such labels
            are not read.
        poses: the file of the poses of all scans in a folder, relative to this folder; empty if
            the poses are unknown.
        split: names of folders and scans, and patterns, by split; empty if there is no split.
        sensor: the name or the attributes of the sensor; None if it is to be measured.
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
    for train_id, (title, values) in enumerate(entries.items(), start=1):
        _check_keys(f"classes: {title}", values, ("ids", "color"), required=("ids",))
        ids = _ids(f"classes: {title}", values["ids"], least=0)
        if not ids:
            raise InputError(f"classes: {title}: expected ids, found none; name one or more")
        train_to_raw.append(ids[0])
        for raw_id in ids:
            _add(raw_to_train, raw_id, train_id)

    entries_ignored = tree.get("ignored", [])
    if not isinstance(entries_ignored, list):
        entries_ignored = [entries_ignored]
    ignored = _ids("ignored", [entry for entry in entries_ignored if entry != REST], least=-1)
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


def _ids(title: str, values: Any, least: int) -> list[int]:
    """Return raw ids; an id of -1, which many tools write for no label, becomes the largest id."""
    ids = []
    for raw_id in values if isinstance(values, list) else [values]:
        if type(raw_id) is not int or not least <= raw_id <= INSTANCE_MASK:
            raise InputError(
                f"{title}: expected whole numbers from {least} to {INSTANCE_MASK} as ids, "
                f"found {shown(raw_id)}; correct them"
            )
        ids.append(raw_id & INSTANCE_MASK)

    return ids


def _parse_labels(entry: Any) -> LabelPlace | None:
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
        if not file.startswith(".") or "/" in file:  # no ending, such as .label
            raise InputError(
                f"labels: expected the scan's name in the file, found {file!r}; "
                "write for example ../labels/{name}.label"
            )
        file = "{name}" + file  # only an ending
    return LabelPlace(file, None if column is None else str(column))


def _parse_split(entry: Any) -> dict[str, tuple[str, ...]]:
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

    `title` is the key of the mapping; it is empty for the whole file.
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
    value = tree.get(key, usual)
    if not isinstance(value, str):
        raise InputError(f"{key}: expected a text, found {shown(value)}; correct it")
    return value


def _texts(title: str, values: Any) -> tuple[str, ...]:
    """Return one or several texts; a number, such as the sequence 07, counts as a text."""
    entries = values if isinstance(values, list | tuple) else [values]
    for entry in entries:
        if not isinstance(entry, str | int):
            raise InputError(f"{title}: expected names, found {shown(entry)}; correct them")
    return tuple(map(str, entries))
