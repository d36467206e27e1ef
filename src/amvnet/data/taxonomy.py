"""The classes of both benchmarks and of users: names, colours, raw ids and splits."""

from __future__ import annotations

import colorsys
import dataclasses
import tomllib
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from importlib import resources
from itertools import chain
from operator import itemgetter
from typing import Any

import numpy as np
from numpy.typing import NDArray

from amvnet.config.bounds import check_text
from amvnet.errors import InputError, listed, one_line_errors, shown
from lidarstreets import ANY, LIDAR_MODELS

# The lower 16 bits of a raw SemanticKITTI label hold the class, the upper 16 the instance.
INSTANCE_MASK = 0xFFFF
MAX_CLASSES = 255  # largest number of classes: train ids are uint8
# A user's class without a colour gets a hue that is far from all earlier hues. SATURATION and VALUE
# are in [0, 1]; GOLDEN_ANGLE is the step from one hue to the next, as a share of the hue circle.
SATURATION = 0.65
VALUE = 0.95
GOLDEN_ANGLE = 0.381966
SHOWN = 5  # largest number of unknown ids or names that an error message lists
MAX_KNOWN = 40  # the same for known ids
UNKNOWN = -1  # the mark of raw ids without a train id in lookup tables

Color = tuple[int, int, int]  # RGB in 0..255
UNLABELLED_COLOR: Color = (128, 136, 148)  # officially black
WRONG_COLOR: Color = (255, 64, 54)
UNCERTAIN_COLOR: Color = (255, 150, 180)  # no class of either benchmark has a similar colour

# Colours that replace official colours, where these look like the colours of other classes in a
# picture, or cannot be seen on a dark background.
DRAWN_COLORS: dict[str, dict[str, Color]] = {
    "semantickitti": {
        "sidewalk": (150, 90, 150),
        "other-ground": (75, 150, 90),
        "traffic-sign": (135, 150, 0),
    },
    "nuscenes": {
        "sidewalk": (150, 90, 150),
        "motorcycle": (255, 30, 225),
        "trailer": (0, 135, 255),
        "truck": (225, 150, 255),
    },
}


