"""Where the sensor drives in a street: in a lane, out of a side road or through a car park."""

import math
from dataclasses import dataclass, replace

import numpy as np

from lidarstreets.sites.areas import AISLE, add_lot, has_room
from lidarstreets.sites.site import Plot, Site
from lidarstreets.streets.ground import Ground
from lidarstreets.streets.plans import SideRoad

# Shares of the streets in which the sensor comes out of a side road, drives through a car park,
# turns in its lane, or drives at the edge of the road.
FROM_SIDE_ROAD = 0.14
IN_CAR_PARK = 0.04
TURNING = 0.14
AT_THE_EDGE = 0.12
# Metres along the street: on longer courses, the sensor keeps to its lane.
LONGEST_DETOUR = 50.0
# Radians from scan to scan by which the phases of the sensor's sway and of its turn change.
SWAY_STEP = 0.7
TURN_STEP = 1.3
HALF_CAR = 1.0  # metres: half the width of a car that drives at the edge of the road


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
    """The course of the sensor through one street.

    Attributes:
        ground: the street.
        start: x along the street of the first scan; in a side road, distance from the street.
        spacing: metres between two scans.
        t: mean distance from the middle line of the street or of the side road, as in `Ground`.
        sway: metres by which the sensor is farther left or right at times.
        turn: largest angle in radians between the sensor and the street.
        side_road: the side road that the sensor comes from; None on the street.
    """

    ground: Ground
    start: float
    spacing: float
    t: float
    sway: float
    turn: float = 0.0
    side_road: SideRoad | None = None

    def street_x(self, index: int) -> float:
        """Return x along the street of a scan, or of the junction with the side road."""
        if self.side_road is not None:
            return self.side_road.street_x
        return self.start + index * self.spacing

    def pose_at(self, index: int) -> tuple[float, float, float]:
        """Return (x, y, yaw) of the sensor at a scan."""
        sway = self.sway * math.sin(index * SWAY_STEP)
        if self.side_road is not None:
            along = self.start - index * self.spacing
            x, y, yaw = self.side_road.pose_at(along, self.t + sway)
            return x, y, yaw + math.pi

        x, y, yaw = self.ground.pose_at(self.start + index * self.spacing, self.t + sway)
        return x, y, yaw + self.turn * math.cos(index * TURN_STEP)

    def places(self, scans: int) -> np.ndarray:
        """Return the (P, 2) x and y of the sensor at the first `scans` scans."""
        return np.array([self.pose_at(index)[:2] for index in range(scans)])


def draw_course(site: Site, scans: int, rng: np.random.Generator, drive: Drive) -> Course:
    """Draw the course of the sensor: mostly in a lane of the street."""
    ground = site.ground
    length = scans * drive.spacing
    sway = float(rng.uniform(-0.4, 0.4))
    is_short = length < LONGEST_DETOUR and ground.style.kind != "motorway"

    choice = rng.random()
    course = None
    if is_short and choice < FROM_SIDE_ROAD:
        course = _from_side_road(ground, length, rng, drive)
    elif is_short and choice < FROM_SIDE_ROAD + IN_CAR_PARK:
        course = _through_car_park(site, scans, rng, drive)
    if course is None:
        course = _in_lane(ground, rng, drive)
    return replace(course, sway=course.sway * sway)


def _from_side_road(
    ground: Ground, length: float, rng: np.random.Generator, drive: Drive
) -> Course | None:
    """Draw a course out of a side road, or return None if there is no suitable one."""
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

    t = side * (ground.front(side) + AISLE)
    course = Course(ground, drive.margin, drive.spacing, t, sway=0.5)
    site.course = replace(course, sway=0.0).places(scans)
    add_lot(area, depth)
    ground.reserved.append((side, area.x, area.end))
    return course


def _in_lane(ground: Ground, rng: np.random.Generator, drive: Drive) -> Course:
    """Draw a course in a lane of the street, perhaps turning or at the edge of the road."""
    ahead = [lane for lane, direction in ground.style.lanes if direction > 0]
    t = min(ahead) if rng.random() < 0.6 else float(rng.choice(ahead))
    turn = float(rng.normal(scale=0.01))

    choice = rng.random()
    if choice < TURNING and ground.style.kind != "motorway":
        turn = float(rng.uniform(-0.7, 0.7))
    elif choice < TURNING + AT_THE_EDGE:
        edge = max(ground.style.road / 2 - HALF_CAR, 0.5)
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
