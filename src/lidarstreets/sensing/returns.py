"""Decide which pulses of a LiDAR return, at which range, and how bright."""

from dataclasses import dataclass, fields
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy.special import expit, ndtr

from lidarstreets.chance import patchy_normal
from lidarstreets.materials import REFLECTIONS, Label, Reflection, Surface
from lidarstreets.sensing.lidar import Hits, rays_of
from lidarstreets.sensing.sensors import LidarModel

# Power of the range with which the brightness falls; see `LidarModel.half_range`.
FADING_POWER = 3.0
# Range within which lasers that are focused far away lose brightness, metres.
NEAR_RANGE = 9.0
# Scale of the logistic curve that decides, by its brightness, whether a return is reported as 0.
BRIGHTNESS_STEP = 0.02
# Smallest and largest step in depth across which one pulse can return from in between, metres.
MIN_MIXED_STEP = 0.3
MAX_MIXED_STEP = 20.0
# Arguments of `patchy_normal`, patch in metres and correlation: for loss and glare, for the height
# of relief such as tufts of grass, and for the mean height of relief.
LOSS_PATCH = (0.5, 0.97)
RELIEF_PATCH = (0.3, 0.85)
MEAN_RELIEF_PATCH = (8.0, 0.8)
# Standard deviation of the logarithm of the mean height of relief.
RELIEF_SPREAD = 0.8
# Smallest cosine of the angle between ray and normal; it limits the depth of relief along the ray.
MIN_COSINE = 0.06
# Smallest factor that noise puts on the brightness of a surface.
MIN_NOISE_FACTOR = 0.4
# Factor on the least brightness for the lower half of the lasers, which see darker surfaces.
LOW_LASERS_FACTOR = 0.35
# Smallest and mean distance of a ghost, a mirrored body, behind the mirror, metres.
GHOST_MIN_DISTANCE = 0.5
GHOST_MEAN_DISTANCE = 6.0
OWN_CAR_LASERS = 8  # number of the lowest lasers, which see racks and other parts of the car
OWN_CAR_REACH = 2.0  # range of the farthest part of the car, metres
# Share of the points within the car that have its class: enough to learn it from, and too few to
# change the class weights.
OWN_LABELLED = 0.1
ROOF_INTENSITY = 0.08  # median intensity of the roof
ROOF_RELIEF = 0.02  # standard deviation of the depth of the roof, metres
ROOF_STEEPNESS = 0.15  # smallest sine of the angle below the horizon of a shot that hits the roof
DARK_FACTOR = 0.35  # largest factor on the intensity of a dark return
MAX_NEIGHBOUR_ANGLE = 0.5  # largest angle between neighbouring shots of one laser, degrees


_COLUMNS = [field.name for field in fields(Reflection)]
# Columns of `REFLECTIONS` that `LidarModel.surfaces` multiplies.
_FACTOR_COLUMNS = [_COLUMNS.index(name) for name in ("reflectivity", "spread", "shade", "rough")]


@dataclass(frozen=True)
class Lasers:
    """How the L lasers of one device differ. The first row is the lowest laser.

    Attributes:
        gain: (L,) factors on the intensity, 0.3 to 1.3; a few are far from 1.
        near_loss: (L,) shares of the brightness of near surfaces that are lost.
        range_error: (L,) float32 distances by which each laser measures too far, metres.
        least_brightness: (L,) least brightness, as in `LidarModel`, of each laser.
    """

    gain: np.ndarray
    near_loss: np.ndarray
    range_error: np.ndarray
    least_brightness: np.ndarray