@dataclass(frozen=True)
class Taxonomy:
    """The classes of one benchmark or user, and the ids that files give them.

    Attributes:
        name: "semantickitti", "nuscenes", or a name that the user chose.
        classes: K names in the official order; `classes[0]` has train id 1.
        colors: K + 1 RGB triples in 0..255, indexed by train id (0 = ignored).
        raw_to_train: train ids by raw id (int). For nuScenes, which numbers its categories in a
            table, train ids by category name (str).
        train_to_raw: K + 1 raw ids of prediction files, indexed by train id.
        splits: official sequences of "train", "val" and "test"; empty if the dataset's reader
            defines them.
        counts_absent: whether figures follow SemanticKITTI's tool: a class that is in neither the
            ground truth nor the prediction counts as 0 in the mIoU, and a point without a predicted
            class not in the accuracy. If not, the class is left out, and the point is wrong.
        ignores_rest: whether labels may have other raw ids; these are ignored.

    Raises:
        InputError: if there are no or too many classes, a name occurs twice, or an id or a colour
            is out of range.
    """

    name: str
    classes: tuple[str, ...]
    colors: tuple[Color, ...]
    raw_to_train: Mapping[int | str, int]
    train_to_raw: tuple[int, ...]
    splits: Mapping[str, tuple[str, ...]]
    counts_absent: bool
    ignores_rest: bool = False

    def __post_init__(self) -> None:
        check_text("taxonomy", self.name)
        for name in self.classes:
            check_text(f"taxonomy {self.name}: classes", name)
        for sequence in chain.from_iterable(self.splits.values()):
            check_text(f"taxonomy {self.name}: splits", sequence)
        self._check(1 <= self.size <= MAX_CLASSES, f"1 to {MAX_CLASSES} classes", self.size)

        channels = list(chain.from_iterable(self.colors))
        raw_ids = [raw for raw in self.raw_to_train if not isinstance(raw, str)]
        train_ids = list(self.raw_to_train.values())
        for number in (*channels, *self.train_to_raw, *train_ids, *raw_ids):
            self._check(type(number) is int, "whole numbers as ids and colours", number)
        self._check_range("colours", channels, 255)
        self._check_range("train ids", train_ids, self.size)
        self._check_range("raw ids", [*raw_ids, *self.train_to_raw], INSTANCE_MASK)

        for kind, values in (("colours", self.colors), ("raw ids", self.train_to_raw)):
            expected = f"{self.size + 1} {kind} (ignored and {self.size} classes)"
            self._check(len(values) == self.size + 1, expected, len(values))
        for kind, entries in (("class", self.classes), ("id", self.train_to_raw)):
            twice = [entry for entry in entries if entries.count(entry) > 1]
            self._check(not twice, f"no {kind} twice", twice[:1])

    def _check(self, holds: bool, expected: str, found: Any) -> None:
        """Raise an InputError unless a condition holds; a stranger's file may hold anything."""
        if not holds:
            raise InputError(
                f"taxonomy {self.name}: expected {expected}, found {shown(found)}; "
                "correct the table"
            )

    def _check_range(self, kind: str, numbers: Sequence[int], last: int) -> None:
        wrong = [number for number in numbers if not 0 <= number <= last]
        self._check(not wrong, f"{kind} 0..{last}", wrong)

    @property
    def size(self) -> int:
        """K, the number of classes."""
        return len(self.classes)

    @property
    def names(self) -> tuple[str, ...]:
        """K + 1 names, indexed by train id; the first is "unlabelled"."""
        return ("unlabelled", *self.classes)

    @cached_property
    def train_ids_by_raw(self) -> NDArray[np.int16]:
        """(65536,) int16 train ids by raw id; UNKNOWN if the taxonomy has no such raw id."""
        others = 0 if self.ignores_rest else UNKNOWN
        table = np.full(INSTANCE_MASK + 1, others, dtype=np.int16)

        # If raw ids are names of categories, only prediction files have numeric raw ids.
        if any(isinstance(raw, str) for raw in self.raw_to_train):
            table[list(self.train_to_raw)] = np.arange(self.size + 1)

        for raw_id, train_id in self.raw_to_train.items():
            if isinstance(raw_id, int):
                table[raw_id] = train_id
        return table

    def to_train(
        self,
        raw: NDArray[np.integer],
        advice: str | None = None,
        table: NDArray[np.int16] | None = None,
    ) -> NDArray[np.uint8]:
        """Return the train ids (N,) uint8 of raw ids (N,); only their lower 16 bits count.

        Args:
            advice: what the user can do about an unknown raw id; default: advice about labels.
            table: the train ids by raw id, of labels; default: `train_ids_by_raw`.

        Raises:
            InputError: if a raw id is not in the table.
        """
        raw_ids = np.asarray(raw).astype(np.uint32) & np.uint32(INSTANCE_MASK)
        train_ids = (self.train_ids_by_raw if table is None else table)[raw_ids]

        unknown = np.unique(raw_ids[train_ids == UNKNOWN]).tolist()
        if unknown:
            found = listed(list(map(str, unknown)), SHOWN)
            if raw_ids.max() <= self.size:
                found += " (train ids, it seems)"
            usual = "write its raw ids, or describe your own in a YAML file (docs/own_data.md)"
            if self.name not in TAXONOMIES:
                usual = "add them to a class or to ignored, or write ignored: rest"
            ids = self.train_to_raw[1:] if table is None else np.flatnonzero(table > 0)
            known = listed(list(map(str, ids)), MAX_KNOWN)
            raise InputError(
                f"expected the raw ids of {self.name} ({known}), found {found}; {advice or usual}"
            )
        checked: NDArray[np.uint8] = train_ids.astype(np.uint8)
        return checked

    def to_raw(self, ids: NDArray[np.integer]) -> NDArray[np.uint32]:
        """Return the raw ids (N,) uint32 of train ids (N,); raise InputError if one is wrong."""
        ids = np.asarray(ids)
        if ids.size and (ids.min() < 0 or ids.max() > self.size):
            raise InputError(
                f"taxonomy {self.name}: expected train ids 0..{self.size}, "
                f"found {ids.min()}..{ids.max()}; give train ids of this taxonomy"
            )

        raw_ids: NDArray[np.uint32] = np.asarray(self.train_to_raw, dtype=np.uint32)[ids]
        return raw_ids

    def to_dict(self) -> dict[str, Any]:
        """Return the fields for JSON.

        `raw_to_train` becomes pairs, because keys in JSON are texts. `ignores_rest` is left out: it
        only says how labels are read.
        """
        fields = {**dataclasses.asdict(self), "raw_to_train": list(self.raw_to_train.items())}
        del fields["ignores_rest"]
        return fields

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> Taxonomy:
        """Return the taxonomy that `to_dict` wrote; raise InputError if its fields are wrong."""

        def message(error: BaseException) -> str:
            return (
                "taxonomy: expected its fields as this package writes them, found "
                f"{shown(error)}; use a weights file of this package"
            )

        # AttributeError if a table is missing, OverflowError if an id is .inf.
        faults = (KeyError, TypeError, ValueError, AttributeError, OverflowError)
        with one_line_errors(message, only=faults):
            return cls(
                name=values["name"],
                classes=tuple(values["classes"]),
                colors=tuple(map(_rgb, values["colors"])),
                raw_to_train={raw: int(train) for raw, train in values["raw_to_train"]},
                train_to_raw=tuple(values["train_to_raw"]),
                splits={split: tuple(sequences) for split, sequences in values["splits"].items()},
                counts_absent=bool(values["counts_absent"]),
            )


