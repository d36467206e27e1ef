"""Drives the sensor along simulated streets and writes what it sees in SemanticKITTI's layout."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from amvnet.errors import InputError
from amvnet.simulation.lidar import SENSORS, RayScene, Sensor, receive, require_embree, trace
from amvnet.simulation.mesh import join
from amvnet.simulation.populate import populate
from amvnet.simulation.streets import Ground
from amvnet.simulation.styles import draw_style


@dataclass(frozen=True)
class Drive:
    """How the sensor moves."""

    # Metres between two scans.
    spacing: float = 8.0
    # Metres of street before the first and behind the last scan.
    margin: float = 90.0
    # Scans in one street; a longer sequence goes on in another street, so that memory stays bounded.
    scans_per_street: int = 40
    # Smallest and largest speed in metres per second.
    speed: tuple[float, float] = (5.0, 12.0)


@dataclass(frozen=True)
class SimulatedScan:
    """One scan in memory.

    Attributes:
        points: (N, 4) float32 x, y, z in metres and intensity in [0, 1], in the sensor's frame.
        labels: (N,) uint32 raw SemanticKITTI ids, instance ids in the upper 16 bits.
        pose: (4, 4) from the sensor's frame to the sequence's.
        time: seconds since the sequence began.
    """

    points: np.ndarray
    labels: np.ndarray
    pose: np.ndarray
    time: float


# From the LiDAR's axes (forward, left, up) to a camera's (right, down, forward), as calib.txt gives it.
_TO_CAMERA = np.array([[0.0, -1, 0, 0], [0, 0, -1, -0.08], [1, 0, 0, -0.27], [0, 0, 0, 1]])


def simulate(
    out: Path,
    *,
    sensor: str = "hdl64e",
    sequences: int = 1,
    scans: int = 10,
    seed: int = 0,
    first_sequence: int = 0,
    progress: Callable[[int, int], None] | None = None,
) -> Path:
    """Writes labelled scans of procedural streets as OUT/sequences/XX; the same seed gives the same bytes.

    Args:
        out: folder to write to.
        sensor: name of a sensor in `SENSORS`.
        sequences: number of sequences; each is another street.
        scans: number of scans in each sequence.
        seed: where all randomness comes from.
        first_sequence: number of the first sequence.
        progress: called with (scans done, scans in all) after each scan.

    Returns:
        The folder `out`.

    Raises:
        InputError: where the sensor is unknown, a number is too small or embreex is missing.
    """
    device = _sensor(sensor)
    _at_least(1, sequences=sequences, scans=scans)
    _at_least(0, seed=seed, first_sequence=first_sequence)
    require_embree()
    for index in range(sequences):
        number = first_sequence + index
        folder = Path(out) / "sequences" / f"{number:02d}"
        track: list[tuple[np.ndarray, float]] = []
        for scan in drive_street(device, scans, np.random.SeedSequence((seed, number))):
            _write_scan(folder, len(track), scan)
            track.append((scan.pose, scan.time))
            if progress is not None:
                progress(index * scans + len(track), sequences * scans)
        _write_tables(folder, track)
    return Path(out)


def simulate_scan(sensor: str = "hdl64e", seed: int = 0) -> SimulatedScan:
    """One scan of a street in memory."""
    return next(drive_street(_sensor(sensor), 1, np.random.SeedSequence((seed, 0))))


def _at_least(least: int, **numbers: int) -> None:
    for name, value in numbers.items():
        if value < least:
            raise InputError(f"simulate: expected {name} of {least} or more, found {value}; give a larger number")


def _sensor(name: str) -> Sensor:
    if name not in SENSORS:
        raise InputError(f"sensor: expected one of {', '.join(SENSORS)}, found {name!r}; name one of these")
    return SENSORS[name]


def drive_street(
    sensor: Sensor, scans: int, seed: np.random.SeedSequence, drive: Drive | None = None
) -> Iterator[SimulatedScan]:
    """The scans of one sequence, one after the other."""
    drive = drive or Drive()
    blocks = -(-scans // drive.scans_per_street)
    start, clock = np.eye(4), 0.0
    for block, block_seed in enumerate(seed.spawn(blocks)):
        count = min(drive.scans_per_street, scans - block * drive.scans_per_street)
        for scan in _drive_block(sensor, count, np.random.default_rng(block_seed), drive):
            pose = start @ scan.pose
            yield SimulatedScan(scan.points, scan.labels, pose, clock + scan.time)
        # The next street begins one step ahead of this one's last scan.
        step = np.eye(4)
        step[0, 3] = drive.spacing
        start, clock = pose @ step, clock + scan.time + 1.0


def _drive_block(sensor: Sensor, scans: int, rng: np.random.Generator, drive: Drive) -> Iterator[SimulatedScan]:
    """Scans of one street, with poses relative to its first scan."""
    style = draw_style(rng)
    ground = Ground(style, 2 * drive.margin + scans * drive.spacing, rng)
    speed = float(rng.uniform(*drive.speed))
    site = populate(ground, rng, speed, drive.margin)
    standing = RayScene(join([ground.mesh(), *site.fixed]))
    sway = rng.uniform(-0.4, 0.4)
    first: np.ndarray | None = None
    for index in range(scans):
        x, time = drive.margin + index * drive.spacing, index * drive.spacing / speed
        moving = join(
            [mover.at(ground, time) for mover in site.movers if _near(mover.x + mover.speed * time, x, ground)]
        )
        scenes = [standing, RayScene(moving)] if len(moving) else [standing]
        pose = _pose(ground, sensor, x, -style.road / 4 + sway * np.sin(index * 0.7), rng)
        points, labels = receive(trace(scenes, sensor, pose, ground.label), sensor, rng)
        first = pose if first is None else first
        yield SimulatedScan(points, labels, np.linalg.inv(first) @ pose, time)


def _near(x: float, ego: float, ground: Ground, reach: float = 90.0) -> bool:
    """True where something is within the sensor's reach along the street."""
    return abs(x % ground.length - ego) < reach


