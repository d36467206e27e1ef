"""Which pulses of a LiDAR return, at which range, and how bright."""

from dataclasses import dataclass

import numpy as np
from scipy.special import expit, ndtr

from lidarstreets.chance import patchy_normal
from lidarstreets.materials import REFLECTIONS, Label
from lidarstreets.sensing.lidar import Hits
from lidarstreets.sensing.sensors import LidarModel

# How the brightness falls with the range, as a power of it; see `LidarModel.half_range`.
FADING = 3.0
# Metres within which a surface is near to a laser that is focused far away.
NEAR = 9.0
# Brightness from where returns are recorded as 0 to where they are not: the scale of a logistic.
BRIGHTNESS_STEP = 0.02
# Metres: smallest and largest step in depth within which one pulse gives one return in between.
SMALLEST_MIXED_STEP = 0.3
LARGEST_MIXED_STEP = 20.0
# Neighbouring returns are alike: metres within which they are, and their correlation, for loss and
# glare, for the height of relief such as tufts of grass, and for the mean height of relief.
PATCH = (0.5, 0.97)
TUFT = (0.3, 0.85)
MEADOW = (8.0, 0.8)
# Spread of the mean height of relief: standard deviation of its logarithm.
RELIEF_SPREAD = 0.8
LEAST_COSINE = 0.06  # of the angle between ray and normal: relief is no deeper along the ray
LEAST_NOISE = 0.4  # of the mean brightness of a surface
LOW_LASERS_LEAST = 0.35  # of the least brightness: the lower half of the lasers sees darker things
# Metres: smallest and mean distance by which a ghost, a mirrored body, lies behind the mirror.
GHOST_NEAREST = 0.5
GHOST_MEAN = 6.0
OWN_LASERS = 8  # the lowest lasers, which see racks and other parts of the car itself
OWN_REACH = 2.0  # metres to the farthest of these parts
DARK_SHARE = 0.35  # of the reflectivity, at most, that a dark return has
NEIGHBOUR_ANGLE = 0.5  # degrees between neighbouring shots of one laser, at most


@dataclass(frozen=True)
class Lasers:
    """How the lasers of one device differ; rows go from the lowest laser up.

    Attributes:
        gain: (L,) factors on the intensity; a few are far from 1.
        near_loss: (L,) shares of the brightness of near surfaces that are lost.
        range_error: (L,) metres by which each laser measures too far.
        least_brightness: (L,) as in `LidarModel`, which has that of the upper half.
    """

    gain: np.ndarray
    near_loss: np.ndarray
    range_error: np.ndarray
    least_brightness: np.ndarray


