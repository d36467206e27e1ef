"""Write simulated scans in the layout of SemanticKITTI, nuScenes-lidarseg or a robot."""

import errno
import hashlib
import json
import os
import threading
import uuid
from collections import defaultdict
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lidarstreets.errors import SimulationError
from lidarstreets.materials import MOVING, Label

Row = dict[str, Any]
Tables = defaultdict[str, list[Row]]
CLASS_MASK = np.uint32(0xFFFF)  # bits of a label that hold the class

# Transform for calib.txt from the LiDAR's axes (forward, left, up) to a camera's (right, down,
# forward).
_TO_CAMERA = np.array([[0.0, -1, 0, 0], [0, 0, -1, -0.08], [1, 0, 0, -0.27], [0, 0, 0, 1]])
# Projection matrix of a camera that does not exist: readers of calib.txt expect four matrices.
_CAMERA = np.array([[700.0, 0, 600, 0], [0, 700, 180, 0], [0, 0, 1, 0], [0, 0, 0, 1]])

# Rotation from the LiDAR's axes to the axes of nuScenes' LiDAR: x is right, y is forward.
_TO_NUSCENES = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
NUSCENES_VERSION = "v1.0-trainval"
FIRST_TIMESTAMP = 1_600_000_000_000_000  # time of the first scan of scene 0, microseconds
SCENE_INTERVAL = 1_000_000_000  # time between the first scans of two scenes, microseconds

# Ids of the robot's labels by class of a street; all other points get `_NO_CLASS`.
_NO_CLASS = -1
_ROBOT_IDS: dict[Label, int] = {
    **dict.fromkeys(
        [
            Label.ROAD,
            Label.PARKING,
            Label.SIDEWALK,
            Label.OTHER_GROUND,
            Label.TERRAIN,
            Label.LANE_MARKING,
        ],
        3,
    ),
    **dict.fromkeys([Label.VEGETATION, Label.TRUNK], 7),
    **dict.fromkeys([Label.BUILDING, Label.FENCE], 21),
    **dict.fromkeys([Label.POLE, Label.TRAFFIC_SIGN], 22),
    **dict.fromkeys(
        [Label.CAR, Label.TRUCK, Label.OTHER_VEHICLE, Label.BICYCLE, Label.MOTORCYCLE], 40
    ),
    **dict.fromkeys([Label.PERSON, Label.BICYCLIST, Label.MOTORCYCLIST], 9),
}
ROBOT_FILE = "robot.yaml"  # describes the scans and the labels of the robot
_ROBOT_YAML = """\
classes:
  ground: 3
  plant: {ids: 7, color: [0, 175, 0]}
  structure: [21, 22]
  vehicle: {ids: [40]}
  person: 9
ignored: [-1]
scans: "*/clouds/*.pcd"
labels: "../truth/{name}.npy"
"""

# Error numbers of the system that another output folder avoids.
FOLDER_ERRNOS = (
    *(errno.EACCES, errno.EPERM, errno.EROFS),
    *(errno.EEXIST, errno.EISDIR, errno.ENOTDIR),
)
WRITE_LOCK = threading.Lock()  # held while a file is written

_CATEGORIES = ("noise", *sorted({label.category for label in Label} - {"noise"}))


@dataclass(frozen=True)
class SimulatedScan:
    """One scan in memory.

    Attributes:
        points: (N, 4) float32 x, y, z in metres and intensity in [0, 1]. The sensor is the origin;
            x is forward, y left, z up.
        labels: (N,) uint32 ids of `Label` or `MOVING`, with the instance id in the upper 16 bits;
            0 for a lost return.
        ring: (N,) uint8 indices of the lasers; 0 is the lowest laser.
        pose: (4, 4) transform from the sensor's frame to the frame of the sequence.
        time: seconds since the beginning of the sequence.
    """

    points: np.ndarray
    labels: np.ndarray
    ring: np.ndarray
    pose: np.ndarray
    time: float

    def semantickitti_ids(self) -> NDArray[np.uint32]:
        """Return the (N,) uint32 raw labels of SemanticKITTI, with instances."""
        table = np.arange(2**16, dtype=np.uint32)
        for label in Label:
            table[label] = label.raw
        raw_ids: NDArray[np.uint32] = table[self.labels & CLASS_MASK] | self.labels & ~CLASS_MASK
        return raw_ids

    def nuscenes_points(self) -> NDArray[np.float32]:
        """Return the (N, 4) points with nuScenes' axes, and intensities as whole numbers to 255."""
        xyz = self.points[:, :3] @ _TO_NUSCENES.T
        return np.column_stack([xyz, np.round(self.points[:, 3] * 255)]).astype(np.float32)

    def nuscenes_categories(self) -> tuple[np.ndarray, tuple[str, ...]]:
        """Return the (N,) uint8 index of each point's category, and the names of all categories.

        The categories are the categories of nuScenes-lidarseg. Lost returns are noise.
        """
        table = np.zeros(2**16, dtype=np.uint8)
        for label in Label:
            table[[label, MOVING.get(label, label)]] = _CATEGORIES.index(label.category)
        return table[self.labels & CLASS_MASK], _CATEGORIES


