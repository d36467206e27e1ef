"""nuScenes and nuScenes-lidarseg in their official layout, read straight from the JSON tables."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from amvnet.data import scan_files as files
from amvnet.data.datasets.base import ScanRecord
from amvnet.data.datasets.predictions import read_prediction
from amvnet.data.taxonomy import NUSCENES, UNKNOWN, Taxonomy
from amvnet.errors import InputError
from amvnet.scan import Scan

CHANNEL = "LIDAR_TOP"
MINI, TEST = "v1.0-mini", "v1.0-test"
Row = dict[str, Any]


def _scenes(numbers: str) -> frozenset[str]:
    """Scene names of "3 12-14": scene-0003, scene-0012, scene-0013, scene-0014."""
    names: set[str] = set()
    for part in numbers.split():
        first, _, last = part.partition("-")
        names.update(f"scene-{number:04d}" for number in range(int(first), int(last or first) + 1))
    return frozenset(names)


SPLITS = ("train", "val", "test", "all")
# Official splits. A scene that none of them names is for training.
MINI_TRAIN = _scenes("61 553 655 757 796 1077 1094 1100")
MINI_VAL = _scenes("103 916")
VAL = _scenes(
    "3 12-18 35-36 38-39 92-110 221 268-278 329-332 344-346 519-524 552-565 625-627 629-630 632-638 770-771 "
    "775 777-778 780-784 794-800 802 904-917 919-931 962-963 966-969 971-972 1059-1073"
)


class NuScenes:
    """The key-frame scans of LIDAR_TOP of one version; the interface is `records.Dataset`.

    Attributes:
        root: the folder that holds `samples/` and `v1.0-*/`.
        version: "v1.0-mini", "v1.0-trainval" or "v1.0-test".
        taxonomy: the classes.

    Raises:
        InputError: where `root` has no such layout, the version is not clear or a table is missing.
    """

    def __init__(
        self, root: Path | str, version: str | None = None, taxonomy: Taxonomy = NUSCENES
    ) -> None:
        self.root = Path(root)
        self.version = self._find_version(version)
        self.taxonomy = taxonomy
        self._labels = {
            row["sample_data_token"]: row["filename"]
            for row in self._table("lidarseg", required=False)
        }
        self._to_train = self._category_lookup() if self._labels else None
        try:
            self._by_scene = self._index()
        except (KeyError, TypeError) as error:
            raise InputError(
                f"{self.root / self.version}: expected the tables of nuScenes, found no entry {error}; unpack them"
            ) from None

    @staticmethod
    def matches(root: Path) -> bool:
        """Whether a folder has this layout."""
        return any(root.glob("v1.0-*/sample_data.json"))

    def sequences(self, split: str) -> tuple[str, ...]:
        """The scenes of "train", "val", "test" or "all" that are on disk; raises as `records.Dataset`."""
        scenes = self.scenes(split)
        folder = self.root / "samples" / CHANNEL
        present = {path.name for path in folder.iterdir()} if folder.is_dir() else set()
        if found := tuple(
            s for s in scenes if any(r.points_path.name in present for r in self._by_scene[s])
        ):
            return found
        raise InputError(
            f"{folder}: expected scans of {split} scenes ({len(scenes)} in the tables of {self.version}), "
            f"found none; name the scenes to use, such as {', '.join(sorted(self._by_scene)[:3])}"
        )

    def scenes(self, split: str) -> tuple[str, ...]:
        """The scenes of a split that the tables list, on disk or not.

        Raises:
            InputError: where the split is unknown.
        """
        if split not in SPLITS:
            raise InputError(
                f"{self.root}: expected a split of {', '.join(SPLITS)}, found {split!r}; give one of them"
            )
        return tuple(
            s
            for s in sorted(self._by_scene)
            if split in ("all", self._split(s).removeprefix("mini_"))
        )

    def records(self, sequences: Sequence[str]) -> list[ScanRecord]:
        """The scans of these scenes in order; raises as `records.Dataset`."""
        if missing := sorted(set(sequences) - set(self._by_scene)):
            there = sorted(self._by_scene)
            more = f" and {len(there) - 20} more" if len(there) > 20 else ""
            raise InputError(
                f"{self.root}: expected the scene {missing[0]} in {self.version}, found it in no table; "
                f"there is {', '.join(there[:20])}{more}"
            )
        return [record for scene in sorted(set(sequences)) for record in self._by_scene[scene]]

    def read(self, record: ScanRecord, labels: bool = True) -> Scan:
        """Read one scan with its ring; raises as `records.Dataset`."""
        points, ring = files.read_nuscenes(record.points_path)
        ids = None
        if labels and record.labels_path is not None:
            ids = files.read_labels(record.labels_path, np.uint8, len(points), self._fine_to_train)
        return Scan(points, labels=ids, ring=ring, name=record.name)

    def read_prediction(self, record: ScanRecord, folder: Path) -> np.ndarray:
        """Read (N,) uint8 train ids; raises as `records.Dataset`."""
        return read_prediction(
            Path(folder) / record.prediction, np.uint8, self._count(record), self.taxonomy
        )

    def write_prediction(self, record: ScanRecord, folder: Path, ids: np.ndarray) -> Path:
        """Write (N,) train ids (uint8); raises as `records.Dataset`."""
        ids = files.check_count(ids, record.points_path, self._count(record))
        return files.write_labels(
            Path(folder) / record.prediction, self.taxonomy.to_raw(ids), np.uint8
        )

    def _find_version(self, version: str | None) -> str:
        present = sorted(path.name for path in self.root.glob("v1.0-*") if path.is_dir())
        if version in present or (version is None and len(present) == 1):
            return version or present[0]
        wanted = version or ("one folder v1.0-*" if present else "a folder v1.0-*")
        advice = (
            f"give one of them as {self.root}@{present[0]}"
            if present
            else "give the folder that holds it"
        )
        raise InputError(
            f"{self.root}: expected {wanted}, found {', '.join(present) or 'none'}; {advice}"
        )

    def _table(self, name: str, required: bool = True) -> list[Row]:
        path = self.root / self.version / f"{name}.json"
        if not path.is_file():
            if not required:
                return []
            raise InputError(
                f"{path}: expected a table of nuScenes, found no file; unpack the metadata of {self.version}"
            )
        try:
            rows: list[Row] = json.loads(path.read_text(encoding="utf-8"))
        except ValueError as error:
            raise InputError(
                f"{path}: expected a table in JSON, found {error}; unpack the file again"
            ) from None
        return rows

    def _category_lookup(self) -> np.ndarray:
        """(256,) int16: index in category.json -> train id, by the name of the category."""
        path = self.root / self.version / "category.json"
        table = np.full(256, UNKNOWN, dtype=np.int16)
        for row in self._table("category"):
            if "index" not in row:
                raise InputError(
                    f"{path}: expected an index in every category, found none; unpack nuScenes-lidarseg over it"
                )
            if row["name"] not in self.taxonomy.raw_to_train:
                raise InputError(
                    f"{path}: expected the categories of nuScenes, found {row['name']!r}; correct the table"
                )
            table[row["index"]] = self.taxonomy.raw_to_train[row["name"]]
        return table

    def _fine_to_train(self, raw: np.ndarray) -> np.ndarray:
        assert self._to_train is not None  # there are labels only where the table was read
        train = self._to_train[raw]
        if (train == UNKNOWN).any():
            unknown = np.unique(raw[train == UNKNOWN])[:5].tolist()
            raise InputError(
                f"expected indices of category.json, found {unknown}; use the tables that came with the labels"
            )
        return train.astype(np.uint8)

    def _index(self) -> dict[str, list[ScanRecord]]:
        """The scans of every scene, in order of time."""
        scenes = {row["token"]: row["name"] for row in self._table("scene")}
        scene_of = {row["token"]: scenes[row["scene_token"]] for row in self._table("sample")}
        lidars = self._lidar_sensors()
        rows = [row for row in self._table("sample_data") if self._is_scan(row, lidars)]
        index: dict[str, list[ScanRecord]] = {}
        for row in sorted(rows, key=lambda row: (row["timestamp"], row["token"])):
            scene = scene_of[row["sample_token"]]
            index.setdefault(scene, []).append(self._record(row, scene))
        return index

    def _lidar_sensors(self) -> dict[str, bool]:
        """Token of a calibrated sensor -> whether it is the LiDAR; empty where the tables lack it."""
        channels = {row["token"]: row["channel"] for row in self._table("sensor", required=False)}
        rows = self._table("calibrated_sensor", required=False)
        return {row["token"]: channels.get(row["sensor_token"], CHANNEL) == CHANNEL for row in rows}

    @staticmethod
    def _is_scan(row: Row, lidars: dict[str, bool]) -> bool:
        under = str(row["filename"]).startswith(f"samples/{CHANNEL}/")
        return (
            bool(row["is_key_frame"]) and under and lidars.get(row["calibrated_sensor_token"], True)
        )

    def _record(self, row: Row, scene: str) -> ScanRecord:
        token = row["token"]
        return ScanRecord(
            name=token,
            sequence=scene,
            points_path=self.root / row["filename"],
            labels_path=self.root / self._labels[token] if token in self._labels else None,
            prediction=f"lidarseg/{self._split(scene)}/{token}_lidarseg.bin",
        )

    def _split(self, scene: str) -> str:
        """The name of the official split that a scene of this version belongs to."""
        if self.version == TEST:
            return "test"
        if self.version == MINI and scene in MINI_VAL | MINI_TRAIN:
            return "mini_val" if scene in MINI_VAL else "mini_train"
        return "val" if scene in VAL else "train"

    def _count(self, record: ScanRecord) -> int:
        return files.count_rows(record.points_path, np.float32, files.NUSCENES_COLUMNS)
