"""Augmentation of training scans (section 3.1 of the paper)."""

from __future__ import annotations

import dataclasses

import numpy as np

from amvnet.config.schema import AugmentConfig
from amvnet.scan import Scan


def augment(scan: Scan, config: AugmentConfig, rng: np.random.Generator) -> Scan:
    """Return a randomly changed copy of a scan; the same generator state gives the same copy.

    Points are dropped, scaled, mirrored, jittered, rotated about the vertical and lifted.
    Intensities are scaled, or all set to zero.
    """
    # The order of the random draws decides which scan a seed gives: keep it.
    if config.drop:
        scan = _drop_points(scan, config.drop, rng)

    xyz = scan.points[:, :3] * (1 + rng.uniform(-config.scale, config.scale))
    mirrored = rng.random(2) < config.flip
    xyz[:, :2] *= np.where(mirrored, -1, 1)
    if config.jitter:
        xyz += rng.standard_normal(xyz.shape, dtype=np.float32) * config.jitter

    yaw = np.radians(rng.uniform(-config.yaw, config.yaw))
    xyz[:, :2] = xyz[:, :2] @ yaw_rotation(yaw).T
    xyz[:, 2] += rng.uniform(-config.height, config.height)

    intensity = np.minimum(scan.points[:, 3:] * _intensity_gain(config, rng), 1)
    points = np.column_stack([xyz, intensity]).astype(np.float32)
    return dataclasses.replace(scan, points=points)


def mix(scan: Scan, other: Scan, rng: np.random.Generator) -> Scan:
    """Replace a sector of a scan with the same sector of another scan (Xiao et al., 2022).

    The sector spans a quarter to three quarters of the circle. The scan is returned as it is if no
    point would be left.
    """
    start = rng.uniform(-np.pi, np.pi)
    width = rng.uniform(0.5, 1.5) * np.pi

    outside = _select(scan, ~_in_sector(scan, start, width))
    inside = _select(other, _in_sector(other, start, width))
    points = np.concatenate([outside.points, inside.points])
    if len(points) == 0:
        return scan

    labels = _concatenate(outside.labels, inside.labels)
    ring = _concatenate(outside.ring, inside.ring)
    return dataclasses.replace(scan, points=points, labels=labels, ring=ring)


def yaw_rotation(yaw: float) -> np.ndarray:
    """Return the (2, 2) matrix that rotates x, y by `yaw` radians, counter-clockwise from above."""
    cos = np.cos(yaw)
    sin = np.sin(yaw)
    return np.array([[cos, -sin], [sin, cos]])


def _drop_points(scan: Scan, most: float, rng: np.random.Generator) -> Scan:
    """Drop a random share of the points, up to `most`; keep all if none would be left."""
    draws = rng.random(len(scan))
    keep = draws >= rng.uniform(0, most)
    return _select(scan, keep) if keep.any() else scan


def _intensity_gain(config: AugmentConfig, rng: np.random.Generator) -> float:
    if rng.random() < config.no_intensity:
        return 0.0
    return 1 + rng.uniform(-config.intensity, config.intensity)


def _in_sector(scan: Scan, start: float, width: float) -> np.ndarray:
    """Return (N,) bool: the points whose azimuth is at most `width` radians beyond `start`."""
    azimuth = np.arctan2(scan.points[:, 1], scan.points[:, 0])
    return (azimuth - start) % (2 * np.pi) < width


def _select(scan: Scan, mask: np.ndarray) -> Scan:
    labels = None if scan.labels is None else scan.labels[mask]
    ring = None if scan.ring is None else scan.ring[mask]
    return dataclasses.replace(scan, points=scan.points[mask], labels=labels, ring=ring)


def _concatenate(first: np.ndarray | None, second: np.ndarray | None) -> np.ndarray | None:
    if first is None or second is None:
        return None
    return np.concatenate([first, second])