def check_classes(source: str, of_data: Taxonomy, of_weights: Taxonomy) -> None:
    """Raise InputError, naming the source of the data, if weights have other classes."""
    if of_data.classes != of_weights.classes:
        raise InputError(
            f"{source}: expected weights with the classes of the data, found "
            f"{describe_difference(of_data.classes, of_weights.classes, of_weights.name)}; "
            "use weights with these classes; amvnet evaluate also maps both by --classes"
        )


def describe_difference(classes: Sequence[str], others: Sequence[str], of_others: str) -> str:
    """Describe how names of classes differ from the names of others, such as "the weights"."""
    missing = [name for name in classes if name not in others]
    added = [name for name in others if name not in classes]
    texts = []
    for names, word in ((missing, "without"), (added, "with")):
        if names:
            texts.append(f"{word} {listed(list(map(repr, names)), SHOWN)}")
    return f"{of_others} {' and '.join(texts) or 'with the classes in another order'}"


def class_entries(classes: Any, key: str, example: str) -> dict[str, dict[str, Any]]:
    """Return the entries of a user's classes by name, each as a mapping with a colour.

    Args:
        classes: the entries in a YAML file. An entry is a mapping, or only the value of `key`.
        key: the key that every class must have.

    Raises:
        InputError: if there are no classes, a name is not a text, or a colour is not a list of
            three whole numbers.
    """
    if not isinstance(classes, Mapping) or not classes:
        raise InputError(
            f"classes: expected entries such as {example}, found {shown(classes)}; write them"
        )

    entries = {}
    for train_id, (title, entry) in enumerate(classes.items(), start=1):
        if type(title) is int and isinstance(entry, str):  # as in the files of other projects
            raise InputError(
                f"classes: expected entries such as {example}, found {title}: {shown(entry)}; "
                "write the name first"
            )
        if not isinstance(title, str):  # YAML reads no, off, on and yes without quotes as booleans
            raise InputError(
                f"classes: expected texts as names, found the value {shown(title)}, as YAML reads "
                "numbers, no, off, on, yes and null; write the name in quotes"
            )
        if not title.strip():
            raise InputError(
                f"classes: expected names with letters, found {shown(title)}; name the class"
            )
        values = dict(entry) if isinstance(entry, Mapping) else {key: entry}
        color = values.get("color")
        if color is None:
            hue = train_id * GOLDEN_ANGLE % 1
            rgb = np.array(colorsys.hsv_to_rgb(hue, SATURATION, VALUE))
            color = (255 * rgb).round().astype(int).tolist()

        is_triple = isinstance(color, list) and len(color) == 3
        if not is_triple or any(type(value) is not int for value in color):
            raise InputError(
                f"classes: {title}: expected a color such as [255, 0, 0], found {shown(color)}; "
                "correct it"
            )
        entries[title] = {**values, "color": color}
    return entries


def user_taxonomy(
    name: str,
    entries: Mapping[str, Mapping[str, Any]],
    raw_to_train: Mapping[int | str, int],
    train_to_raw: Sequence[int],
) -> Taxonomy:
    """Return the taxonomy of a user's classes, given what `class_entries` and `Taxonomy` hold."""
    return Taxonomy(
        name=f"own-{name}" if name in TAXONOMIES else name,
        classes=tuple(entries),
        colors=((0, 0, 0), *(_rgb(values["color"]) for values in entries.values())),
        raw_to_train=raw_to_train,
        train_to_raw=tuple(train_to_raw),
        splits={},
        counts_absent=False,
    )


def class_colors(taxonomy: Taxonomy) -> tuple[Color, ...]:
    """Return the K + 1 colours of the classes, RGB in 0..255, by train id."""
    drawn = DRAWN_COLORS.get(taxonomy.name, {})
    colors = [UNLABELLED_COLOR]
    for name, color in zip(taxonomy.classes, taxonomy.colors[1:], strict=True):
        colors.append(drawn.get(name, color))
    return tuple(colors)


def _rgb(values: Iterable[Any]) -> Color:
    red, green, blue = values
    return int(red), int(green), int(blue)


def _built_in() -> dict[str, Taxonomy]:
    text = (resources.files("amvnet.data") / "benchmarks.toml").read_text(encoding="utf-8")

    taxonomies = {}
    for name, table in tomllib.loads(text).items():
        entries = table["classes"].values()
        fields = {
            "name": name,
            "classes": list(table["classes"])[1:],
            "colors": map(itemgetter("color"), entries),
            "raw_to_train": [
                (raw, ids) for ids, entry in enumerate(entries) for raw in entry["raw"]
            ],
            "train_to_raw": map(itemgetter("id"), entries),
        }
        taxonomies[name] = Taxonomy.from_dict({**table, **fields})
    return taxonomies


TAXONOMIES: Mapping[str, Taxonomy] = _built_in()
SEMANTICKITTI = TAXONOMIES["semantickitti"]
NUSCENES = TAXONOMIES["nuscenes"]
# The classes of the streets that are simulated for each sensor.
CLASSES_BY_SENSOR = dict.fromkeys((*LIDAR_MODELS, ANY), SEMANTICKITTI) | {"hdl32e": NUSCENES}
