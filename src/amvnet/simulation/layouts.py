"""Writes simulated scans in the layouts of SemanticKITTI and nuScenes-lidarseg."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from amvnet.files import atomic_write
from amvnet.simulation.materials import MOVING, NUSCENES_CATEGORIES, SEMANTICKITTI_IDS

Row = dict[str, Any]
INSTANCE_SHIFT = np.uint32(16)
# From the LiDAR's axes (forward, left, up) to a camera's (right, down, forward), as calib.txt gives it.
_TO_CAMERA = np.array([[0.0, -1, 0, 0], [0, 0, -1, -0.08], [1, 0, 0, -0.27], [0, 0, 0, 1]])
# nuScenes' LiDAR looks to the right: x is right, y is forward.
_TO_NUSCENES = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
VERSION = "v1.0-trainval"
TABLES = ("attribute", "calibrated_sensor", "category", "ego_pose", "instance", "lidarseg", "log", "map", "sample",
          "sample_annotation", "sample_data", "scene", "sensor", "visibility")  # fmt: skip
START = 1_600_000_000_000_000  # microseconds of the first scan of every scene


@dataclass(frozen=True)
class SimulatedScan:
    """One scan in memory.

    Attributes:
        points: (N, 4) float32 x, y, z in metres and intensity in [0, 1], in the sensor's frame (x is forward).
        labels: (N,) uint32 ids of `Label`, or of `MOVING`, instance ids in the upper 16 bits; 0 for a lost return.
        ring: (N,) uint8 index of the laser, 0 = lowest.
        pose: (4, 4) from the sensor's frame to the sequence's.
        time: seconds since the sequence began.
    """

    points: np.ndarray
    labels: np.ndarray
    ring: np.ndarray
    pose: np.ndarray
    time: float


class Layout(Protocol):
    """How a sequence is written: its scans one by one, then what goes for all of it."""

    def scan(self, index: int, scan: SimulatedScan) -> None:
        """Write one scan."""

    def finish(self) -> Row:
        """Write what needs the whole sequence; returns what `complete` needs of it."""


@dataclass
class SemanticKittiLayout:
    """OUT/sequences/XX with velodyne, labels, poses.txt, calib.txt and times.txt."""

    out: Path
    number: int
    track: list[tuple[np.ndarray, float]] = field(default_factory=list)

    @property
    def folder(self) -> Path:
        return self.out / "sequences" / f"{self.number:02d}"

    def scan(self, index: int, scan: SimulatedScan) -> None:
        """Write one scan."""
        raw = semantickitti_ids(scan.labels)
        _write(self.folder / "velodyne" / f"{index:06d}.bin", scan.points.astype("<f4").tobytes())
        _write(self.folder / "labels" / f"{index:06d}.label", raw.astype("<u4").tobytes())
        self.track.append((scan.pose, scan.time))

    def finish(self) -> Row:
        """Write poses.txt in the camera's frame, calib.txt and times.txt, as KITTI's odometry has them."""
        back = np.linalg.inv(_TO_CAMERA)
        poses = [_row(_TO_CAMERA @ pose @ back) for pose, _ in self.track]
        camera = _row(np.array([[700.0, 0, 600, 0], [0, 700, 180, 0], [0, 0, 1, 0], [0, 0, 0, 1]]))
        calibration = [f"P{i}: {camera}" for i in range(4)] + [f"Tr: {_row(_TO_CAMERA)}"]
        times = [f"{time:e}" for _, time in self.track]
        for name, lines in (("poses.txt", poses), ("calib.txt", calibration), ("times.txt", times)):
            _write(self.folder / name, "".join(f"{line}\n" for line in lines).encode())
        return {}

    @staticmethod
    def complete(out: Path, sequences: list[Row]) -> None:
        """Nothing goes for all sequences together."""


@dataclass
class NuScenesLayout:
    """OUT/samples and OUT/lidarseg, and the rows of one scene for the tables in OUT/v1.0-trainval."""

    out: Path
    number: int
    rows: list[Row] = field(default_factory=list)

    @property
    def name(self) -> str:
        return f"simulated-{self.number:04d}"

    def scan(self, index: int, scan: SimulatedScan) -> None:
        """Write one scan and its labels, and keep its rows."""
        token = _token(self.name, "sample_data", index)
        time = START + self.number * 1_000_000_000 + round(scan.time * 1e6)
        file = f"samples/LIDAR_TOP/{self.name}__LIDAR_TOP__{time}.pcd.bin"
        xyz = scan.points[:, :3] @ _TO_NUSCENES.T
        columns = np.column_stack([xyz, np.round(scan.points[:, 3] * 255), scan.ring])
        labels = f"lidarseg/{VERSION}/{token}_lidarseg.bin"
        _write(self.out / file, columns.astype("<f4").tobytes())
        _write(self.out / labels, nuscenes_indices(scan.labels).tobytes())
        self.rows.append(
            {
                "token": token,
                "time": time,
                "file": file,
                "labels": labels,
                "pose": scan.pose.tolist(),
            }
        )

    def finish(self) -> Row:
        """The scene's rows."""
        return {"scene": self.name, "scans": self.rows}

    @staticmethod
    def complete(out: Path, sequences: list[Row]) -> None:
        """Write the tables of all scenes."""
        tables: dict[str, list[Row]] = {name: [] for name in TABLES}
        tables["category"] = [{"token": _token("category", i), "name": n, "description": "", "index": i}
                              for i, n in enumerate(_CATEGORIES)]  # fmt: skip
        sensor, mounted, log = (_token(name) for name in ("sensor", "calibrated_sensor", "log"))
        tables["sensor"] = [{"token": sensor, "channel": "LIDAR_TOP", "modality": "lidar"}]
        half = float(np.sqrt(0.5))
        tables["calibrated_sensor"] = [
            {"token": mounted, "sensor_token": sensor, "translation": [0.0, 0.0, 0.0],
             "rotation": [half, 0.0, 0.0, -half], "camera_intrinsic": []}
        ]  # fmt: skip
        tables["log"] = [{"token": log, "logfile": "simulated", "vehicle": "simulated", "date_captured": "2020-09-13",
                          "location": "simulated"}]  # fmt: skip
        tables["map"] = [{"token": _token("map"), "log_tokens": [log], "category": "semantic_prior",
                          "filename": "maps/simulated.png"}]  # fmt: skip
        _write_empty_map(out / "maps" / "simulated.png")
        for sequence in sequences:
            _add_scene(tables, sequence, mounted, log)
        for name, rows in tables.items():
            _write(out / VERSION / f"{name}.json", json.dumps(rows, indent=0).encode())


