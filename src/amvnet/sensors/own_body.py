"""Find the points of the car's own body in a scan, or measure its box by scans of a drive.

Finding them needs only NumPy.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass

import numpy as np

from amvnet.data.formats.cloud import Cloud
from amvnet.errors import InputError
from amvnet.scan import Scan, at_origin
from amvnet.sensors.frame import QUICK_STEP, find_frame
from amvnet.sensors.lasers import SensorGeometry, measure_lasers
from amvnet.sensors.lidars import KNOWN_BODIES, KNOWN_SENSORS, UNITS, Box, Sensor

# The least share of a scan's points in the box of a known body that shows this body. The 169 frames
# of nuScenes that were measured have 18 to 34 % there; a robot with similar lasers has 9 %.
LEAST_OWN = 0.15

# The measurement of the box.
SCANS = 10  # number of scans to measure, spread over all scans
LEAST_SCANS = 5  # with fewer scans, too much stays by chance
VOXEL = 0.2  # edge of a voxel, metres
AROUND = np.array([20.0, 20.0, 4.0])  # half the size of the space around the sensor, metres
REACH = 4.0  # the body lies within this distance in x and y, metres
OVER_GROUND = 0.4  # points below this height over the ground are left out, metres
STAYS = 0.8  # a voxel stays if it has points in this share of the scans
# Limits between the scans that were measured: nuScenes, KITTI and PandaSet, and simulated drives.
MAX_STILL = 0.3  # a car stands if a larger share of the voxels beyond its reach stays
LEAST_SHARE = 0.01  # the least share of the points in voxels that stay and are of a body


def own_points(xyz: np.ndarray, ring: np.ndarray | None, sensor: Sensor) -> np.ndarray | None:
    """Return (N,) bool: which points are of the car's own body; None if no body is known.

    A known body is found by its lasers and by its many points.

    Args:
        xyz: (N, 3 or more) the points in the axes of their file, metres.
        ring: (N,) index of each point's laser, or None if it is unknown.
    """
    if sensor.keep_own:
        return None
    if sensor.own_body is not None:
        return is_inside(xyz, sensor.own_body)

    for name, box in KNOWN_BODIES.items():
        own = is_inside(xyz, box)
        own[at_origin(xyz)] = False  # lost returns
        if own.mean() >= LEAST_OWN:
            part = xyz[::QUICK_STEP, :3]  # enough to know the lasers
            placed = np.isfinite(part).all(axis=1)
            of_part = None if ring is None else ring[::QUICK_STEP][placed]
            seen = measure_lasers(part[placed], of_part)
            lasers = SensorGeometry().override(KNOWN_SENSORS[name])
            # Without distant points, no laser shows the sensor.
            if seen.fov_up is not None and seen.is_like(lasers):
                return own
    return None


def mark_own(scan: Scan, sensor: Sensor) -> Scan:
    """Return a scan in the axes of its file with `Scan.own`, unless it has that already."""
    if scan.own is not None:
        return scan
    return dataclasses.replace(scan, own=own_points(scan.points, scan.ring, sensor))


def is_inside(xyz: np.ndarray, box: Box) -> np.ndarray:
    """Return (N,) bool: which points lie in a box."""
    inside: np.ndarray = np.ones(len(xyz), dtype=bool)
    for axis in range(3):
        inside &= (xyz[:, axis] >= box[axis]) & (xyz[:, axis] <= box[axis + 3])
    return inside


@dataclass(frozen=True)
class Body:
    """The measured body of a car.

    Attributes:
        box: its lowest and highest x, y, z as `Sensor.own_body` states them.
        share: the share of the scans' points in this box.
    """

    box: Box
    share: float


def measure_body(scans: Sequence[Callable[[], Cloud]], sensor: Sensor) -> Body | None:
    """Return the body of the car that recorded some scans; None if none is found or is known.

    `scans` read them in the order of the drive. Scans that cannot be read are left out.
    """
    if sensor.keep_own or sensor.own_body is not None or not scans:
        return None

    clouds: list[Cloud] = []
    for index in np.unique(np.linspace(0, len(scans) - 1, SCANS).round().astype(int)):
        with suppress(InputError):
            cloud = scans[index]()
            unit = find_frame(cloud.xyz[cloud.is_placed], sensor).unit
            if own_points(cloud.xyz * UNITS[unit], cloud.ring, sensor) is not None:
                return None
            clouds.append(cloud)
    return find_body(clouds, sensor)


def find_body(clouds: Sequence[Cloud], sensor: Sensor) -> Body | None:
    """Return the body that stays in its place in all clouds while everything else moves, or None.

    Raises:
        InputError: if the unit of a cloud is in doubt.
    """
    from scipy import ndimage

    times = np.zeros(np.round(2 * AROUND / VOXEL).astype(int), np.int8)
    xyz, cells, sizes = [], [], []
    for cloud in clouds:
        placed = cloud.xyz[cloud.is_placed]
        frame = find_frame(placed, sensor)
        level = frame.complete(sensor).to_level(placed)
        is_seen = (np.abs(level) < AROUND).all(axis=1)
        if frame.height is not None:
            is_seen &= level[:, 2] > OVER_GROUND - frame.height

        cell = ((level[is_seen] + AROUND) / VOXEL).astype(int)
        is_occupied = np.zeros(times.shape, bool)
        is_occupied[tuple(cell.T)] = True
        times += is_occupied
        sizes.append(np.count_nonzero(is_occupied))
        xyz.append(placed[is_seen] * UNITS[frame.unit])
        cells.append(cell)
    if len(clouds) < LEAST_SCANS:
        return None

    stays = times >= STAYS * len(clouds)
    middle = len(times) // 2
    reach = slice(middle - round(REACH / VOXEL), middle + round(REACH / VOXEL))
    near = np.zeros_like(stays)
    near[reach, reach] = stays[reach, reach]
    if np.count_nonzero(stays & ~near) > MAX_STILL * np.median(sizes):
        return None

    # A wall along the way stays, too, but it goes on beyond the reach of the body.
    parts, _ = ndimage.label(near, np.ones((3, 3, 3)))
    inner = parts[reach, reach]
    beyond = np.concatenate([inner[[0, -1]].ravel(), inner[:, [0, -1]].ravel()])
    is_own = near & ~np.isin(parts, beyond)

    points = np.concatenate(xyz)
    own = points[is_own[tuple(np.concatenate(cells).T)]]
    total = sum(len(cloud.xyz) for cloud in clouds)
    if len(own) < LEAST_SHARE * total:
        return None
    # Rounded outward to decimetres; adding 0 makes -0 a 0.
    low = np.floor(own.min(axis=0).astype(np.float64) * 10) / 10 + 0
    high = np.ceil(own.max(axis=0).astype(np.float64) * 10) / 10 + 0
    box = (*low.tolist(), *high.tolist())
    return Body(box, np.count_nonzero(is_inside(points, box)) / total)
