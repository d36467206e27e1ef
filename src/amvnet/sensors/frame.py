"""Find the frame of a scan file: its unit, which axis points up, and how it is tilted."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from statistics import mode

import numpy as np

from amvnet.data.formats.cloud import Cloud
from amvnet.errors import InputError
from amvnet.sensors.ground import Ground, find_ground
from amvnet.sensors.lasers import laser_sharpness
from amvnet.sensors.lidars import AXES, Sensor, rotation_from_degrees

# The median distance of the points tells the unit. For all sensors it is 2 to 40 metres.
MAX_METRES_MEDIAN = 200.0  # largest median distance of coordinates in metres
# Smallest median distance of coordinates that must be millimetres. A median between the two limits
# may be in centimetres or millimetres.
MIN_MILLIMETRES_MEDIAN = 4000.0
MAX_SENSOR_HEIGHT = 4.5  # largest height of a sensor on a vehicle, metres; more may be feet
QUICK_STEP = 7  # step between the points that are measured first; it divides no number of lasers
# Largest ratio of the 5 % quantile of the distances to the 95 % quantile with which the origin is
# near the sensor.
AROUND_SHARE = 0.5

UP_AXES = ("z-down", "z-forward", "y-up")  # axes to try if there is no ground below the sensor
SAME_TILT = 3.5  # largest tilt that is not levelled, degrees; roads of the datasets slope by 3.1
STEADY_TILT = 3.0  # limit of the differences of tilt in a recording with one frame, degrees
SAME_HEIGHT = 0.15  # limit of the differences of height that stay, metres; training varies it
ON_GROUND_HEIGHT = 0.3  # limit of the height of an origin that lies on the ground, metres
# Below this height, the lasers tell whether the origin is a low sensor or the foot of a vehicle.
LOW_HEIGHT = 0.6
STANDING_HEIGHT = 0.3  # smallest height over the ground of points that tell, metres
RAISED = np.arange(0.6, 2.5, 0.15)  # heights over the origin at which sensors are sought, metres
# Largest ratio of the sharpness of the lasers, seen from the origin, to that from above, of an
# origin that is no sensor. PandaSet has 0.54 to 0.60. Simulated low sensors of all kinds have 1.1
# to 3.9, and at least 0.93 if their points are rounded to 5 cm or tilted by 3 degrees.
LESS_SHARP = 0.75


@dataclass(frozen=True)
class Frame:
    """The frame of a file, as far as it was found and not described by the user.

    Attributes:
        unit: the unit of the coordinates, a name in `UNITS`.
        axes: the directions of the axes, a name in `AXES`.
        pitch, roll: rotation that levels the scan in the package's axes, degrees; 0 if the scan is
            level enough or the user described the rotation.
        height: height of the origin over the ground in the level scan, metres, or None if there is
            no ground.
        tilt: tilt of the ground before the scan is levelled, degrees; messages state it.
        is_apart: whether the lasers show that the origin of the coordinates is not the sensor.
    """

    unit: str = "m"
    axes: str = "x-forward"
    pitch: float = 0.0
    roll: float = 0.0
    height: float | None = None
    tilt: float = 0.0
    is_apart: bool = False

    def complete(self, sensor: Sensor) -> Sensor:
        """Return the sensor; this frame completes what the user did not describe.

        Pitch and roll turn the scan about the sensor.
        """
        if sensor.rotate is not None:
            return dataclasses.replace(sensor, unit=self.unit)

        complete = dataclasses.replace(
            sensor, unit=self.unit, axes=self.axes, rotate=(0.0, self.pitch, self.roll)
        )
        if sensor.offset is None:
            return complete
        turn = complete.turn @ sensor.turn.T
        x, y, z = turn @ np.array(sensor.offset)
        return dataclasses.replace(complete, offset=(float(x), float(y), float(z)))

    def is_on_ground(self, sensor: Sensor) -> bool:
        """Return whether the origin of the coordinates lies on the ground or below it."""
        limit = LOW_HEIGHT if self.is_apart else ON_GROUND_HEIGHT
        may_be_higher = sensor.height is None or sensor.height >= limit
        return self.height is not None and self.height < limit and may_be_higher

    def rises(self, sensor: Sensor, usual_height: float | None) -> tuple[float, float]:
        """Return how far to move a scan up, metres.

        Args:
            usual_height: height over the ground of the sensor that the weights know, metres, or
                None if it is unknown. If the origin lies on the ground and the height of the sensor
                is unknown, the sensor is assumed to have this height.

        Returns:
            The rise that brings the sensor to the origin, and the rise that brings the ground to
            `usual_height` below the origin.
        """
        known = sensor.height
        if self.is_on_ground(sensor):
            assert self.height is not None
            sensor_height = known if known is not None else usual_height
            if sensor_height is None:
                return 0.0, 0.0
            target = sensor_height if usual_height is None else usual_height
            return self.height - sensor_height, self.height - target

        height = known if known is not None else self.height
        if height is None or usual_height is None or abs(height - usual_height) < SAME_HEIGHT:
            return 0.0, 0.0
        return 0.0, height - usual_height


def find_frame(xyz: np.ndarray, sensor: Sensor) -> Frame:
    """Find the frame of a scan with finite coordinates (N, 3), without lost points.

    Args:
        sensor: what the user described; only the rest is estimated.

    Raises:
        InputError: if the user did not give the unit, and the coordinates are clearly neither
            metres nor millimetres.
    """
    unit = sensor.unit or _find_unit(xyz, "give --unit cm or mm (or m, if they are metres)")
    frame = Frame(unit, sensor.axes or "x-forward")
    level = frame.complete(dataclasses.replace(sensor, unit=unit)).to_level(xyz)
    level = level.astype(np.float64)
    ground = find_ground(level)

    is_described = sensor.axes is not None or sensor.rotate is not None
    if ground is None and not is_described:
        axes = _find_axes(level)
        level = level @ np.array(AXES[axes], dtype=np.float64).T
        frame = dataclasses.replace(frame, axes=axes)
        ground = find_ground(level)

    # An unsure plane that is tilted may be a bank beside the sensor, which shows no height.
    is_tilted = ground is not None and ground.tilt > SAME_TILT
    if ground is None or (is_tilted and not ground.is_sure):
        return frame
    if sensor.rotate is None and is_tilted:
        return _level(frame, level, ground)
    is_apart = ON_GROUND_HEIGHT <= ground.height < LOW_HEIGHT and _is_apart(level, ground)
    return dataclasses.replace(frame, height=ground.height, tilt=ground.tilt, is_apart=is_apart)


def check_metres(cloud: Cloud) -> None:
    """Check that the points of an array are in metres.

    Raises:
        InputError: if the points of a file would be taken for other units, or refused.
    """
    advice = (
        "give metres, or to amvnet.load sensor={'unit': UNIT} with mm, cm, ft or m, or the height"
    )
    placed = np.flatnonzero(cloud.is_placed)
    part = cloud.xyz[placed[::QUICK_STEP]]
    if _find_unit(part, advice) != "m":
        raise InputError(f"expected metres from the sensor, found millimetres; {advice}")

    # Only then may the ground be so deep, which takes longer to find.
    if len(part) and np.quantile(part[:, 2], 0.1) < -MAX_SENSOR_HEIGHT:
        ground = find_ground(cloud.xyz[placed].astype(np.float64))
        if ground is not None and ground.height > MAX_SENSOR_HEIGHT:
            raise InputError(
                f"expected a sensor at most {MAX_SENSOR_HEIGHT:g} m over the ground, found "
                f"{ground.height:.1f}; {advice}"
            )


def _find_unit(xyz: np.ndarray, advice: str) -> str:
    """Return the unit, "m" or "mm", by the distances of points (N, 3)."""
    if not len(xyz):
        return "m"
    distances = np.linalg.norm(xyz.astype(np.float64), axis=1)
    near, median, far = np.quantile(distances, (0.05, 0.5, 0.95))

    # Points far from the origin are map coordinates, which `check_usable` refuses.
    if not median > MAX_METRES_MEDIAN or near > AROUND_SHARE * far:
        return "m"
    if median > MIN_MILLIMETRES_MEDIAN:
        return "mm"
    raise InputError(
        f"expected metres from the sensor, found half of the points farther than {median:.0f}; "
        f"{advice}"
    )


def _find_axes(xyz: np.ndarray) -> str:
    """Return the name in `UP_AXES` with which the points (N, 3) have a sure ground.

    Return "x-forward" if there is no such name or more than one. The walls of a corridor, for
    example, look like the ground.
    """
    sure = []
    for axes in UP_AXES:
        ground = find_ground(xyz @ np.array(AXES[axes], dtype=np.float64).T)
        if ground is not None and ground.is_sure:
            sure.append(axes)
    return sure[0] if len(sure) == 1 else "x-forward"


def _is_apart(level: np.ndarray, ground: Ground) -> bool:
    """Return whether the lasers of points (N, 3) are clearly sharper from above the origin.

    Those on the ground do not tell: a laser's circle there is a circle from any height.
    """
    standing = level[level @ ground.up + ground.height * ground.up[2] > STANDING_HEIGHT]
    above = max(laser_sharpness(standing - (0, 0, rise)) for rise in RAISED)
    return laser_sharpness(standing) < LESS_SHARP * above


def _level(frame: Frame, level: np.ndarray, ground: Ground) -> Frame:
    """Return the frame with the rotation that levels a tilted scan.

    The ground is found a second time, because the cells of the levelled scan have other lowest
    points.
    """
    turn = rotation_from_degrees(0, *_levelling(ground.up))
    again = find_ground(level @ turn.T) or ground
    up = ground.up if again is ground else turn.T @ again.up
    pitch, roll = _levelling(up)
    return dataclasses.replace(frame, pitch=pitch, roll=roll, height=again.height, tilt=ground.tilt)


def _levelling(up: np.ndarray) -> tuple[float, float]:
    """Return pitch and roll, degrees, of the rotation that turns a vector (3,) to +z."""
    x, y, z = up
    roll = np.degrees(np.arctan2(y, z))
    pitch = -np.degrees(np.arctan2(x, np.hypot(y, z)))
    return float(pitch), float(roll)


def median_frame(frames: Sequence[Frame]) -> Frame:
    """Return the frame of a recording from the frames of its first scans.

    The unit and the axes are the most frequent of all; the angles and the height are medians.
    """
    unit = mode(frame.unit for frame in frames)
    axes = mode(frame.axes for frame in frames)
    alike = [frame for frame in frames if (frame.unit, frame.axes) == (unit, axes)]
    turns = [(frame.pitch, frame.roll, frame.tilt) for frame in alike or frames]
    pitch, roll, tilt = np.median(turns, axis=0).tolist()
    heights = [frame.height for frame in frames if frame.height is not None]

    return Frame(
        unit,
        axes,
        pitch=pitch,
        roll=roll,
        height=float(np.median(heights)) if heights else None,
        tilt=tilt,
        is_apart=mode(frame.is_apart for frame in alike or frames),
    )
