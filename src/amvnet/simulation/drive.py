"""Drives the sensor along simulated streets."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from amvnet.simulation.layouts import SimulatedScan
from amvnet.simulation.lidar import RayScene, trace
from amvnet.simulation.mesh import join
from amvnet.simulation.populate import populate
from amvnet.simulation.returns import laser_gains, receive
from amvnet.simulation.sensors import Sensor
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


def drive_street(
    sensor: Sensor, scans: int, seed: np.random.SeedSequence, drive: Drive | None = None
) -> Iterator[SimulatedScan]:
    """The scans of one sequence, one after the other."""
    drive = drive or Drive()
    blocks = -(-scans // drive.scans_per_street)
    start, clock = np.eye(4), 0.0
    *streets, device = seed.spawn(blocks + 1)
    gains = laser_gains(sensor, np.random.default_rng(device))
    for block, block_seed in enumerate(streets):
        count = min(drive.scans_per_street, scans - block * drive.scans_per_street)
        for scan in _drive_block(sensor, gains, count, np.random.default_rng(block_seed), drive):
            pose = start @ scan.pose
            yield replace(scan, pose=pose, time=clock + scan.time)
        # The next street begins one step ahead of this one's last scan.
        step = np.eye(4)
        step[0, 3] = drive.spacing
        start, clock = pose @ step, clock + scan.time + 1.0


def _drive_block(
    sensor: Sensor, gains: np.ndarray, scans: int, rng: np.random.Generator, drive: Drive
) -> Iterator[SimulatedScan]:
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
            [
                mover.at(ground, time)
                for mover in site.movers
                if _near(mover.x + mover.speed * time, x, ground)
            ]
        )
        scenes = [standing, RayScene(moving)] if len(moving) else [standing]
        pose = _pose(ground, sensor, x, -style.road / 4 + sway * np.sin(index * 0.7), rng)
        points, labels, ring = receive(
            trace(scenes, sensor, pose, ground, rng, speed), sensor, gains, rng
        )
        first = pose if first is None else first
        yield SimulatedScan(points, labels, ring, np.linalg.inv(first) @ pose, time)


def _near(x: float, ego: float, ground: Ground, reach: float = 90.0) -> bool:
    """True where something is within the sensor's reach along the street."""
    return abs(x % ground.length - ego) < reach


def _pose(
    ground: Ground, sensor: Sensor, x: float, t: float, rng: np.random.Generator
) -> np.ndarray:
    """The sensor above the road at a place, tilted as the road and the springs tilt it. (4, 4)."""
    px, py, yaw = ground.at(x, t)
    yaw += rng.normal(scale=0.02)
    forward = np.array([np.cos(yaw), np.sin(yaw)])
    ahead, behind = (
        float(ground.height(*(np.array([px, py]) + s * 1.4 * forward))) for s in (1, -1)
    )
    pitch = np.arctan2(ahead - behind, 2.8) + rng.normal(scale=0.004)
    roll = rng.normal(scale=0.006)
    x_axis = np.array([forward[0] * np.cos(pitch), forward[1] * np.cos(pitch), np.sin(pitch)])
    flat = np.array([-forward[1], forward[0], 0.0])
    y_axis = flat * np.cos(roll) + np.cross(x_axis, flat) * np.sin(roll)
    pose = np.eye(4)
    pose[:3, :3] = np.column_stack([x_axis, y_axis, np.cross(x_axis, y_axis)])
    pose[:3, 3] = (px, py, float(ground.height(px, py)) + sensor.height)
    return pose
