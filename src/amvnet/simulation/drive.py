"""Drives the sensor along simulated streets."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from amvnet.simulation.layouts import SimulatedScan
from amvnet.simulation.lidar import RayScene, trace
from amvnet.simulation.mesh import Mesh, join
from amvnet.simulation.populate import populate
from amvnet.simulation.returns import laser_gains, receive
from amvnet.simulation.sensors import LidarModel
from amvnet.simulation.site import Site
from amvnet.simulation.streets import Ground
from amvnet.simulation.styles import draw_style

SIGHT = 90.0  # metres along the street within which moving bodies are placed
WHEELBASE = 2.8  # metres


@dataclass(frozen=True)
class Drive:
    """How the sensor moves."""

    # Metres between two scans.
    spacing: float = 8.0
    # Metres of street before the first scan and after the last.
    margin: float = 90.0
    # Scans in one street. A longer sequence continues in another street: memory stays bounded.
    scans_per_street: int = 40
    # Smallest and largest speed in metres per second.
    speed: tuple[float, float] = (5.0, 12.0)


def drive_street(
    sensor: LidarModel, scans: int, seed: np.random.SeedSequence, drive: Drive | None = None
) -> Iterator[SimulatedScan]:
    """Yield the scans of one sequence, one after the other."""
    drive = drive or Drive()
    streets = math.ceil(scans / drive.scans_per_street)
    *street_seeds, device_seed = seed.spawn(streets + 1)
    gains = laser_gains(sensor, np.random.default_rng(device_seed))

    start_pose = np.eye(4)
    start_time = 0.0
    step = np.eye(4)
    step[0, 3] = drive.spacing
    for street, street_seed in enumerate(street_seeds):
        count = min(drive.scans_per_street, scans - street * drive.scans_per_street)
        rng = np.random.default_rng(street_seed)
        for scan in _drive_one_street(sensor, gains, count, rng, drive):
            pose = start_pose @ scan.pose
            time = start_time + scan.time
            yield replace(scan, pose=pose, time=time)

        # The next street begins one step ahead of the last scan of this one.
        start_pose = pose @ step
        start_time = time + 1.0


def _drive_one_street(
    sensor: LidarModel, gains: np.ndarray, scans: int, rng: np.random.Generator, drive: Drive
) -> Iterator[SimulatedScan]:
    """Yield the scans of one street, with poses relative to the first of them."""
    style = draw_style(rng)
    ground = Ground(style, 2 * drive.margin + scans * drive.spacing, rng)
    speed = float(rng.uniform(*drive.speed))
    site = populate(ground, rng, speed, drive.margin)
    fixed_scene = RayScene(join([ground.mesh(), *site.fixed]))
    sway = rng.uniform(-0.4, 0.4)  # metres to either side of the middle of the lane

    first_pose: np.ndarray | None = None
    for index in range(scans):
        x = drive.margin + index * drive.spacing
        time = index * drive.spacing / speed
        scenes = [fixed_scene]
        moving = _moving_mesh(site, x, time)
        if len(moving):
            scenes.append(RayScene(moving))

        t = -style.road / 4 + sway * np.sin(index * 0.7)
        pose = _draw_pose(ground, sensor, x, t, rng)
        hits = trace(scenes, sensor, pose, ground, rng, speed=speed)
        points, labels, ring = receive(hits, sensor, gains, rng)

        if first_pose is None:
            first_pose = pose
        yield SimulatedScan(points, labels, ring, np.linalg.inv(first_pose) @ pose, time)


def _moving_mesh(site: Site, ego_x: float, time: float) -> Mesh:
    """Return the moving bodies that the sensor at `ego_x` can see at a time."""
    bodies = []
    for mover in site.movers:
        x = (mover.x + mover.speed * time) % site.ground.length
        if abs(x - ego_x) < SIGHT:
            bodies.append(mover.at(site.ground, time))
    return join(bodies)


def _draw_pose(
    ground: Ground, sensor: LidarModel, x: float, t: float, rng: np.random.Generator
) -> np.ndarray:
    """Return the (4, 4) pose of the sensor above a place, tilted by road and suspension."""
    px, py, yaw = ground.pose_at(x, t)
    yaw += rng.normal(scale=0.02)
    forward = np.array([np.cos(yaw), np.sin(yaw)])

    # The slope between the axles, and random angles of the car body.
    half = WHEELBASE / 2
    front_x, front_y = np.array([px, py]) + half * forward
    rear_x, rear_y = np.array([px, py]) - half * forward
    rise = float(ground.height(front_x, front_y)) - float(ground.height(rear_x, rear_y))
    pitch = np.arctan2(rise, WHEELBASE) + rng.normal(scale=0.004)
    roll = rng.normal(scale=0.006)

    x_axis = np.array([forward[0] * np.cos(pitch), forward[1] * np.cos(pitch), np.sin(pitch)])
    level = np.array([-forward[1], forward[0], 0.0])
    y_axis = level * np.cos(roll) + np.cross(x_axis, level) * np.sin(roll)
    pose = np.eye(4)
    pose[:3, :3] = np.column_stack([x_axis, y_axis, np.cross(x_axis, y_axis)])
    pose[:3, 3] = (px, py, float(ground.height(px, py)) + sensor.height)
    return pose
