"""nuScenes and nuScenes-lidarseg in their official layout, read from the JSON tables."""

from __future__ import annotations

import copy
import json
import os
from collections.abc import Sequence
from contextlib import AbstractContextManager
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from amvnet.data.datasets.base import Dataset, not_trained_on
from amvnet.data.formats.cloud import Cloud, check_usable, ring_indices
from amvnet.data.formats.raw import FULL_INTENSITY, NUSCENES_COLUMNS, count_rows, read_table
from amvnet.data.labels.ids import read_ids
from amvnet.data.poses import Poses
from amvnet.data.recordings import Normalise, Recording, ScanFile, normalised_scan
from amvnet.data.taxonomy import NUSCENES, UNKNOWN, Taxonomy
from amvnet.errors import InputError, one_line_errors, reason_of, shown
from amvnet.files import checked_token
from amvnet.scan import Scan

CHANNEL = "LIDAR_TOP"
FOLDERS = ("samples", "sweeps", "lidarseg", "maps")  # beside the folders of the tables, v1.0-*
MAX_LISTED = 20  # largest number of scenes that a message lists
MINI = "v1.0-mini"
TEST = "v1.0-test"

Row = dict[str, Any]  # a row of a table: values by column name


def _scene_names(numbers: str) -> frozenset[str]:
    """Return the scene names of "3 12-14": scene-0003, scene-0012, scene-0013, scene-0014."""
    names: set[str] = set()
    for part in numbers.split():
        first, _, last = part.partition("-")
        for number in range(int(first), int(last or first) + 1):
            names.add(f"scene-{number:04d}")

    return frozenset(names)


SPLITS = ("train", "val", "test", "all", "mini_train", "mini_val")
# The official splits. A scene of v1.0-trainval that is not in VAL belongs to "train".
MINI_TRAIN = _scene_names("61 553 655 757 796 1077 1094 1100")
MINI_VAL = _scene_names("103 916")
VAL = _scene_names(
    "3 12-18 35-36 38-39 92-110 221 268-278 329-332 344-346 519-524 552-565 625-627 629-630 "
    "632-638 770-771 775 777-778 780-784 794-800 802 904-917 919-931 962-963 966-969 971-972 "
    "1059-1073"
)