@dataclass
class SemanticKittiLayout:
    """One sequence in OUT/sequences/XX: velodyne, labels, poses.txt, calib.txt and times.txt."""

    out: Path
    number: int
    poses: list[np.ndarray] = field(default_factory=list)
    times: list[float] = field(default_factory=list)

    @staticmethod
    def owned_path(out: Path, number: int) -> tuple[Path, bool]:
        """Return the folder of a sequence, and False: other sequences have other folders."""
        return out / "sequences" / f"{number:02d}", False

    @property
    def folder(self) -> Path:
        """The folder of the sequence."""
        return self.owned_path(self.out, self.number)[0]

    def write_scan(self, index: int, scan: SimulatedScan) -> None:
        """Write one scan and its labels."""
        labels = scan.semantickitti_ids()
        write_whole(
            self.folder / "velodyne" / f"{index:06d}.bin", scan.points.astype("<f4").tobytes()
        )
        write_whole(self.folder / "labels" / f"{index:06d}.label", labels.astype("<u4").tobytes())
        self.poses.append(scan.pose)
        self.times.append(scan.time)

    def finish(self) -> Row:
        """Write poses.txt (in the camera's frame), calib.txt and times.txt, like KITTI odometry."""
        from_camera = np.linalg.inv(_TO_CAMERA)
        poses = [_matrix_text(_TO_CAMERA @ pose @ from_camera) for pose in self.poses]
        cameras = [f"P{i}: {_matrix_text(_CAMERA)}" for i in range(4)]
        times = [f"{time:e}" for time in self.times]

        _write_lines(self.folder / "poses.txt", poses)
        _write_lines(self.folder / "calib.txt", [*cameras, f"Tr: {_matrix_text(_TO_CAMERA)}"])
        _write_lines(self.folder / "times.txt", times)
        return {}

    @staticmethod
    def complete(out: Path, sequences: list[Row]) -> None:
        """Do nothing: no file describes all sequences."""


@dataclass
class NuScenesLayout:
    """One scene: files in OUT/samples and OUT/lidarseg, and rows of OUT/v1.0-trainval."""

    out: Path
    number: int
    rows: list[Row] = field(default_factory=list)

    @staticmethod
    def owned_path(out: Path, number: int) -> tuple[Path, bool]:
        """Return the folder of the tables, and True: all sequences share it."""
        return out / NUSCENES_VERSION, True

    @property
    def name(self) -> str:
        """The name of the scene."""
        return f"simulated-{self.number:04d}"

    def write_scan(self, index: int, scan: SimulatedScan) -> None:
        """Write one scan and its labels, and keep what goes into the tables."""
        token = _token(self.name, "sample_data", index)
        time = FIRST_TIMESTAMP + self.number * SCENE_INTERVAL + round(scan.time * 1e6)
        points_path = f"samples/LIDAR_TOP/{self.name}__LIDAR_TOP__{time}.pcd.bin"
        labels_path = f"lidarseg/{NUSCENES_VERSION}/{token}_lidarseg.bin"

        columns = np.column_stack([scan.nuscenes_points(), scan.ring])
        write_whole(self.out / points_path, columns.astype("<f4").tobytes())
        categories, _ = scan.nuscenes_categories()
        write_whole(self.out / labels_path, categories.tobytes())
        self.rows.append(
            {
                "token": token,
                "time": time,
                "file": points_path,
                "labels": labels_path,
                "pose": scan.pose.tolist(),
            }
        )

    def finish(self) -> Row:
        """Return the name and the scans of the scene."""
        return {"scene": self.name, "scans": self.rows}

    @staticmethod
    def complete(out: Path, sequences: list[Row]) -> None:
        """Write the tables of all scenes in the folder, and an empty map."""
        tables: Tables = defaultdict(
            list, attribute=[], instance=[], sample_annotation=[], visibility=[]
        )
        _add_shared_rows(tables)
        for sequence in sequences:
            _add_scene(tables, sequence)

        _write_empty_map(out / "maps" / "simulated.png")
        for name, rows in tables.items():
            write_whole(
                out / NUSCENES_VERSION / f"{name}.json", json.dumps(rows, indent=0).encode()
            )