LAYOUTS: Mapping[str, type[SemanticKittiLayout] | type[NuScenesLayout]] = {
    "semantickitti": SemanticKittiLayout,
    "nuscenes": NuScenesLayout,
}

_CATEGORIES = ("noise", *sorted(set(NUSCENES_CATEGORIES.values())))


def semantickitti_ids(labels: np.ndarray) -> np.ndarray:
    """(N,) ids of `Label` with instances -> raw SemanticKITTI labels."""
    ids = labels & np.uint32(0xFFFF)
    table = np.arange(2**16, dtype=np.uint32)
    for label, raw in SEMANTICKITTI_IDS.items():
        table[label] = raw
    return table[ids] | (labels >> INSTANCE_SHIFT) << INSTANCE_SHIFT


def nuscenes_indices(labels: np.ndarray) -> np.ndarray:
    """(N,) ids of `Label` with instances -> (N,) uint8 indices of the tables' categories; lost returns are noise."""
    table = np.zeros(2**16, dtype=np.uint8)
    for label, category in NUSCENES_CATEGORIES.items():
        table[label] = _CATEGORIES.index(category)
    for label, moving in MOVING.items():
        table[moving] = table[label]
    return table[labels & np.uint32(0xFFFF)]


def _add_scene(tables: dict[str, list[Row]], sequence: Row, mounted: str, log: str) -> None:
    """The rows of one scene: it, its samples, their scans, poses and labels."""
    name, scans = sequence["scene"], sequence["scans"]
    scene, samples = _token(name), [_token(name, "sample", i) for i in range(len(scans))]
    tables["scene"].append({"token": scene, "log_token": log, "nbr_samples": len(scans), "name": name,
                            "first_sample_token": samples[0], "last_sample_token": samples[-1],
                            "description": "simulated street"})  # fmt: skip
    chain = _links(samples), _links([scan["token"] for scan in scans])
    for scan, sample, sample_links, scan_links in zip(scans, samples, *chain, strict=True):
        token, time, pose = scan["token"], scan["time"], np.array(scan["pose"])
        tables["sample"].append(
            {"token": sample, "timestamp": time, "scene_token": scene, **sample_links}
        )
        tables["sample_data"].append(
            {"token": token, "sample_token": sample, "ego_pose_token": token, "calibrated_sensor_token": mounted,
             "timestamp": time, "fileformat": "pcd", "is_key_frame": True, "height": 0, "width": 0,
             "filename": scan["file"], **scan_links}
        )  # fmt: skip
        tables["ego_pose"].append({"token": token, "timestamp": time, "rotation": _quaternion(pose[:3, :3]),
                                   "translation": pose[:3, 3].tolist()})  # fmt: skip
        tables["lidarseg"].append(
            {"token": token, "sample_data_token": token, "filename": scan["labels"]}
        )


def _links(tokens: list[str]) -> list[Row]:
    return [
        {"prev": a, "next": b} for a, b in zip(["", *tokens[:-1]], [*tokens[1:], ""], strict=True)
    ]


def _quaternion(turn: np.ndarray) -> list[float]:
    """w, x, y, z of a rotation matrix."""
    from scipy.spatial.transform import Rotation

    x, y, z, w = Rotation.from_matrix(turn).as_quat()
    return [float(w), float(x), float(y), float(z)]


def _token(*parts: object) -> str:
    return hashlib.md5("/".join(map(str, parts)).encode(), usedforsecurity=False).hexdigest()


def _write_empty_map(path: Path) -> None:
    """nuScenes' tools want a picture of the map; ours shows nothing."""
    from matplotlib.image import imsave

    with atomic_write(path) as part:
        imsave(part, np.zeros((8, 8, 3), dtype=np.uint8))


def _row(matrix: np.ndarray) -> str:
    return " ".join(f"{value:e}" for value in matrix[:3].ravel())


def _write(path: Path, content: bytes) -> None:
    with atomic_write(path) as part:
        part.write_bytes(content)
