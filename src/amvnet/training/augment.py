"""Augment training scans (section 3.1 of the paper), and the scores that the head learns from."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from amvnet.config.schema import AugmentConfig
from amvnet.scan import Scan, yaw_rotation

ELEVATION_BINS = 64  # number of bins that replace the lasers of a scan without ring indices
OUTLIERS = 0.5  # share of the points below the lowest bin, and above the highest bin, percent

LARGEST_LASER_DROP = 0.5  # largest share of the lasers that is dropped at random
MAX_BLOCKS = 4  # largest number of blocks that are dropped from a scan
BLOCK_WIDTH = (5.0, 40.0)  # least and greatest width of a block, degrees of azimuth
BLOCK_HEIGHT = (3.0, 12.0)  # least and greatest height of a block, degrees of elevation
BANDS = (3, 6)  # fewest and most bands of elevation in mixed scans, as in LaserMix
TURNS = (1, 2)  # fewest and most turned copies of pasted objects

HIGHEST_TEMPERATURE = 3.0  # highest temperature of the softmax
CONFUSION_CHANCE = 0.25  # probability that a class is confused with another class
LARGEST_LEAK = 0.8  # largest share of a confused class's probability that the other class gets
WAVES = (0.5, 3.0)  # fewest and most waves of the confusion, around the sensor and along a range
WAVE_RANGE = 20.0  # the range along which these waves are counted, metres


def augment(scan: Scan, config: AugmentConfig, rng: np.random.Generator) -> Scan:
    """Return a randomly changed copy of a scan. The same state of `rng` gives the same copy.

    Points are dropped, scaled, mirrored, jittered, rotated about the vertical, lifted and tilted.
    Intensities are scaled, distorted, shifted, or all set to zero.
    """
    # Keep the order of the random draws, because it decides which scan a seed gives.
    if config.no_lasers and rng.random() < config.no_lasers:
        scan = dataclasses.replace(scan, ring=None)
    if config.laser_drop and rng.random() < config.laser_drop:
        scan = _drop_lasers(scan, rng)
    if config.block_drop and rng.random() < config.block_drop:
        scan = _drop_blocks(scan, rng)
    if config.drop:
        scan = _keep(scan, rng.random(len(scan)) >= rng.uniform(0, config.drop))

    xyz = scan.points[:, :3] * (1 + rng.uniform(-config.scale, config.scale))
    mirrored = rng.random(2) < config.flip
    xyz[:, :2] *= np.where(mirrored, -1, 1)
    if config.jitter:
        xyz += rng.standard_normal(xyz.shape, dtype=np.float32) * config.jitter

    yaw = np.radians(rng.uniform(-config.yaw, config.yaw))
    xyz[:, :2] = xyz[:, :2] @ yaw_rotation(yaw).T
    xyz[:, 2] += rng.uniform(-config.height, config.height)
    if config.tilt:
        roll, pitch = np.radians(rng.uniform(-config.tilt, config.tilt, 2))
        xyz = xyz @ tilt_rotation(roll, pitch).T

    intensity = np.minimum(scan.points[:, 3] * _intensity_gain(config, rng), 1)
    # A scan without intensities stays without them.
    if intensity.any():
        intensity = _distort_intensity(intensity, scan, config, rng)
    points = np.column_stack([xyz, intensity]).astype(np.float32)
    return dataclasses.replace(scan, points=points)


def mix(scan: Scan, other: Scan, rng: np.random.Generator) -> Scan:
    """Replace a sector of a scan with the same sector of another scan (Xiao et al., 2022).

    The sector spans a quarter to three quarters of the circle. If the result would have no point,
    the scan is returned unchanged.
    """
    start = rng.uniform(-np.pi, np.pi)
    width = rng.uniform(0.5, 1.5) * np.pi

    outside = scan.select(~_in_sector(scan, start, width))
    inside = other.select(_in_sector(other, start, width))
    mixed = _join(outside, inside)
    return mixed if len(mixed) else scan


def mix_lasers(scan: Scan, other: Scan, rng: np.random.Generator) -> Scan:
    """Replace every second band of elevation with the same band of another scan.

    The bands have the same height and cover both scans. If the result would have no point, the scan
    is returned unchanged. This is LaserMix (Kong et al., 2023).
    """
    bands = int(rng.integers(BANDS[0], BANDS[1] + 1))
    first = int(rng.integers(2))

    elevation = _elevations(scan)
    other_elevation = _elevations(other)
    lowest, highest = _spread(np.concatenate([elevation, other_elevation]))
    borders = np.linspace(lowest, highest, bands + 1)[1:-1]

    rows = np.searchsorted(borders, elevation, side="right")
    other_rows = np.searchsorted(borders, other_elevation, side="right")
    mixed = _join(scan.select(rows % 2 == first), other.select(other_rows % 2 != first))
    return mixed if len(mixed) else scan


def paste(scan: Scan, other: Scan, classes: Sequence[int], rng: np.random.Generator) -> Scan:
    """Add the points of some classes (train ids) of another scan (Xiao et al., 2022).

    The points are added at their place, and once or twice more after a rotation by a random yaw.
    Points behind them stay in the scan.
    """
    assert other.labels is not None
    objects = other.select(np.isin(other.labels, classes) & other.valid)
    copies = [objects]
    for yaw in rng.uniform(-np.pi, np.pi, rng.integers(TURNS[0], TURNS[1] + 1)):
        points = objects.points.copy()
        points[:, :2] = points[:, :2] @ yaw_rotation(yaw).T
        copies.append(dataclasses.replace(objects, points=points))

    for copy in copies:
        scan = _join(scan, copy)
    return scan


def disturb(scores: Tensor, points: Tensor, rng: np.random.Generator) -> Tensor:
    """Make the scores (P, K) of one network for a scan less certain, and wrong in places.

    All probabilities are softened by one softmax temperature. Then some classes lose a part of
    their probability to another class. They lose more in some directions and at some ranges than
    elsewhere. The scores then resemble scores on scans unlike the networks' training scans, so the
    head learns to trust the networks less.
    """
    temperature = float(np.exp(rng.uniform(0, np.log(HIGHEST_TEMPERATURE))))
    softened = scores.clamp_min(1e-7).log().div(temperature).softmax(dim=1)

    classes = scores.shape[1]
    leak = np.eye(classes, dtype=np.float32)
    for confused in np.flatnonzero(rng.random(classes) < CONFUSION_CHANCE):
        share = rng.uniform(0, LARGEST_LEAK)
        leak[confused, confused] -= share
        leak[confused, rng.integers(classes)] += share

    # The strength of the confusion goes from 0 to 1, in waves around the sensor and away from it.
    azimuth = torch.atan2(points[:, 1], points[:, 0])
    distance = points[:, :2].norm(dim=1)
    around = round(rng.uniform(*WAVES)) * azimuth
    away = 2 * np.pi * rng.uniform(*WAVES) / WAVE_RANGE * distance
    strength = 0.5 + 0.5 * torch.sin(around + away + rng.uniform(0, 2 * np.pi))

    confused_scores = softened @ torch.from_numpy(leak).to(softened)
    return softened + strength[:, None].to(softened) * (confused_scores - softened)


def tilt_rotation(roll: float, pitch: float) -> np.ndarray:
    """Return the (3, 3) matrix that rotates x, y, z about x by `roll`, then about y by `pitch`.

    Both angles are in radians.
    """
    about_x = np.eye(3)
    about_x[1:, 1:] = yaw_rotation(roll)
    about_y = np.eye(3)
    about_y[::2, ::2] = yaw_rotation(pitch).T
    return about_y @ about_x


def lasers(scan: Scan) -> np.ndarray:
    """Return the (N,) index of each point's laser, 0 or above.

    If the lasers are unknown, the rows of the range image take their place. If the rows are unknown
    also, `ELEVATION_BINS` equal bins of elevation do, which resemble the lasers of an HDL-64E.
    """
    if scan.ring is not None:
        return scan.ring
    if scan.row is not None:
        return scan.row

    elevation = np.nan_to_num(_elevations(scan))
    lowest, highest = _spread(elevation)
    borders = np.linspace(lowest, highest, ELEVATION_BINS + 1)[1:-1]
    laser: NDArray[np.intp] = np.searchsorted(borders, elevation, side="right")
    return laser


def _drop_lasers(scan: Scan, rng: np.random.Generator) -> Scan:
    """Drop every second laser, or a random share of the lasers up to `LARGEST_LASER_DROP`."""
    laser = lasers(scan)
    count = laser.max(initial=0) + 1
    draws = rng.random(count)
    share = rng.uniform(0, LARGEST_LASER_DROP)
    odd = rng.integers(2)

    keep = draws >= share
    if rng.random() < 0.5:
        keep = np.arange(count) % 2 == odd
    return _keep(scan, keep[laser])


def _drop_blocks(scan: Scan, rng: np.random.Generator) -> Scan:
    """Drop up to `MAX_BLOCKS` rectangles of azimuth and elevation."""
    elevation = np.degrees(_elevations(scan))
    lowest, highest = _spread(elevation)

    is_hidden = np.zeros(len(scan), dtype=bool)
    for _ in range(rng.integers(1, MAX_BLOCKS + 1)):
        start = rng.uniform(-np.pi, np.pi)
        width = np.radians(rng.uniform(*BLOCK_WIDTH))
        height = rng.uniform(*BLOCK_HEIGHT)
        middle = rng.uniform(lowest, highest)
        is_hidden |= _in_sector(scan, start, width) & (np.abs(elevation - middle) < height / 2)
    return _keep(scan, ~is_hidden)


def _intensity_gain(config: AugmentConfig, rng: np.random.Generator) -> float:
    if rng.random() < config.no_intensity:
        return 0.0
    return 1 + rng.uniform(-config.intensity, config.intensity)


def _distort_intensity(
    intensity: np.ndarray, scan: Scan, config: AugmentConfig, rng: np.random.Generator
) -> np.ndarray:
    """Return the (N,) intensities that another calibration might give, in [0, 1]."""
    if config.intensity_gamma:
        exponent = np.exp(rng.uniform(-config.intensity_gamma, config.intensity_gamma))
        intensity = np.maximum(intensity, 0) ** exponent
    if config.laser_gain:
        laser = lasers(scan)
        gains = 1 + rng.uniform(-config.laser_gain, config.laser_gain, laser.max(initial=0) + 1)
        intensity = np.minimum(intensity * gains[laser], 1)
    if config.intensity_offset:
        offset = rng.uniform(-config.intensity_offset, config.intensity_offset)
        intensity = np.clip(intensity + offset, 0, 1)
    return intensity


def _in_sector(scan: Scan, start: float, width: float) -> NDArray[np.bool_]:
    """Return (N,) bool: whether a point's azimuth is at most `width` radians beyond `start`."""
    azimuth = np.arctan2(scan.points[:, 1], scan.points[:, 0])
    is_inside: NDArray[np.bool_] = (azimuth - start) % (2 * np.pi) < width
    return is_inside


