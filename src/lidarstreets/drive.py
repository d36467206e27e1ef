"""Drive the sensor along simulated streets."""

import math
from collections.abc import Iterator
from dataclasses import replace
from itertools import repeat

import numpy as np

from lidarstreets.course import Course, Drive, draw_course
from lidarstreets.layouts import SimulatedScan
from lidarstreets.mesh import Mesh, join
from lidarstreets.sensing.any_sensor import draw_sensor
from lidarstreets.sensing.lidar import RayScene, trace
from lidarstreets.sensing.returns import Lasers, draw_lasers, receive
from lidarstreets.sensing.sensors import ANY, LidarModel, draw_device, sensor_of
from lidarstreets.sites.populate import populate
from lidarstreets.sites.site import MOVING_CLEARANCE, Site, covers
from lidarstreets.streets.ground import Ground
from lidarstreets.streets.regions import REGIONS
from lidarstreets.streets.styles import draw_style

SIGHT_DISTANCE = 90.0  # largest distance of a visible moving body, metres along the street
WHEELBASE = 2.8  # distance between the axles of the car, metres
TRACK_WIDTH = 1.5  # distance between the left and the right wheels, metres
STEEPEST_TILT = 0.2  # largest pitch or roll that the ground gives the car, radians


def drive_street(
    sensor: LidarModel | str,
    scans: int,
    seed: np.random.SeedSequence,
    drive: Drive | None = None,
) -> Iterator[SimulatedScan]:
    """Yield the scans of one sequence, one after the other.

    Args:
        sensor: the LiDAR; its name in `LIDAR_MODELS`; or `ANY`, which draws one for each scan.
        scans: number of scans.
        seed: seed of all randomness.
        drive: how the sensor moves; by default like the cars of both benchmarks in towns.

    Raises:
        SimulationError: if the sensor is unknown, or embreex is missing.
    """
    drive = drive or Drive()
    streets = math.ceil(scans / drive.scans_per_street)
    *street_seeds, device_seed = seed.spawn(streets + 1)
    devices = _devices(sensor, np.random.default_rng(device_seed))

    start_pose = np.eye(4)
    start_time = 0.0
    step = np.eye(4)
    step[0, 3] = drive.spacing

    for street, street_seed in enumerate(street_seeds):
        count = min(drive.scans_per_street, scans - street * drive.scans_per_street)
        rng = np.random.default_rng(street_seed)
        for scan in _drive_one_street(devices, count, rng, drive):
            pose = start_pose @ scan.pose
            time = start_time + scan.time
            yield replace(scan, pose=pose, time=time)

        # The next street begins one step ahead of the last scan of this one.
        start_pose = pose @ step
        start_time = time + 1.0


def _devices(
    sensor: LidarModel | str, rng: np.random.Generator
) -> Iterator[tuple[LidarModel, Lasers]]:
    """Yield the device of each scan and its lasers: one device, or others if any may be drawn."""
    while True:
        model = draw_sensor(rng) if sensor == ANY else sensor_of(sensor)
        device = draw_device(model, rng)
        lasers = draw_lasers(device, rng)
        yield device, lasers
        if sensor != ANY:
            yield from repeat((device, lasers))


