"""Which pulses of a LiDAR return, at which range, and how bright."""

import numpy as np

from lidarstreets.materials import REFLECTIONS, Label
from lidarstreets.sensing.lidar import Hits
from lidarstreets.sensing.sensors import LidarModel

# Power of a return, relative to a head-on one at 10 m, at which the device reports half of the
# reflectivity.
HALF_POWER = 0.007
# Metres: smallest and largest step in depth within which one pulse gives one return in between.
SMALLEST_MIXED_STEP = 0.3
LARGEST_MIXED_STEP = 3.0
# Spread of the size of the relief from place to place: standard deviation of its logarithm.
RELIEF_SPREAD = 0.65
# Metres: smallest and mean distance by which a ghost, a mirrored body, lies behind the mirror.
GHOST_NEAREST = 0.5
GHOST_MEAN = 6.0
NEIGHBOUR_ANGLE = 0.5  # degrees between neighbouring shots of one laser, at most


def laser_gains(sensor: LidarModel, rng: np.random.Generator) -> np.ndarray:
    """Draw the factors by which the lasers of one device differ in brightness.

    Returns:
        (L,) factors from the lowest laser up; a few are far from 1.
    """
    gains = 1 + sensor.gain_spread * rng.standard_t(3, len(sensor.elevations))
    return np.clip(gains, 0.3, 1.3)


def receive(
    hits: Hits, sensor: LidarModel, gains: np.ndarray, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the points that the sensor measures, with noise, intensity and lost returns.

    Returns:
        (N, 4) float32 x, y, z, intensity; (N,) uint32 class ids with the instance in the upper
        half; (N,) uint8 rings.
    """
    base, spread, shade, dark, drop, relief, ghost = REFLECTIONS[hits.surface].T
    count = len(hits.distance)
    reflectivity = base * np.exp(shade * hits.tint)

    # The received power falls with the square of the range; a return is lost if noise covers it.
    reach = sensor.reach * np.sqrt(reflectivity * np.maximum(hits.cosine, 1e-3))
    chance = 1 / (1 + (hits.distance / reach) ** 6) * (1 - drop) * (1 - sensor.drop)

    distance = _measured_distance(hits, sensor, relief, rng)
    is_ghost = rng.random(count, np.float32) < ghost
    beyond = GHOST_NEAREST + GHOST_MEAN * rng.standard_exponential(is_ghost.sum())
    distance[is_ghost] += beyond.astype(np.float32)
    chance[(distance < sensor.min_range) | (distance > sensor.max_range)] = 0

    # The device compensates for range and incidence until the power is too small.
    power = hits.cosine * (10 / np.maximum(hits.distance, 1)) ** 2
    noise = np.maximum(1 + spread * rng.standard_normal(count, np.float32), 0) ** (1 / sensor.gamma)
    brightness = reflectivity * power / (power + HALF_POWER) * noise * gains[hits.ring]
    brightness[rng.random(count, np.float32) < dark] = 0
    intensity = np.round(sensor.gain * brightness**sensor.gamma, sensor.decimals)
    intensity = np.clip(intensity, 0, 0.99)

    xyz = hits.direction * distance[:, None]
    if sensor.motion_corrected:
        xyz = xyz + hits.shift

    returned = rng.random(count, np.float32) < chance
    points = np.column_stack([xyz, intensity])[returned].astype(np.float32)
    instances = np.where(is_ghost, 0, hits.instance)[returned].astype(np.uint32)
    classes = np.where(is_ghost, np.uint16(Label.OUTLIER), hits.label)[returned].astype(np.uint32)
    labels = classes | instances << np.uint32(16)
    rings = hits.ring[returned]
    if not sensor.keeps_lost_returns:
        return points, labels, rings

    lost_points, lost_rings = _lost_returns(sensor, rings, rng)
    lost_labels = np.zeros(len(lost_points), dtype=np.uint32)

    return (
        np.concatenate([points, lost_points]),
        np.concatenate([labels, lost_labels]),
        np.concatenate([rings, lost_rings]),
    )


def _measured_distance(
    hits: Hits, sensor: LidarModel, relief: np.ndarray, rng: np.random.Generator
) -> np.ndarray:
    """Return (N,) distances with the relief of the surfaces, mixed returns and range noise."""
    count = len(hits.distance)
    rise = rng.standard_exponential(count, np.float32)
    fall = rng.standard_exponential(count, np.float32)
    mixed = _mixed_distance(hits, sensor, rng)
    noise = rng.standard_normal(count, np.float32)
    size = relief * np.exp(RELIEF_SPREAD * rng.standard_normal(count, np.float32))
    return mixed + size * (rise - fall) + sensor.range_noise * noise


def _mixed_distance(hits: Hits, sensor: LidarModel, rng: np.random.Generator) -> np.ndarray:
    """Return (N,) distances, some of which lie between the two surfaces of a depth edge.

    A beam is as wide as the angle to the next one, and so hits both.
    """
    step = np.diff(hits.distance, append=hits.distance[-1:])
    next_direction = np.roll(hits.direction, -1, axis=0)
    cosine = (hits.direction * next_direction).sum(axis=1)
    are_neighbours = cosine > np.cos(np.radians(NEIGHBOUR_ANGLE))
    are_neighbours &= hits.ring == np.roll(hits.ring, -1)

    depth = np.abs(step)
    at_edge = are_neighbours & (depth > SMALLEST_MIXED_STEP) & (depth < LARGEST_MIXED_STEP)
    is_mixed = at_edge & (rng.random(len(step)) < sensor.mixed)
    return hits.distance + np.where(is_mixed, rng.random(len(step)) * step, 0)


def _lost_returns(
    sensor: LidarModel, rings: np.ndarray, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """Return points and rings for the shots that are missing in `rings`, as nuScenes has them.

    They lie within a metre of the sensor, most of them behind it on the left.
    """
    missing = sensor.azimuth_steps - np.bincount(rings, minlength=len(sensor.elevations))
    lost_rings = np.repeat(np.arange(len(missing), dtype=np.uint8), missing)
    count = len(lost_rings)

    in_cluster = rng.random(count) < 0.65
    cluster_azimuth = rng.normal(np.radians(165), 0.15, count)
    azimuth = np.where(in_cluster, cluster_azimuth, rng.uniform(-np.pi, np.pi, count))
    distance = np.minimum(rng.exponential(0.25, count), 0.99)
    cluster_elevation = rng.normal(-0.04, 0.03, count)
    elevation = np.where(in_cluster, cluster_elevation, rng.normal(-0.3, 0.3, count))
    intensity = np.where(rng.random(count) < 0.1, 0.2, 0.008)

    horizontal = np.cos(elevation)
    x = horizontal * np.cos(azimuth)
    y = horizontal * np.sin(azimuth)
    direction = np.stack([x, y, np.sin(elevation)], axis=1)
    points = np.column_stack([distance[:, None] * direction, intensity])
    return points.astype(np.float32), lost_rings