def _elevations(scan: Scan) -> NDArray[np.floating]:
    x, y, z = scan.points[:, :3].T
    elevation: NDArray[np.floating] = np.arctan2(z, np.hypot(x, y))
    return elevation


def _spread(values: NDArray[np.floating]) -> NDArray[np.floating]:
    """Return the lowest and the highest value without `OUTLIERS`, or zeros if none is finite."""
    finite = values[np.isfinite(values)]
    if len(finite) == 0:
        return np.zeros(2)
    ends: NDArray[np.floating] = np.percentile(finite, [OUTLIERS, 100 - OUTLIERS])
    return ends


def _keep(scan: Scan, mask: np.ndarray) -> Scan:
    """Drop the points outside a mask (N,), unless none would be left."""
    return scan.select(mask) if mask.any() else scan


def _join(scan: Scan, other: Scan) -> Scan:
    """Return a copy of the first scan that has the points of both scans."""
    return dataclasses.replace(
        scan,
        points=np.concatenate([scan.points, other.points]),
        labels=_join_labels(scan, other),
        ring=_join_indices(scan.ring, other.ring, scan, other),
        row=_join_indices(scan.row, other.row, scan, other),
        source=_join_indices(scan.source, other.source, scan, other),
        own=_join_indices(scan.own, other.own, scan, other, missing=False),
        file_xyz=None,
    )


def _join_labels(scan: Scan, other: Scan) -> np.ndarray | None:
    if scan.labels is None or other.labels is None:
        return None
    return np.concatenate([scan.labels, other.labels])


def _join_indices(
    first: np.ndarray | None,
    second: np.ndarray | None,
    scan: Scan,
    other: Scan,
    missing: int = -1,
) -> np.ndarray | None:
    """Return the rings, rows, ... of both scans. Points of a scan without them get `missing`."""
    if first is None and second is None:
        return None
    if first is None:
        first = np.full(len(scan), missing)
    if second is None:
        second = np.full(len(other), missing)
    return np.concatenate([first, second])