@dataclass
class RobotLayout:
    """One site of a robot: OUT/site_a/clouds/0000.pcd and OUT/site_a/truth/0000.npy.

    No benchmark has this layout. OUT/robot.yaml describes it: five classes with ids of their own.
    """

    out: Path
    number: int

    @staticmethod
    def owned_path(out: Path, number: int) -> tuple[Path, bool]:
        """Return the folder of a site and False, or the file about all sites and True.

        The file is returned if the folder does not exist yet.
        """
        folder = out / _site(number)
        return (folder, False) if os.path.lexists(folder) else (out / ROBOT_FILE, True)

    @property
    def folder(self) -> Path:
        """The folder of the sequence."""
        return self.out / _site(self.number)

    def write_scan(self, index: int, scan: SimulatedScan) -> None:
        """Write one scan as a binary PCD file, and its labels as a NumPy file."""
        count = len(scan.points)
        header = (
            "VERSION .7\nFIELDS x y z intensity\nSIZE 4 4 4 4\nTYPE F F F F\nCOUNT 1 1 1 1\n"
            f"WIDTH {count}\nHEIGHT 1\nPOINTS {count}\nDATA binary\n"
        )
        content = header.encode() + scan.points.astype("<f4").tobytes()
        write_whole(self.folder / "clouds" / f"{index:04d}.pcd", content)

        table = np.full(2**16, _NO_CLASS, dtype=np.int16)
        for label, robot_id in _ROBOT_IDS.items():
            table[[label.raw, MOVING.get(label, label.raw)]] = robot_id
        labels = BytesIO()
        np.save(labels, table[scan.semantickitti_ids() & CLASS_MASK])
        write_whole(self.folder / "truth" / f"{index:04d}.npy", labels.getvalue())

    def finish(self) -> Row:
        """Return the name of the site."""
        return {"site": _site(self.number)}

    @staticmethod
    def complete(out: Path, sequences: list[Row]) -> None:
        """Write robot.yaml; the last of several sites is the validation split."""
        *train, val = [sequence["site"] for sequence in sequences]
        split = f"split:\n  train: [{', '.join(train)}]\n  val: {val}\n" if train else ""
        write_whole(out / ROBOT_FILE, (_ROBOT_YAML + split).encode())


LAYOUTS: Mapping[str, type[SemanticKittiLayout] | type[NuScenesLayout] | type[RobotLayout]] = {
    "semantickitti": SemanticKittiLayout,
    "nuscenes": NuScenesLayout,
    "robot": RobotLayout,
}


def _site(number: int) -> str:
    """Return the name of a site: "site_a" for 0, "site_z" for 25, "site_26" for 26."""
    return f"site_{chr(ord('a') + number) if number < 26 else number}"


def _add(tables: Tables, table: str, token: str, **columns: Any) -> None:
    """Add a row to a table."""
    tables[table].append({"token": token, **columns})