def _drive_one_street(
    devices: Iterator[tuple[LidarModel, Lasers]], scans: int, rng: np.random.Generator, drive: Drive
) -> Iterator[SimulatedScan]:
    """Yield the scans of one street; their poses are relative to the first scan."""
    sensor, lasers = next(devices)
    region = sensor.region or str(rng.choice(list(REGIONS)))
    style = draw_style(rng, REGIONS[region])
    end = drive.margin + scans * drive.spacing
    ground = Ground(style, end + drive.margin, rng, (drive.margin, end))
    speed = float(rng.uniform(*drive.speed)) * style.speed
    site, course = build_site(ground, scans, speed, rng, drive)
    fixed_scene = RayScene(join(ground.mesh(), *site.fixed))

    first_pose: np.ndarray | None = None
    for index in range(scans):
        if index:
            sensor, lasers = next(devices)
        time = index * drive.spacing / speed
        scenes = [fixed_scene]
        moving = _moving_mesh(site, course, index, time)
        if len(moving):
            scenes.append(RayScene(moving))

        pose = _tilted_pose(ground, sensor, course.pose_at(index), rng)
        hits = trace(scenes, sensor, pose, ground, rng, speed=speed)
        points, labels, ring = receive(hits, sensor, lasers, rng)

        if first_pose is None:
            first_pose = pose
        yield SimulatedScan(points, labels, ring, np.linalg.inv(first_pose) @ pose, time)


def build_site(
    ground: Ground, scans: int, speed: float, rng: np.random.Generator, drive: Drive
) -> tuple[Site, Course]:
    """Draw the course of the sensor, and fill the street around it with bodies."""
    site = Site(ground, rng)
    course = draw_course(site, scans, rng, drive)
    site.course = course.places(scans)

    lane = course.t if course.side_road is None else np.inf
    populate(site, speed, (drive.margin, lane))
    return site, course


def _moving_mesh(site: Site, course: Course, index: int, time: float) -> Mesh:
    """Return the moving bodies that the sensor can see at scan `index`, at a time in seconds."""
    ego_x = course.street_x(index)
    ego = np.array([course.pose_at(index)[:2]])
    bodies = []
    for mover in site.movers:
        x = mover.street_x(site.ground, time)
        if abs(x - ego_x) < SIGHT_DISTANCE and site.ground.is_street(x, 2.0):
            pose = mover.pose_at(site.ground, time)
            if not covers(mover.mesh, pose, ego, MOVING_CLEARANCE):
                bodies.append(mover.mesh_at(site.ground, time))
    return join(*bodies)


def _tilted_pose(
    ground: Ground, sensor: LidarModel, place: tuple[float, float, float], rng: np.random.Generator
) -> np.ndarray:
    """Return the (4, 4) pose of the sensor above (x, y, yaw).

    The road and the suspension tilt it.
    """
    px, py, yaw = place
    yaw += rng.normal(scale=0.02)
    forward = np.array([np.cos(yaw), np.sin(yaw)])
    left = np.array([-forward[1], forward[0]])

    # The slopes between the axles and between the wheels tilt the car; its body and the mounting of
    # the sensor add their own angles.
    pitch = _slope(ground, place, forward * (WHEELBASE / 2)) + rng.normal(scale=0.004)
    roll = _slope(ground, place, left * (TRACK_WIDTH / 2)) + rng.normal(scale=0.006)
    pitch += np.radians(sensor.pitch)
    roll += np.radians(sensor.roll)

    x_axis = np.array([forward[0] * np.cos(pitch), forward[1] * np.cos(pitch), np.sin(pitch)])
    level = np.array([-forward[1], forward[0], 0.0])
    y_axis = level * np.cos(roll) + np.cross(x_axis, level) * np.sin(roll)
    pose = np.eye(4)
    pose[:3, :3] = np.column_stack([x_axis, y_axis, np.cross(x_axis, y_axis)])
    pose[:3, 3] = (px, py, float(ground.height(px, py)) + sensor.height)
    return pose


def _slope(ground: Ground, place: tuple[float, float, float], step: np.ndarray) -> float:
    """Return the slope of the ground from `place - step` to `place + step` as an angle in radians.

    `step` is (x, y) in metres. The angle is positive if the ground rises.
    """
    x = place[0] + step[0] * np.array([-1.0, 1.0])
    y = place[1] + step[1] * np.array([-1.0, 1.0])
    back, front = ground.height(x, y)
    angle = math.atan2(front - back, 2 * float(np.hypot(*step)))
    return float(np.clip(angle, -STEEPEST_TILT, STEEPEST_TILT))
