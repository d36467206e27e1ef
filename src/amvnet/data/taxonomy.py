"""The classes of both benchmarks: names, colours, raw ids and splits, in one place."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from amvnet.errors import InputError

INSTANCE_MASK = (
    0xFFFF  # the lower half of a raw SemanticKITTI label is the class, the upper one the instance
)
UNKNOWN = -1


@dataclass(frozen=True)
class Taxonomy:
    """The classes of one benchmark and how its files number them.

    Attributes:
        name: "semantickitti", "nuscenes" or a name of the user's.
        classes: K names in the official order; `classes[0]` is train id 1.
        colors: K + 1 RGB triples in 0..255; the index is the train id (0 = ignored).
        raw_to_train: raw id (int) -> train id, or category name (str) -> train id where a data
            set numbers its categories in a table of its own (nuScenes).
        train_to_raw: K + 1 raw ids, what a prediction file holds for each train id.
        splits: official sequences of "train", "val" and "test"; empty where the reader knows them.
        counts_absent: True where a class in neither truth nor prediction counts as 0 in the
            mean (SemanticKITTI), False where it is left out (nuScenes).
    """

    name: str
    classes: tuple[str, ...]
    colors: tuple[tuple[int, int, int], ...]
    raw_to_train: Mapping[int | str, int]
    train_to_raw: tuple[int, ...]
    splits: Mapping[str, tuple[str, ...]]
    counts_absent: bool

    def __post_init__(self) -> None:
        for kind, found in (("colours", len(self.colors)), ("raw ids", len(self.train_to_raw))):
            if found != self.size + 1:
                raise InputError(
                    f"taxonomy {self.name}: expected {self.size + 1} {kind} (ignored and {self.size} classes), "
                    f"found {found}; give one per train id"
                )
        if bad := {train for train in self.raw_to_train.values() if not 0 <= train <= self.size}:
            raise InputError(
                f"taxonomy {self.name}: expected train ids 0..{self.size}, found {sorted(bad)}; correct the table"
            )
        raws = [raw for raw in (*self.raw_to_train, *self.train_to_raw) if isinstance(raw, int)]
        if large := [raw for raw in raws if not 0 <= raw <= INSTANCE_MASK]:
            raise InputError(
                f"taxonomy {self.name}: expected raw ids 0..{INSTANCE_MASK}, found {large[:5]}; correct the table"
            )

    @property
    def size(self) -> int:
        """K, the number of classes."""
        return len(self.classes)

    @property
    def _by_name(self) -> bool:
        return any(isinstance(raw, str) for raw in self.raw_to_train)

    @cached_property
    def _forward(self) -> np.ndarray:
        """(65536,) int16: raw id -> train id, UNKNOWN where the table has none."""
        table = np.full(INSTANCE_MASK + 1, UNKNOWN, dtype=np.int16)
        if self._by_name:
            table[list(self.train_to_raw)] = np.arange(self.size + 1)
        for raw, train in self.raw_to_train.items():
            if isinstance(raw, int):
                table[raw] = train
        return table

    def to_train(self, raw: np.ndarray) -> np.ndarray:
        """Turn raw labels into train ids.

        Args:
            raw: (N,) integers as the files hold them; instance bits (the upper 16) are dropped.

        Returns:
            (N,) uint8 train ids in 0..K.

        Raises:
            InputError: where a raw id is not in the table.
        """
        ids = np.asarray(raw).astype(np.uint32) & np.uint32(INSTANCE_MASK)
        train = self._forward[ids]
        if (train == UNKNOWN).any():
            unknown = np.unique(ids[train == UNKNOWN])
            raise InputError(
                f"taxonomy {self.name}: expected only raw ids of its table, found {unknown[:5].tolist()}; "
                "check that the file holds labels, or give the label map (YAML) that it was written with"
            )
        return train.astype(np.uint8)

    def to_raw(self, ids: np.ndarray) -> np.ndarray:
        """Turn train ids into the raw ids that prediction files hold.

        Args:
            ids: (N,) train ids in 0..K.

        Returns:
            (N,) uint32 raw ids.

        Raises:
            InputError: where an id is outside 0..K.
        """
        ids = np.asarray(ids)
        if ids.size and (ids.min() < 0 or ids.max() > self.size):
            raise InputError(
                f"taxonomy {self.name}: expected train ids 0..{self.size}, found {ids.min()}..{ids.max()}; "
                "give the ids that its own networks put out"
            )
        return np.asarray(self.train_to_raw, dtype=np.uint32)[ids]

    def to_dict(self) -> dict[str, Any]:
        """What `from_dict` needs, in types that JSON has."""
        return {
            "name": self.name,
            "classes": list(self.classes),
            "colors": [list(color) for color in self.colors],
            "raw_to_train": [[raw, train] for raw, train in self.raw_to_train.items()],
            "train_to_raw": list(self.train_to_raw),
            "splits": {split: list(sequences) for split, sequences in self.splits.items()},
            "counts_absent": self.counts_absent,
        }

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> Taxonomy:
        """The taxonomy that `to_dict` wrote, equal in every field.

        Raises:
            InputError: where a field is missing or of another kind.
        """
        try:
            return cls(
                name=values["name"],
                classes=tuple(values["classes"]),
                colors=tuple((int(r), int(g), int(b)) for r, g, b in values["colors"]),
                raw_to_train={raw: int(train) for raw, train in values["raw_to_train"]},
                train_to_raw=tuple(values["train_to_raw"]),
                splits={split: tuple(sequences) for split, sequences in values["splits"].items()},
                counts_absent=bool(values["counts_absent"]),
            )
        except (KeyError, TypeError, ValueError, AttributeError) as error:
            raise InputError(
                f"taxonomy: expected its fields as this package writes them, found {error!r}; "
                "use a weights file of this package"
            ) from None


def taxonomy_from_yaml(path: Path | str) -> Taxonomy:
    """Read a label map in the format of `semantic-kitti.yaml`.

    Args:
        path: a YAML file with the keys labels, color_map (BGR, as the official file has it),
            learning_map, learning_map_inv, learning_ignore and split (train, valid, test).

    Raises:
        InputError: where the file is not there, is not YAML or lacks a key.
    """
    path = Path(path)
    if not path.is_file():
        raise InputError(f"{path}: expected a label map (YAML), found no file; check the path")
    try:
        config = yaml.safe_load(path.read_text(encoding="utf-8"))
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        reason = " ".join(str(error).split())
        raise InputError(
            f"{path}: expected a label map (YAML), found {reason}; correct the file"
        ) from None
    required = (
        "labels",
        "color_map",
        "learning_map",
        "learning_map_inv",
        "learning_ignore",
        "split",
    )
    missing = [
        key
        for key in required
        if not isinstance(config, dict) or not isinstance(config.get(key), dict)
    ]
    missing += (
        []
        if "split" in missing
        else [f"split.{k}" for k in ("train", "valid", "test") if k not in config["split"]]
    )
    if missing:
        raise InputError(
            f"{path}: expected the tables {', '.join(required)}, found no {', '.join(missing)}; add them"
        )
    try:
        return _from_config(path.stem, config)
    except InputError as error:
        raise InputError(f"{path}: {error}") from None
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(
            f"{path}: expected tables that fit each other, found no entry {error}; complete them"
        ) from None


def _from_config(name: str, config: Mapping[str, Any]) -> Taxonomy:
    """Put the tables of a YAML label map in the order of its train ids."""
    inverse, ignore = config["learning_map_inv"], config["learning_ignore"]
    kept = sorted(train for train in inverse if train != 0 and not ignore[train])
    order = {old: new for new, old in enumerate(kept, start=1)}
    raws = [inverse[0], *(inverse[train] for train in kept)]
    colors = [tuple(int(c) for c in reversed(config["color_map"][raw])) for raw in raws]
    splits = {"train": "train", "val": "valid", "test": "test"}
    return Taxonomy(
        name="semantickitti" if name == "semantic-kitti" else name,
        classes=tuple(str(config["labels"][raw]) for raw in raws[1:]),
        colors=tuple((r, g, b) for r, g, b in colors),
        raw_to_train={
            int(raw): order.get(train, 0) for raw, train in config["learning_map"].items()
        },
        train_to_raw=tuple(int(raw) for raw in raws),
        splits={
            ours: tuple(f"{int(s):02d}" for s in config["split"][theirs])
            for ours, theirs in splits.items()
        },
        counts_absent=True,
    )


# (train id, name, RGB colour, raw id of predictions, further raw ids that mean the same)
_SEMANTICKITTI = (
    (0, "unlabeled", (0, 0, 0), 0, (1, 52, 99)),
    (1, "car", (100, 150, 245), 10, (252,)),
    (2, "bicycle", (100, 230, 245), 11, ()),
    (3, "motorcycle", (30, 60, 150), 15, ()),
    (4, "truck", (80, 30, 180), 18, (258,)),
    (5, "other-vehicle", (0, 0, 255), 20, (13, 16, 256, 257, 259)),
    (6, "person", (255, 30, 30), 30, (254,)),
    (7, "bicyclist", (255, 40, 200), 31, (253,)),
    (8, "motorcyclist", (150, 30, 90), 32, (255,)),
    (9, "road", (255, 0, 255), 40, (60,)),
    (10, "parking", (255, 150, 255), 44, ()),
    (11, "sidewalk", (75, 0, 75), 48, ()),
    (12, "other-ground", (175, 0, 75), 49, ()),
    (13, "building", (255, 200, 0), 50, ()),
    (14, "fence", (255, 120, 50), 51, ()),
    (15, "vegetation", (0, 175, 0), 70, ()),
    (16, "trunk", (135, 60, 0), 71, ()),
    (17, "terrain", (150, 240, 80), 72, ()),
    (18, "pole", (255, 240, 150), 80, ()),
    (19, "traffic-sign", (255, 0, 0), 81, ()),
)

# (name, RGB colour, fine categories of category.json); the index is the train id
_IGNORED = (
    "noise animal human.pedestrian.personal_mobility human.pedestrian.stroller human.pedestrian.wheelchair "
    "movable_object.debris movable_object.pushable_pullable static.other static_object.bicycle_rack vehicle.ego "
    "vehicle.emergency.ambulance vehicle.emergency.police"
)
_PEDESTRIANS = "human.pedestrian.adult human.pedestrian.child human.pedestrian.construction_worker human.pedestrian.police_officer"
_NUSCENES = (
    ("ignore", (0, 0, 0), _IGNORED),
    ("barrier", (112, 128, 144), "movable_object.barrier"),
    ("bicycle", (220, 20, 60), "vehicle.bicycle"),
    ("bus", (255, 127, 80), "vehicle.bus.bendy vehicle.bus.rigid"),
    ("car", (255, 158, 0), "vehicle.car"),
    ("construction_vehicle", (233, 150, 70), "vehicle.construction"),
    ("motorcycle", (255, 61, 99), "vehicle.motorcycle"),
    ("pedestrian", (0, 0, 230), _PEDESTRIANS),
    ("traffic_cone", (47, 79, 79), "movable_object.trafficcone"),
    ("trailer", (255, 140, 0), "vehicle.trailer"),
    ("truck", (255, 99, 71), "vehicle.truck"),
    ("driveable_surface", (0, 207, 191), "flat.driveable_surface"),
    ("other_flat", (175, 0, 75), "flat.other"),
    ("sidewalk", (75, 0, 75), "flat.sidewalk"),
    ("terrain", (112, 180, 60), "flat.terrain"),
    ("manmade", (222, 184, 135), "static.manmade"),
    ("vegetation", (0, 175, 0), "static.vegetation"),
)

SEMANTICKITTI = Taxonomy(
    name="semantickitti",
    classes=tuple(row[1] for row in _SEMANTICKITTI[1:]),
    colors=tuple(row[2] for row in _SEMANTICKITTI),
    raw_to_train={raw: row[0] for row in _SEMANTICKITTI for raw in (row[3], *row[4])},
    train_to_raw=tuple(row[3] for row in _SEMANTICKITTI),
    splits={
        "train": ("00", "01", "02", "03", "04", "05", "06", "07", "09", "10"),
        "val": ("08",),
        "test": tuple(f"{sequence}" for sequence in range(11, 22)),
    },
    counts_absent=True,
)

NUSCENES = Taxonomy(
    name="nuscenes",
    classes=tuple(name for name, _, _ in _NUSCENES[1:]),
    colors=tuple(color for _, color, _ in _NUSCENES),
    raw_to_train={
        fine: train for train, (_, _, fines) in enumerate(_NUSCENES) for fine in fines.split()
    },
    train_to_raw=tuple(range(len(_NUSCENES))),
    splits={},
    counts_absent=False,
)

TAXONOMIES: Mapping[str, Taxonomy] = {
    taxonomy.name: taxonomy for taxonomy in (SEMANTICKITTI, NUSCENES)
}