def _add_shared_rows(tables: Tables) -> None:
    """Add the rows that all scenes share: categories, the LiDAR, the log and the map."""
    for index, name in enumerate(_CATEGORIES):
        token = _token("category", index)
        _add(tables, "category", token, name=name, description="", index=index)

    sensor = _token("sensor")
    half = float(np.sqrt(0.5))
    place = {"translation": [0.0, 0.0, 0.0], "rotation": [half, 0.0, 0.0, -half]}
    calibration = _token("calibrated_sensor")
    _add(tables, "sensor", sensor, channel="LIDAR_TOP", modality="lidar")
    _add(
        tables, "calibrated_sensor", calibration, sensor_token=sensor, **place, camera_intrinsic=[]
    )

    log = _token("log")
    name = "simulated"
    _add(tables, "log", log, logfile=name, vehicle=name, date_captured="2020-09-13", location=name)
    picture = {"category": "semantic_prior", "filename": "maps/simulated.png"}
    _add(tables, "map", _token("map"), log_tokens=[log], **picture)


def _add_scene(tables: Tables, sequence: Row) -> None:
    """Add the rows of one scene, its samples, and their scans, poses and labels."""
    name = sequence["scene"]
    scene = _token(name)

    # The tokens of the samples and of their scans stand between two empty tokens.
    samples = [""]
    for index in range(len(sequence["scans"])):
        samples.append(_token(name, "sample", index))
    samples.append("")
    tokens = ["", *(scan["token"] for scan in sequence["scans"]), ""]

    _add(
        tables,
        "scene",
        scene,
        log_token=_token("log"),
        nbr_samples=len(sequence["scans"]),
        name=name,
        first_sample_token=samples[1],
        last_sample_token=samples[-2],
        description="simulated street",
    )

    for index, scan in enumerate(sequence["scans"]):
        before, sample, after = samples[index : index + 3]
        previous, token, following = tokens[index : index + 3]
        time = scan["time"]
        pose = np.array(scan["pose"])

        _add(tables, "sample", sample, timestamp=time, scene_token=scene, prev=before, next=after)
        _add(
            tables,
            "sample_data",
            token,
            sample_token=sample,
            ego_pose_token=token,
            calibrated_sensor_token=_token("calibrated_sensor"),
            timestamp=time,
            fileformat="pcd",
            is_key_frame=True,
            height=0,
            width=0,
            filename=scan["file"],
            prev=previous,
            next=following,
        )
        rotation = _quaternion(pose[:3, :3])
        translation = pose[:3, 3].tolist()
        _add(tables, "ego_pose", token, timestamp=time, rotation=rotation, translation=translation)
        _add(tables, "lidarseg", token, sample_data_token=token, filename=scan["labels"])


def _quaternion(rotation: np.ndarray) -> list[float]:
    """Return the unit quaternion (w, x, y, z) of a (3, 3) rotation."""
    from scipy.spatial.transform import Rotation

    x, y, z, w = Rotation.from_matrix(rotation).as_quat()
    return [float(w), float(x), float(y), float(z)]


def _token(*parts: object) -> str:
    """Return the unique token that nuScenes' tables use for the row that `parts` name."""
    text = "/".join(map(str, parts))
    return hashlib.md5(text.encode(), usedforsecurity=False).hexdigest()


def _matrix_text(matrix: np.ndarray) -> str:
    """Return the first three rows of a (4, 4) matrix as one line of 12 numbers, like KITTI."""
    return " ".join(f"{value:e}" for value in matrix[:3].ravel())


def _write_empty_map(path: Path) -> None:
    """Write a black picture of a map: nuScenes' tools require one."""
    from matplotlib.image import imsave

    picture = BytesIO()
    imsave(picture, np.zeros((8, 8, 3), dtype=np.uint8), format="png")
    write_whole(path, picture.getvalue())


def _write_lines(path: Path, lines: list[str]) -> None:
    write_whole(path, "".join(f"{line}\n" for line in lines).encode())


def write_whole(path: Path, content: bytes) -> None:
    """Write a file, and its folder if there is none. The file appears whole or not at all.

    Raises:
        SimulationError: if the system refuses the file, as in a read-only folder.
    """
    part = path.with_name(f".{uuid.uuid4().hex}.part{path.suffix}")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with WRITE_LOCK:
            try:
                part.write_bytes(content)
                os.replace(part, path)
            finally:
                with suppress(OSError):  # a read-only file system refuses this as well
                    part.unlink(missing_ok=True)
    except OSError as error:
        if error.errno not in FOLDER_ERRNOS:
            raise
        raise SimulationError(
            f"{path}: expected a file that can be written, found {error.strerror}; "
            "give another folder"
        ) from None
