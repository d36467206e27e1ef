"""Which of a LiDAR's pulses come back, from where, and how bright."""

from __future__ import annotations

from functools import partial

import numpy as np

from amvnet.simulation.lidar import Hits
from amvnet.simulation.materials import reflection_table
from amvnet.simulation.sensors import Sensor

HALF_POWER = 0.007  # of a head-on return at 10 m: where the device reports half of the reflectivity
MIXED_FROM, MIXED_TO = (
    0.3,
    3.0,
)  # metres: steps in depth within which one pulse gives one return in between


def laser_gains(sensor: Sensor, rng: np.random.Generator) -> np.ndarray:
    """Factors of the brightness, laser by laser from the lowest, of one device. A few lasers are far off. (L,)."""
    return np.clip(1 + sensor.gain_spread * rng.standard_t(3, len(sensor.elevations)), 0.3, 1.3)


def receive(
    hits: Hits, sensor: Sensor, gains: np.ndarray, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The points and labels that come back from the hits: noise, brightness, lost returns.

    Args:
        hits: what the shots of one turn hit.
        sensor: what fired them.
        gains: (L,) as from `laser_gains`.
        rng: where all chance comes from.

    Returns:
        (N, 4) float32 x, y, z, intensity, (N,) uint32 class ids with the instance in the upper half, and (N,)
        uint8 rings.
    """
    base, spread, shade, dark, drop, rough = reflection_table()[hits.surface].T
    count = len(hits.distance)
    normal, uniform = (
        partial(rng.standard_normal, count, np.float32),
        partial(rng.random, count, np.float32),
    )
    reflectivity = base * np.exp(shade * hits.tint)
    # The received power falls with the square of the range; the return is lost where it drowns in noise.
    reach = sensor.reach * np.sqrt(reflectivity * np.maximum(hits.cosine, 1e-3))
    kept = 1 / (1 + (hits.distance / reach) ** 6) * (1 - drop) * (1 - sensor.drop)
    relief = rough * (
        rng.standard_exponential(count, np.float32) - rng.standard_exponential(count, np.float32)
    )
    distance = _mixed(hits, sensor, rng) + relief + sensor.range_noise * normal()
    kept[(distance < sensor.min_range) | (distance > sensor.max_range)] = 0
    # The device evens out range and incidence, until there is too little to even out.
    power = hits.cosine * (10 / np.maximum(hits.distance, 1)) ** 2
    noise = np.maximum(1 + spread * normal(), 0) ** (1 / sensor.gamma)
    bright = reflectivity * power / (power + HALF_POWER) * noise * gains[hits.ring]
    bright[uniform() < dark] = 0
    intensity = np.clip(np.round(sensor.gain * bright**sensor.gamma, sensor.decimals), 0, 0.99)
    back = uniform() < kept
    xyz = hits.direction * distance[:, None] + (hits.shift if sensor.corrected else 0)
    points = np.column_stack([xyz, intensity])[back].astype(np.float32)
    label = hits.label[back].astype(np.uint32) | hits.instance[back].astype(np.uint32) << np.uint32(
        16
    )
    if not sensor.keeps_lost:
        return points, label, hits.ring[back]
    lost, rings = _lost(sensor, hits.ring[back], rng)
    zeros = np.zeros(len(lost), dtype=np.uint32)
    return (
        np.concatenate([points, lost]),
        np.concatenate([label, zeros]),
        np.concatenate([hits.ring[back], rings]),
    )


def _lost(
    sensor: Sensor, back: np.ndarray, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """The rows that nuScenes has for shots without a return: near the sensor, most of them behind its left side."""
    missing = sensor.azimuth_steps - np.bincount(back, minlength=len(sensor.elevations))
    ring = np.repeat(np.arange(len(missing), dtype=np.uint8), missing)
    one_side = rng.random(len(ring)) < 0.65
    azimuth = np.where(
        one_side,
        rng.normal(np.radians(165), 0.15, len(ring)),
        rng.uniform(-np.pi, np.pi, len(ring)),
    )
    distance = np.minimum(rng.exponential(0.25, len(ring)), 0.99)
    elevation = np.where(
        one_side, rng.normal(-0.04, 0.03, len(ring)), rng.normal(-0.3, 0.3, len(ring))
    )
    level = np.cos(elevation)
    direction = np.stack(
        [level * np.cos(azimuth), level * np.sin(azimuth), np.sin(elevation)], axis=1
    )
    bright = np.where(rng.random(len(ring)) < 0.1, 0.2, 0.008)
    return np.column_stack([distance[:, None] * direction, bright]).astype(np.float32), ring


def _mixed(hits: Hits, sensor: Sensor, rng: np.random.Generator) -> np.ndarray:
    """(N,) distances, of which some at edges lie between both surfaces: a beam is as wide as the step to the next."""
    step = np.diff(hits.distance, append=hits.distance[-1:])
    neighbours = (hits.direction * np.roll(hits.direction, -1, axis=0)).sum(axis=1) > np.cos(
        np.radians(0.5)
    )
    neighbours &= hits.ring == np.roll(hits.ring, -1)
    edge = (
        neighbours
        & (np.abs(step) > MIXED_FROM)
        & (np.abs(step) < MIXED_TO)
        & (rng.random(len(step)) < sensor.mixed)
    )
    return hits.distance + np.where(edge, rng.random(len(step)) * step, 0)