def draw_lasers(sensor: LidarModel, rng: np.random.Generator) -> Lasers:
    """Draw the lasers of one device."""
    count = len(sensor.elevations)
    gain = 1 + sensor.gain_spread * rng.standard_t(3, count)

    # The mean of this beta distribution is a third.
    near_loss = 3 * sensor.near_loss * rng.beta(1, 2, count)
    near_loss[: count // 2] = 0
    range_error = (sensor.range_error * rng.standard_normal(count)).astype(np.float32)
    least_brightness = np.full(count, sensor.least_brightness)
    least_brightness[: count // 2] *= LOW_LASERS_LEAST
    return Lasers(np.clip(gain, 0.3, 1.3), near_loss, range_error, least_brightness)


def receive(
    hits: Hits, sensor: LidarModel, lasers: Lasers, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the points that the sensor measures, with noise, intensity and lost returns.

    Returns:
        (N, 4) float32 x, y, z, intensity; (N,) uint32 class ids with the instance in the upper
        half; (N,) uint8 rings.
    """
    base, _, shade, _, drop, relief, ghost = REFLECTIONS[hits.surface].T
    reflectivity = base * np.exp(shade * hits.tint)

    # The received power falls with the square of the range; a return is lost if noise covers it.
    reach = sensor.reach * np.sqrt(reflectivity * np.maximum(hits.cosine, 1e-3))
    chance = 1 / (1 + (hits.distance / reach) ** 6) * (1 - drop) * (1 - sensor.drop)

    distance = _measured_distance(hits, sensor, relief, rng) + lasers.range_error[hits.ring]
    is_ghost = rng.random(len(ghost), np.float32) < ghost
    beyond = GHOST_NEAREST + GHOST_MEAN * rng.standard_exponential(is_ghost.sum())
    distance[is_ghost] += beyond.astype(np.float32)
    chance[(distance < sensor.min_range) | (distance > sensor.max_range)] = 0

    intensity = _intensity(hits, reflectivity, sensor, lasers, rng)

    # Parts of the car itself are too near and too glossy to be bright.
    is_own = _hits_own_car(hits, sensor, rng)
    distance[is_own] = rng.uniform(sensor.min_range, OWN_REACH, is_own.sum())
    intensity[is_own] = 0
    chance[is_own] = 1

    xyz = hits.direction * distance[:, None]
    xyz[:, 2] += hits.height
    if sensor.motion_corrected:
        xyz = xyz + hits.shift

    returned = _patchy(hits, rng) < chance
    points = np.column_stack([xyz, intensity])[returned].astype(np.float32)
    has_no_class = is_ghost | is_own
    instances = np.where(has_no_class, 0, hits.instance).astype(np.uint32)
    classes = np.where(has_no_class, Label.OUTLIER, hits.label).astype(np.uint32)
    labels = (classes | instances << np.uint32(16))[returned]
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


def _intensity(
    hits: Hits,
    reflectivity: np.ndarray,
    sensor: LidarModel,
    lasers: Lasers,
    rng: np.random.Generator,
) -> np.ndarray:
    """Return the (N,) intensities in [0, 0.99] that the device reports."""
    _, spread, _, dark, *_ = REFLECTIONS[hits.surface].T

    # The device compensates for range and incidence until the power is too small.
    power = hits.cosine * (10 / np.maximum(hits.distance, 1)) ** 2
    is_near = np.exp(-((hits.distance / NEAR) ** 4))
    # Few returns are far from the mean, but more than with a normal distribution.
    deviation = sensor.intensity_noise * spread * rng.standard_t(3, len(spread))
    noise = np.maximum(1 + deviation, LEAST_NOISE) ** (1 / sensor.gamma)

    brightness = reflectivity * noise * power**2 / (power**2 + sensor.half_power**2)
    brightness /= 1 + (hits.distance / sensor.half_range) ** FADING
    brightness *= np.interp(hits.distance, *np.transpose(sensor.response))
    brightness *= 1 - lasers.near_loss[hits.ring] * is_near

    darkness = _patchy(hits, rng) / np.maximum(dark, 1e-6)
    brightness *= np.where(darkness < 1, DARK_SHARE * darkness, 1)

    # Weak pulses return, but the device does not tell how bright they were.
    if sensor.least_brightness:
        excess = (brightness - lasers.least_brightness[hits.ring]) / BRIGHTNESS_STEP
        brightness[_patchy(hits, rng) > expit(excess)] = 0

    brightness *= lasers.gain[hits.ring]
    intensity = np.round(sensor.gain * brightness**sensor.gamma, sensor.decimals)
    return np.clip(intensity, 0, 0.99)


def _patchy(hits: Hits, rng: np.random.Generator) -> np.ndarray:
    """Return (N,) uniform random numbers that are alike for neighbouring hits."""
    return ndtr(patchy_normal(rng, hits.places, *PATCH))


def _hits_own_car(hits: Hits, sensor: LidarModel, rng: np.random.Generator) -> np.ndarray:
    """Return whether each pulse ends at the car itself: (N,) bool."""
    could_hit = np.flatnonzero(hits.ring < OWN_LASERS)
    count = min(rng.poisson(sensor.own_returns), len(could_hit))
    is_own = np.zeros(len(hits.ring), dtype=bool)
    is_own[rng.choice(could_hit, count, replace=False)] = True
    return is_own


def _measured_distance(
    hits: Hits, sensor: LidarModel, relief: np.ndarray, rng: np.random.Generator
) -> np.ndarray:
    """Return (N,) distances with the relief of the surfaces, mixed returns and range noise."""
    count = len(hits.distance)
    height = patchy_normal(rng, hits.places, *TUFT)
    mixed = _mixed_distance(hits, sensor, rng)
    noise = rng.standard_normal(count, np.float32)
    height *= relief * np.exp(RELIEF_SPREAD * patchy_normal(rng, hits.places, *MEADOW))
    depth = height / np.maximum(hits.facing, LEAST_COSINE)
    return mixed + depth + sensor.range_noise * noise


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