class NuScenes(Dataset):
    """The LIDAR_TOP key frames of one version of nuScenes.

    `Dataset` documents the arguments and errors of the methods.

    Args:
        root: the folder that holds `samples/` and `v1.0-*/`.
        version: "v1.0-mini", "v1.0-trainval" or "v1.0-test".

    Raises:
        InputError: if `root` does not have this layout, or has several versions and `version` is
            not given, or a table is missing or broken.
    """

    benchmark_sensor = "hdl32e"
    ids_advice = "use the tables that came with the labels"

    def __init__(self, root: Path | str, version: str | None = None) -> None:
        super().__init__(root, NUSCENES)
        self.version = self._find_version(version)

        with self._using_tables():
            label_rows = self._table("lidarseg", required=False)
            self._label_files = {row["sample_data_token"]: row["filename"] for row in label_rows}
            self._category_train_ids = self._category_lookup() if label_rows else None
            self._recordings = self._read_recordings()

    @staticmethod
    def matches(root: Path) -> bool:
        """Return whether a folder has this layout."""
        return any(root.glob("v1.0-*/sample_data.json"))

    @staticmethod
    def holds(root: Path, folder: Path) -> bool:
        """Return whether a folder below `root` is part of a dataset in `root`."""
        first = folder.relative_to(root).parts[0]
        return NuScenes.matches(root) and (first in FOLDERS or first.startswith("v1.0-"))

    def parts(self) -> dict[str, tuple[str, ...]]:
        """Return the scenes of each split of `SPLITS` that are on disk."""
        folder = self.root / "samples" / CHANNEL
        file_names = set(os.listdir(folder)) if folder.is_dir() else set()
        on_disk = set()
        for scene, recording in self._recordings.items():
            if any(record.path.name in file_names for record in recording.scans):
                on_disk.add(scene)

        splits = {}
        for split in SPLITS:
            splits[split] = tuple(scene for scene in self.scenes(split) if scene in on_disk)
        return splits

    def lacks(self, split: str) -> str:
        """Return the message that says which files to unpack, or which scenes to name instead."""
        on_disk = self.parts()["all"]
        of_training = ("train", "mini_train")
        unseen = [scene for scene in on_disk if self._split(scene) not in of_training]
        instead = f"or name {not_trained_on(unseen)}" if on_disk else "which the tables list"
        return (
            f"{self.root / 'samples' / CHANNEL}: expected scans of {split} scenes "
            f"({len(self.scenes(split))} in the tables of {self.version}), found none; "
            f"unpack their files, {instead}"
        )

    def scenes(self, split: str) -> tuple[str, ...]:
        """Return the scenes of a split that the tables list, on disk or not; there may be none.

        Args:
            split: a name in `SPLITS`. In the mini version, "train" and "val" mean "mini_train" and
                "mini_val".
        """
        scenes = []
        for scene in sorted(self._recordings):
            official = self._split(scene)
            if split in ("all", official, official.removeprefix("mini_")):
                scenes.append(scene)
        return tuple(scenes)

    def records(self, sequences: Sequence[str]) -> list[ScanFile]:
        """Return the scans of these scenes, in order."""
        missing = sorted(set(sequences) - set(self._recordings))
        if missing:
            scenes = sorted(self._recordings)
            raise InputError(
                f"{self.root}: expected the scene {missing[0]} in {self.version}, found no such "
                f"scene in its tables; name one of {', '.join(scenes[:MAX_LISTED])}"
            )

        records: list[ScanFile] = []
        for scene in sorted(set(sequences)):
            records.extend(self._recordings[scene].scans)
        return records

    def read(self, record: ScanFile, labels: bool = True) -> Scan:
        """Read one scan, with intensities in [0, 1] and the ring of every point."""
        scan = _read(record.path, record.name)
        if labels:
            scan = replace(scan, labels=self.labels(record, len(scan)))
        return scan if self.normalise is None else normalised_scan(scan, record.recording)

    def read_unchanged(self, record: ScanFile) -> Scan:
        """Read the points of one scan as they are in its file."""
        return _read(record.path, record.name)

    def normalised_by(self, normalise: Normalise) -> NuScenes:
        """Return the same scans, normalised."""
        changed = copy.copy(self)
        changed.normalise = normalise
        changed._recordings = {}
        for scene, recording in self._recordings.items():
            whole = normalise(recording)
            whole.scans = [
                replace(scan, recording=whole, dataset=changed) for scan in recording.scans
            ]
            changed._recordings[scene] = whole
        return changed

    def raw_labels(self, record: ScanFile, count: int) -> np.ndarray:
        """Read the (N,) indices in category.json of the points of one scan."""
        assert record.labels_path is not None
        return read_ids(record.labels_path, np.uint8, count)

    def train_ids_by_raw(self) -> np.ndarray:
        """Return the (256,) train ids by index in category.json."""
        assert self._category_train_ids is not None  # no record has labels without this table
        return self._category_train_ids

    def labelled(self, records: Sequence[ScanFile]) -> list[ScanFile]:
        """Return the scans whose labels the tables list; their files may be missing."""
        if not self._label_files:
            raise InputError(
                f"{self.root / self.version / 'lidarseg.json'}: expected the table of the labels, "
                "found none; unpack nuScenes-lidarseg into the same folder"
            )
        labelled = [record for record in records if record.labels_path is not None]
        return labelled or super().labelled(records)

    def poses(self, records: Sequence[ScanFile]) -> Poses | None:
        """Return the poses (N, 4, 4) of the LiDAR: the car's poses, and the LiDAR's on the car."""
        with self._using_tables():
            ego = self._motions("ego_pose")
            sensor = self._motions("calibrated_sensor")
            rows = {row["token"]: row for row in filter(_is_scan, self._table("sample_data"))}
            poses = []
            for record in records:
                row = rows[record.name]
                poses.append(ego[row["ego_pose_token"]] @ sensor[row["calibrated_sensor_token"]])
            return np.array(poses)

    def _motions(self, table: str) -> dict[str, Poses]:
        """Return the motions (4, 4) of a table, by their tokens."""
        from scipy.spatial.transform import Rotation

        rows = self._table(table)
        motions = np.tile(np.eye(4), (len(rows), 1, 1))
        motions[:, :3, 3] = [row["translation"] for row in rows]
        quaternions = [row["rotation"] for row in rows]  # w x y z
        motions[:, :3, :3] = Rotation.from_quat(quaternions, scalar_first=True).as_matrix()
        return dict(zip([row["token"] for row in rows], motions, strict=True))

    def count_points(self, record: ScanFile) -> int:
        """Return the number of points of a scan, from the size of its file."""
        return count_rows(record.path, np.float32, NUSCENES_COLUMNS)

    def write_labels(
        self,
        record: ScanFile,
        folder: Path,
        scan: Scan,
        ids: np.ndarray,
        *,
        taxonomy: Taxonomy | None = None,
        **files: Any,
    ) -> Path:
        """Write train ids; in the classes of nuScenes, points without one get the most frequent.

        Its server refuses points without a class, as lost returns are.
        """
        is_lost = ids == 0
        is_for_server = taxonomy is None
        if is_for_server and is_lost.any() and not is_lost.all():
            classes, counts = np.unique(ids[~is_lost], return_counts=True)
            ids = np.where(is_lost, classes[counts.argmax()], ids)
        return super().write_labels(record, folder, scan, ids, taxonomy=taxonomy)

    def _find_version(self, version: str | None) -> str:
        """Return the given version, or the only one in the folder; raise InputError if in doubt."""
        folders = filter(Path.is_dir, self.root.glob("v1.0-*"))
        present = sorted(folder.name for folder in folders)
        if version is None and len(present) == 1:
            return present[0]
        if version is not None and version in present:
            return version

        expected = version or "one folder v1.0-*"
        advice = "give the folder that holds it"
        if present:
            advice = f"give one of them as {self.root}@{present[0]}"
        raise InputError(
            f"{self.root}: expected {expected}, found {', '.join(present) or 'none'}; {advice}"
        )

    def _using_tables(self) -> AbstractContextManager[None]:
        """Turn the errors of rows without an entry, or with a wrong one, into an InputError."""

        def message(error: BaseException) -> str:
            return (
                f"{self.root / self.version}: expected the tables of nuScenes, "
                f"found no entry {reason_of(error)[:100]}; unpack them"
            )

        return one_line_errors(message, only=(KeyError, TypeError, IndexError, ValueError))

    def _table(self, name: str, required: bool = True) -> list[Row]:
        """Read one table; return no rows if it is missing and not `required`."""
        path = self.root / self.version / f"{name}.json"
        if not path.is_file():
            if not required:
                return []
            raise InputError(
                f"{path}: expected a table of nuScenes, found no file; "
                f"unpack the metadata of {self.version}"
            )

        try:
            rows = json.loads(path.read_text(encoding="utf-8"))
            if not isinstance(rows, list) or not all(isinstance(row, dict) for row in rows):
                raise ValueError(shown(rows))
        except (ValueError, RecursionError) as error:
            raise InputError(
                f"{path}: expected a table in JSON, found {error}; unpack the file again"
            ) from None
        return rows

    def _category_lookup(self) -> np.ndarray:
        """Return (256,) int16 train ids by index in category.json, UNKNOWN for unused indices."""
        path = self.root / self.version / "category.json"
        table = np.full(256, UNKNOWN, dtype=np.int16)

        for row in self._table("category"):
            train_id = self.taxonomy.raw_to_train.get(row["name"])
            if "index" not in row or train_id is None:
                raise InputError(
                    f"{path}: expected the categories of nuScenes-lidarseg, each with an index, "
                    f"found {shown(row)}; replace it by category.json of nuScenes-lidarseg"
                )
            table[row["index"]] = train_id
        return table

    def _read_recordings(self) -> dict[str, Recording]:
        """Read the tables; return every scene by its name, with its scans in order of time."""
        scene_names = {row["token"]: row["name"] for row in self._table("scene")}
        scene_of_sample = {}
        for row in self._table("sample"):
            scene_of_sample[row["token"]] = checked_token(scene_names[row["scene_token"]])

        rows = list(filter(_is_scan, self._table("sample_data")))
        rows.sort(key=lambda row: (row["timestamp"], row["token"]))

        recordings: dict[str, Recording] = {}
        for row in rows:
            scene = scene_of_sample[row["sample_token"]]
            recording = recordings.setdefault(scene, Recording(scene))
            recording.scans.append(self._record(row, scene, recording))
        return recordings

    def _record(self, row: Row, scene: str, recording: Recording) -> ScanFile:
        token = checked_token(row["token"])
        labels_path = None
        if token in self._label_files:
            labels_path = self.root / self._label_files[token]

        path = self.root / row["filename"]
        return ScanFile(
            name=token,
            recording=recording,
            path=path,
            sequence=scene,
            labels_path=labels_path,
            prediction=f"lidarseg/{self._split(scene)}/{token}_lidarseg.bin",
            read=partial(_read_cloud, path, token),
            dataset=self,
        )

    def _split(self, scene: str) -> str:
        """Return the official split of a scene in this version: "train", "mini_val", ..."""
        if self.version == TEST:
            return "test"
        if self.version == MINI:
            if scene in MINI_VAL:
                return "mini_val"
            if scene in MINI_TRAIN:
                return "mini_train"

        return "val" if scene in VAL else "train"


def _read(path: Path, name: str) -> Scan:
    """Read a scan without labels, with intensities in [0, 1] and the ring of every point."""
    table = read_table(path, np.float32, NUSCENES_COLUMNS)
    points = check_usable(np.ascontiguousarray(table[:, :4]), path)
    points[:, 3] /= FULL_INTENSITY
    ring = ring_indices(table[:, 4])
    if ring is None:
        raise InputError(
            f"{path}: expected ring indices 0, 1, ... in column 5, found other values; "
            "correct the column"
        )
    return Scan(points, ring=ring, name=name)


def _read_cloud(path: Path, name: str) -> Cloud:
    return Cloud.of(_read(path, name))


def _is_scan(row: Row) -> bool:
    """Return whether a row of sample_data.json is a key frame of the LiDAR."""
    return bool(row["is_key_frame"]) and str(row["filename"]).startswith(f"samples/{CHANNEL}/")
