"""Drives the sensor along simulated streets."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from amvnet.simulation.layouts import SimulatedScan
from amvnet.simulation.mesh import Mesh, join
from amvnet.simulation.sensing.lidar import RayScene, trace
from amvnet.simulation.sensing.returns import laser_gains, receive
from amvnet.simulation.sensing.sensors import LidarModel, draw_device
from amvnet.simulation.sites.areas import AISLE, Area, add_lot, has_room
from amvnet.simulation.sites.populate import populate
from amvnet.simulation.sites.site import MOVING_CLEARANCE, Site, covers
from amvnet.simulation.streets.ground import Ground
from amvnet.simulation.streets.plans import SideRoad
from amvnet.simulation.streets.styles import Style, draw_style

SIGHT = 90.0  # metres along the street within which moving bodies are placed
WHEELBASE = 2.8  # metres
TRACK = 1.5  # metres between left and right wheels
STEEPEST_CAR = 0.2  # radians
# Shares of the streets in which the sensor comes out of a side road, drives through a car park,
# turns in its lane, or drives at the edge of the road.
FROM_SIDE_ROAD = 0.14
IN_CAR_PARK = 0.04
TURNING = 0.14
AT_THE_EDGE = 0.12
# Metres along the street: farther, the sensor keeps to its lane.
LONGEST_DETOUR = 50.0


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


@dataclass(frozen=True)
class Course:
    """The way of the sensor through one street.

    Attributes:
        ground: the street.
        start: x along the street of the first scan; in a side road, distance from the street.
        spacing: metres between two scans.
        t: place across the street, or across the side road.
        sway: metres to either side of it.
        turn: largest angle in radians between the sensor and the street.
        side_road: the side road that the sensor comes from; None on the street.
    """

    ground: Ground
    start: float
    spacing: float
    t: float
    sway: float
    turn: float
    side_road: SideRoad | None

    def street_x(self, index: int) -> float:
        """Return x along the street, at the place of a scan or at the junction."""
        if self.side_road is not None:
            return self.side_road.street_x
        return self.start + index * self.spacing

    def pose_at(self, index: int) -> tuple[float, float, float]:
        """Return (x, y, yaw) of the sensor at a scan."""
        sway = self.sway * math.sin(index * 0.7)
        if self.side_road is not None:
            along = self.start - index * self.spacing
            x, y, yaw = self.side_road.pose_at(along, self.t + sway)
            return x, y, yaw + math.pi

        x, y, yaw = self.ground.pose_at(self.start + index * self.spacing, self.t + sway)
        return x, y, yaw + self.turn * math.cos(index * 1.3)


def drive_street(
    sensor: LidarModel, scans: int, seed: np.random.SeedSequence, drive: Drive | None = None
) -> Iterator[SimulatedScan]:
    """Yield the scans of one sequence, one after the other."""
    drive = drive or Drive()
    streets = math.ceil(scans / drive.scans_per_street)
    *street_seeds, device_seed = seed.spawn(streets + 1)
    device_rng = np.random.default_rng(device_seed)
    device = draw_device(sensor, device_rng)
    gains = laser_gains(device, device_rng)

    start_pose = np.eye(4)
    start_time = 0.0
    step = np.eye(4)
    step[0, 3] = drive.spacing
    for street, street_seed in enumerate(street_seeds):
        count = min(drive.scans_per_street, scans - street * drive.scans_per_street)
        rng = np.random.default_rng(street_seed)
        for scan in _drive_one_street(device, gains, count, rng, drive):
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
    way = (drive.margin, drive.margin + scans * drive.spacing)
    ground = Ground(style, drive.margin + way[1], rng, way)
    speed = float(rng.uniform(*drive.speed)) * style.speed
    site, course = _build_site(ground, scans, speed, rng, drive)
    fixed_scene = RayScene(join([ground.mesh(), *site.fixed]))

    first_pose: np.ndarray | None = None
    for index in range(scans):
        time = index * drive.spacing / speed
        scenes = [fixed_scene]
        moving = _moving_mesh(site, course, index, time)
        if len(moving):
            scenes.append(RayScene(moving))

        pose = _tilted_pose(ground, sensor, course.pose_at(index), rng)
        hits = trace(scenes, sensor, pose, ground, rng, speed=speed)
        points, labels, ring = receive(hits, sensor, gains, rng)

        if first_pose is None:
            first_pose = pose
        yield SimulatedScan(points, labels, ring, np.linalg.inv(first_pose) @ pose, time)


def _build_site(
    ground: Ground, scans: int, speed: float, rng: np.random.Generator, drive: Drive
) -> tuple[Site, Course]:
    """Draw the course of the sensor, and fill the street around it."""
    site = Site(ground, rng)
    course = _draw_course(site, scans, rng, drive)
    places = [course.pose_at(index)[:2] for index in range(scans)]
    site.course = np.array(places)

    lane = course.t if course.side_road is None else np.inf
    populate(site, speed, (drive.margin, lane))
    return site, course


def _draw_course(site: Site, scans: int, rng: np.random.Generator, drive: Drive) -> Course:
    """Draw the way of the sensor: mostly in a lane of the street."""
    ground = site.ground
    length = scans * drive.spacing
    sway = float(rng.uniform(-0.4, 0.4))
    is_short = length < LONGEST_DETOUR and ground.style.kind != "motorway"

    choice = rng.random()
    if is_short and choice < FROM_SIDE_ROAD:
        side_road = _near_side_road(ground, length, drive)
        if side_road is not None:
            first = ground.style.road / 2 + rng.uniform(1.0, 12.0) + length - drive.spacing
            t = side_road.width / 4
            return Course(ground, first, drive.spacing, t, 0.3 * sway, 0.0, side_road)
    elif is_short and choice < FROM_SIDE_ROAD + IN_CAR_PARK:
        side = int(rng.choice([-1, 1]))
        area = Area(side, drive.margin - 18, drive.margin + length + 10, rng.uniform(16, 26))
        if has_room(site, area):
            t = side * (ground.front(side) + AISLE)
            site.course = np.array(
                [ground.pose_at(drive.margin + i * drive.spacing, t)[:2] for i in range(scans)]
            )
            add_lot(site, area)
            ground.reserved.append((side, area.start, area.stop))
            return Course(ground, drive.margin, drive.spacing, t, 0.5 * sway, 0.0, None)

    ahead = [lane for lane, direction in ground.style.lanes if direction > 0]
    t = min(ahead) if rng.random() < 0.6 else float(rng.choice(ahead))
    turn = float(rng.normal(scale=0.01))
    choice = rng.random()
    if choice < TURNING and ground.style.kind != "motorway":
        turn = float(rng.uniform(-0.7, 0.7))
    elif choice < TURNING + AT_THE_EDGE:
        edge = _free_half_width(ground.style)
        t = float(np.clip(t + rng.uniform(-1.2, 1.2), -edge, edge))
    return Course(ground, drive.margin, drive.spacing, t, sway, turn, None)


def _free_half_width(style: Style) -> float:
    """Return the largest |t| at which a car is on the carriageway."""
    return max(style.road / 2 - 1.0, 0.5)


def _near_side_road(ground: Ground, length: float, drive: Drive) -> SideRoad | None:
    """Return a side road that the sensor could come from, or None if there is none."""
    middle = drive.margin + length / 2
    for road in ground.plan.crossings:
        near = abs(road.street_x - middle) < length / 2 + 50
        is_long = road.length > ground.style.road / 2 + length + 16
        if near and is_long and road.width > 3.5:
            return road

    return None


def _moving_mesh(site: Site, course: Course, index: int, time: float) -> Mesh:
    """Return the moving bodies that the sensor can see at a scan."""
    ego_x = course.street_x(index)
    ego = np.array([course.pose_at(index)[:2]])
    bodies = []
    for mover in site.movers:
        x = mover.place(site.ground, time)
        if abs(x - ego_x) < SIGHT and site.ground.is_street(x, 2.0):
            pose = mover.pose_at(site.ground, time)
            if not covers(mover.mesh, pose, ego, MOVING_CLEARANCE):
                bodies.append(mover.at(site.ground, time))
    return join(bodies)


def _tilted_pose(
    ground: Ground, sensor: LidarModel, place: tuple[float, float, float], rng: np.random.Generator
) -> np.ndarray:
    """Return the (4, 4) pose of the sensor above (x, y, yaw), tilted by road and suspension."""
    px, py, yaw = place
    yaw += rng.normal(scale=0.02)
    forward = np.array([np.cos(yaw), np.sin(yaw)])
    left = np.array([-forward[1], forward[0]])

    # The slopes between the axles and the wheels, and the angles of car body and mounting.
    half = WHEELBASE / 2
    half_track = TRACK / 2
    pitch = _slope(ground, place, forward * half) + rng.normal(scale=0.004)
    roll = _slope(ground, place, left * half_track) + rng.normal(scale=0.006)
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
    """Return the angle in radians by which the ground rises between two sides of a place."""
    x = place[0] + step[0] * np.array([-1.0, 1.0])
    y = place[1] + step[1] * np.array([-1.0, 1.0])
    back, front = ground.height(x, y)
    angle = math.atan2(front - back, 2 * float(np.hypot(*step)))
    return float(np.clip(angle, -STEEPEST_CAR, STEEPEST_CAR))