def _pose(ground: Ground, sensor: Sensor, x: float, t: float, rng: np.random.Generator) -> np.ndarray:
    """The sensor above the road at a place, tilted as the road and the springs tilt it. (4, 4)."""
    px, py, yaw = ground.at(x, t)
    yaw += rng.normal(scale=0.02)
    forward = np.array([np.cos(yaw), np.sin(yaw)])
    ahead, behind = (float(ground.height(*(np.array([px, py]) + s * 1.4 * forward))) for s in (1, -1))
    pitch = np.arctan2(ahead - behind, 2.8) + rng.normal(scale=0.004)
    roll = rng.normal(scale=0.006)
    x_axis = np.array([forward[0] * np.cos(pitch), forward[1] * np.cos(pitch), np.sin(pitch)])
    flat = np.array([-forward[1], forward[0], 0.0])
    y_axis = flat * np.cos(roll) + np.cross(x_axis, flat) * np.sin(roll)
    pose = np.eye(4)
    pose[:3, :3] = np.column_stack([x_axis, y_axis, np.cross(x_axis, y_axis)])
    pose[:3, 3] = (px, py, float(ground.height(px, py)) + sensor.height)
    return pose


def _write_scan(folder: Path, index: int, scan: SimulatedScan) -> None:
    _write(folder / "velodyne" / f"{index:06d}.bin", scan.points.astype("<f4").tobytes())
    _write(folder / "labels" / f"{index:06d}.label", scan.labels.astype("<u4").tobytes())


def _write_tables(folder: Path, track: list[tuple[np.ndarray, float]]) -> None:
    """poses.txt in the camera's frame, calib.txt and times.txt, as KITTI's odometry has them."""
    back = np.linalg.inv(_TO_CAMERA)
    poses = [_row(_TO_CAMERA @ pose @ back) for pose, _ in track]
    camera = _row(np.array([[700.0, 0, 600, 0], [0, 700, 180, 0], [0, 0, 1, 0], [0, 0, 0, 1]]))
    calibration = [f"P{i}: {camera}" for i in range(4)] + [f"Tr: {_row(_TO_CAMERA)}"]
    times = [f"{time:e}" for _, time in track]
    for name, lines in (("poses.txt", poses), ("calib.txt", calibration), ("times.txt", times)):
        _write(folder / name, "".join(f"{line}\n" for line in lines).encode())


def _row(matrix: np.ndarray) -> str:
    return " ".join(f"{value:e}" for value in matrix[:3].ravel())


def _write(path: Path, content: bytes) -> None:
    """Writes under a temporary name first, so that a file is there whole or not at all."""
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_name(f".{path.name}.partial")
    partial.write_bytes(content)
    partial.replace(path)