def draw_lasers(sensor: LidarModel, rng: np.random.Generator) -> Lasers:
    """Draw how the lasers of one device differ."""
    count = len(sensor.elevations)
    gain = 1 + sensor.gain_spread * rng.standard_t(3, count)

    # The mean of this beta distribution is 1 / 3.
    near_loss = 3 * sensor.near_loss * rng.beta(1, 2, count)
    near_loss[: count // 2] = 0
    range_error = (sensor.range_error * rng.standard_normal(count)).astype(np.float32)
    least_brightness = np.full(count, sensor.least_brightness)
    least_brightness[: count // 2] *= LOW_LASERS_FACTOR
    return Lasers(np.clip(gain, 0.3, 1.3), near_loss, range_error, least_brightness)


def receive(
    hits: Hits, sensor: LidarModel, lasers: Lasers, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the points that the sensor measures, with noise, intensity and lost returns.

    Returns:
        (N, 4) float32 x, y, z in metres and intensity in [0, 0.99]; (N,) uint32 class ids with the
        instance ids in the upper 16 bits; (N,) uint8 indices of the lasers.
    """
    base, _, shade, _, drop, relief, ghost = _reflections(sensor.surfaces)[hits.surface].T
    reflectivity = base * np.exp(shade * hits.tint)

    # The received power falls with the square of the range. A return below the noise is lost.
    reach = sensor.reach * np.sqrt(reflectivity * np.maximum(hits.cosine, 1e-3))
    chance = 1 / (1 + (hits.distance / reach) ** 6) * (1 - drop) * (1 - sensor.drop)

    distance = _measured_distance(hits, sensor, relief, rng) + lasers.range_error[hits.ring]
    is_ghost = rng.random(len(ghost), np.float32) < ghost
    beyond = GHOST_MIN_DISTANCE + GHOST_MEAN_DISTANCE * rng.standard_exponential(is_ghost.sum())
    distance[is_ghost] += beyond.astype(np.float32)
    chance[(distance < sensor.min_range) | (distance > sensor.max_range)] = 0

    intensity = _intensity(hits, reflectivity, sensor, lasers, rng)

    # Parts of the car itself are too near and too glossy to be bright.
    is_own = _hits_own_car(hits, sensor, rng)
    distance[is_own] = rng.uniform(sensor.min_range, OWN_CAR_REACH, is_own.sum())
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

    roof_points, roof_labels, roof_rings = _roof_returns(sensor, rng)
    rings = np.concatenate([rings, roof_rings])
    lost_points, lost_rings = _lost_returns(sensor, rings, rng)
    lost_labels = _own_labels(len(lost_points), rng)

    return (
        np.concatenate([points, roof_points, lost_points]),
        np.concatenate([labels, roof_labels, lost_labels]),
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
    _, spread, _, dark, *_ = _reflections(sensor.surfaces)[hits.surface].T

    # The device compensates for range and angle of incidence until the power is too small.
    power = hits.cosine * (10 / np.maximum(hits.distance, 1)) ** 2
    is_near = np.exp(-((hits.distance / NEAR_RANGE) ** 4))
    # Few returns are far from the mean, but more of them than in a normal distribution.
    deviation = sensor.intensity_noise * spread * rng.standard_t(3, len(spread))
    noise = np.maximum(1 + deviation, MIN_NOISE_FACTOR) ** (1 / sensor.gamma)

    brightness = reflectivity * noise * power**2 / (power**2 + sensor.half_power**2)
    brightness /= 1 + (hits.distance / sensor.half_range) ** FADING_POWER
    brightness *= np.interp(hits.distance, *np.transpose(sensor.response))
    brightness *= 1 - lasers.near_loss[hits.ring] * is_near

    # Like the noise, darkness is a factor on the intensity.
    darkness = _patchy(hits, rng) / np.maximum(dark, 1e-6)
    brightness *= np.where(darkness < 1, DARK_FACTOR * darkness, 1) ** (1 / sensor.gamma)

    # The device reports weak returns, but not how bright they were.
    if sensor.least_brightness:
        excess = (brightness - lasers.least_brightness[hits.ring]) / BRIGHTNESS_STEP
        brightness[_patchy(hits, rng) > expit(excess)] = 0

    brightness *= lasers.gain[hits.ring]
    intensity = np.round(sensor.gain * brightness**sensor.gamma, sensor.decimals)
    clipped: NDArray[np.float64] = np.clip(intensity, 0, 0.99)
    return clipped


@lru_cache(maxsize=4)
def _reflections(surfaces: tuple[tuple[str, float, float, float, float], ...]) -> np.ndarray:
    """Return `REFLECTIONS` with the factors of `LidarModel.surfaces`; the array is shared."""
    table = REFLECTIONS.copy()
    for name, *factors in surfaces:
        table[Surface[name], _FACTOR_COLUMNS] *= factors
    table.flags.writeable = False
    return table


def _patchy(hits: Hits, rng: np.random.Generator) -> np.ndarray:
    """Return (N,) uniform random numbers that are alike for neighbouring hits."""
    return ndtr(patchy_normal(rng, hits.places, *LOSS_PATCH))


def _hits_own_car(hits: Hits, sensor: LidarModel, rng: np.random.Generator) -> np.ndarray:
    """Return whether each pulse ends at the car itself: (N,) bool."""
    could_hit = np.flatnonzero(hits.ring < OWN_CAR_LASERS)
    count = min(rng.poisson(sensor.own_returns), len(could_hit))
    is_own = np.zeros(len(hits.ring), dtype=bool)
    is_own[rng.choice(could_hit, count, replace=False)] = True
    return is_own


def _measured_distance(
    hits: Hits, sensor: LidarModel, relief: np.ndarray, rng: np.random.Generator
) -> np.ndarray:
    """Return the (N,) distances in metres, with relief, mixed returns and range noise."""
    count = len(hits.distance)
    height = patchy_normal(rng, hits.places, *RELIEF_PATCH)
    mixed = _mixed_distance(hits, sensor, rng)
    noise = rng.standard_normal(count, np.float32)
    height *= relief * np.exp(RELIEF_SPREAD * patchy_normal(rng, hits.places, *MEAN_RELIEF_PATCH))
    depth = height / np.maximum(hits.facing, MIN_COSINE)
    measured: NDArray[np.float64] = mixed + depth + sensor.range_noise * noise
    return measured


def _mixed_distance(hits: Hits, sensor: LidarModel, rng: np.random.Generator) -> np.ndarray:
    """Return the (N,) distances in metres, where some at depth edges lie between both surfaces.

    A beam is as wide as the angle to the next beam, so that it hits both surfaces.
    """
    step = np.diff(hits.distance, append=hits.distance[-1:])
    next_direction = np.roll(hits.direction, -1, axis=0)
    cosine = (hits.direction * next_direction).sum(axis=1)
    are_neighbours = cosine > np.cos(np.radians(MAX_NEIGHBOUR_ANGLE))
    are_neighbours &= hits.ring == np.roll(hits.ring, -1)

    depth = np.abs(step)
    at_edge = are_neighbours & (depth > MIN_MIXED_STEP) & (depth < MAX_MIXED_STEP)
    is_mixed = at_edge & (rng.random(len(step)) < sensor.mixed)
    return hits.distance + np.where(is_mixed, rng.random(len(step)) * step, 0)


def _roof_returns(
    sensor: LidarModel, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the points, labels and lasers of the shots that the car blocks, as `receive` does."""
    rays = rays_of(sensor, blocked=True)
    down = np.flatnonzero((rays.direction[:, 2] < -ROOF_STEEPNESS) & (sensor.roof > 0))
    count = len(down)

    depth = sensor.roof + ROOF_RELIEF * rng.standard_normal(count)
    direction = rays.direction[down]
    intensity = np.minimum(ROOF_INTENSITY * rng.lognormal(0, 1, count), 0.4)
    points = np.column_stack([direction * (depth / -direction[:, 2])[:, None], intensity])
    return points.astype(np.float32), _own_labels(count, rng), rays.ring[down]


def _own_labels(count: int, rng: np.random.Generator) -> np.ndarray:
    """Return the (count,) uint32 labels of points within the car: cars, or no class."""
    return np.where(rng.random(count) < OWN_LABELLED, np.uint32(Label.CAR), np.uint32(0))


def _lost_returns(
    sensor: LidarModel, rings: np.ndarray, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """Return a point and a laser for each shot that is missing in `rings`, like nuScenes.

    The points lie within a metre of the sensor; most lie behind it on the left.
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
