"""Draw where the sensor drives: in a lane, out of a side road or through a car park."""

import math
from dataclasses import dataclass, replace

import numpy as np

from lidarstreets.sites.areas import AISLE_DISTANCE, add_lot, has_room
from lidarstreets.sites.site import Plot, Site
from lidarstreets.streets.ground import Ground
from lidarstreets.streets.plans import SideRoad

# Share of the short courses that come out of a side road, and share that cross a car park.
SIDE_ROAD_SHARE = 0.14
CAR_PARK_SHARE = 0.04
# Share of the courses in a lane on which the sensor turns, and share at the edge of the road.
TURNING_SHARE = 0.14
ROAD_EDGE_SHARE = 0.12
LONGEST_DETOUR = 50.0  # longest course that may leave the lane, metres along the street
SPACING = 8.0  # distance between two scans, metres, if nothing else is asked for
# Change of the phase of the sensor's sway, and of its turn, over this distance, radians.
SWAY_STEP = 0.7
TURN_STEP = 1.3
HALF_CAR_WIDTH = 1.0  # half the width of the car that carries the sensor, metres


@dataclass(frozen=True)
class Drive:
    """How the sensor moves.

    Attributes:
        spacing: distance between two scans, metres.
        margin: length of the street before the first scan and after the last, metres.
        scans_per_street: number of scans in one street. A longer sequence continues in another
            street, so that memory stays bounded.
        speed: smallest and largest speed, metres per second.
    """

    spacing: float = SPACING
    margin: float = 90.0
    scans_per_street: int = 40
    speed: tuple[float, float] = (5.0, 12.0)


@dataclass(frozen=True)
class Course:
    """The course of the sensor through one street.

    Attributes:
        ground: the ground of the street.
        start: place of the first scan, metres: x along the street, or on a side road the distance
            from the street.
        spacing: distance between two scans, metres.
        t: mean signed distance from the middle line of the street or of the side road, metres; see
            `MiddleLine`.
        sway: amplitude with which the sensor sways to the left and right, metres.
        turn: largest angle between the sensor and the street, radians.
        side_road: the side road that the sensor comes out of, or None if it drives on the street.
    """

    ground: Ground
    start: float
    spacing: float
    t: float
    sway: float
    turn: float = 0.0
    side_road: SideRoad | None = None

    def street_x(self, index: int) -> float:
        """Return x of scan `index` along the street, or x of the junction with the side road."""
        if self.side_road is not None:
            return self.side_road.street_x
        return self.start + index * self.spacing

    def pose_at(self, index: int) -> tuple[float, float, float]:
        """Return (x, y, yaw) of the sensor at scan `index`, in metres and radians."""
        steps = index * (self.spacing / SPACING)
        sway = self.sway * math.sin(steps * SWAY_STEP)
        if self.side_road is not None:
            along = self.start - index * self.spacing
            x, y, yaw = self.side_road.pose_at(along, self.t + sway)
            return x, y, yaw + math.pi

        x, y, yaw = self.ground.pose_at(self.start + index * self.spacing, self.t + sway)
        return x, y, yaw + self.turn * math.cos(steps * TURN_STEP)

    def places(self, scans: int) -> np.ndarray:
        """Return x and y of the sensor at the first `scans` scans: (scans, 2), metres."""
        return np.array([self.pose_at(index)[:2] for index in range(scans)])


def draw_course(site: Site, scans: int, rng: np.random.Generator, drive: Drive) -> Course:
    """Draw the course of the sensor; most courses follow a lane of the street."""
    ground = site.ground
    length = scans * drive.spacing
    sway = float(rng.uniform(-0.4, 0.4))
    is_short = length < LONGEST_DETOUR and ground.style.kind != "motorway"

    choice = rng.random()
    course = None
    if is_short and choice < SIDE_ROAD_SHARE:
        course = _from_side_road(ground, length, rng, drive)
    elif is_short and choice < SIDE_ROAD_SHARE + CAR_PARK_SHARE:
        course = _through_car_park(site, scans, rng, drive)
    if course is None:
        course = _in_lane(ground, rng, drive)
    return replace(course, sway=course.sway * sway)


def _from_side_road(
    ground: Ground, length: float, rng: np.random.Generator, drive: Drive
) -> Course | None:
    """Draw a course out of a side road, or return None if no side road is suitable."""
    side_road = _near_side_road(ground, length, drive)
    if side_road is None:
        return None

    first = ground.style.road / 2 + rng.uniform(1.0, 12.0) + length - drive.spacing
    t = side_road.width / 4
    return Course(ground, first, drive.spacing, t, sway=0.3, side_road=side_road)


def _through_car_park(
    site: Site, scans: int, rng: np.random.Generator, drive: Drive
) -> Course | None:
    """Draw a car park and a course along its aisle, or return None if there is no room."""
    ground = site.ground
    side = int(rng.choice([-1, 1]))
    area = Plot(site, side, drive.margin - 18, scans * drive.spacing + 28)
    depth = rng.uniform(16, 26)
    if not has_room(area, depth):
        return None

    t = side * (ground.front(side) + AISLE_DISTANCE)
    course = Course(ground, drive.margin, drive.spacing, t, sway=0.5)
    site.course = replace(course, sway=0.0).places(scans)
    add_lot(area, depth)
    ground.reserved.append((side, area.x, area.end))
    return course


def _in_lane(ground: Ground, rng: np.random.Generator, drive: Drive) -> Course:
    """Draw a course in a lane; on some, the sensor turns or drives at the edge of the road."""
    ahead = [lane for lane, direction in ground.style.lanes if direction > 0]
    t = min(ahead) if rng.random() < 0.6 else float(rng.choice(ahead))
    turn = float(rng.normal(scale=0.01))

    choice = rng.random()
    if choice < TURNING_SHARE and ground.style.kind != "motorway":
        turn = float(rng.uniform(-0.7, 0.7))
    elif choice < TURNING_SHARE + ROAD_EDGE_SHARE:
        edge = max(ground.style.road / 2 - HALF_CAR_WIDTH, 0.5)
        t = float(np.clip(t + rng.uniform(-1.2, 1.2), -edge, edge))
    return Course(ground, drive.margin, drive.spacing, t, sway=1.0, turn=turn)


def _near_side_road(ground: Ground, length: float, drive: Drive) -> SideRoad | None:
    """Return a side road that the sensor could come from, or None if there is none."""
    middle = drive.margin + length / 2
    for road in ground.plan.crossings:
        near = abs(road.street_x - middle) < length / 2 + 50
        is_long = road.length > ground.style.road / 2 + length + 16
        if near and is_long and road.width > 3.5:
            return road

    return None
