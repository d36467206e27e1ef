"""Augmentation of a scan's points in training (section 4.1 of the paper)."""

from __future__ import annotations

import dataclasses

import numpy as np

from amvnet.config.schema import AugmentConfig
from amvnet.scan import Scan


def augment(scan: Scan, config: AugmentConfig, rng: np.random.Generator) -> Scan:
    """Scale, mirror, jitter, turn and lift the points of a scan, change its intensity, and lose some of its points.

    The same generator state gives the same scan.
    """
    if config.drop:
        kept = rng.random(len(scan)) >= rng.uniform(0, config.drop)
        scan = _only(scan, kept if kept.any() else ~kept)
    xyz = scan.points[:, :3] * (1 + rng.uniform(-config.scale, config.scale))
    mirrored = rng.random(2) < config.flip
    xyz[:, :2] *= np.where(mirrored, -1, 1)
    if config.jitter:
        xyz += rng.standard_normal(xyz.shape, dtype=np.float32) * config.jitter
    xyz[:, :2] = xyz[:, :2] @ rotation(np.radians(rng.uniform(-config.yaw, config.yaw))).T
    xyz[:, 2] += rng.uniform(-config.height, config.height)
    gain = (
        0.0
        if rng.random() < config.no_intensity
        else 1 + rng.uniform(-config.intensity, config.intensity)
    )
    intensity = np.minimum(scan.points[:, 3:] * gain, 1)
    return dataclasses.replace(scan, points=np.column_stack([xyz, intensity]).astype(np.float32))


def mix(scan: Scan, other: Scan, rng: np.random.Generator) -> Scan:
    """A scan with a sector of a quarter to three quarters of the circle from another one (Xiao et al., 2022)."""
    start, width = rng.uniform(-np.pi, np.pi), rng.uniform(0.5, 1.5) * np.pi
    parts = [_only(s, _in_sector(s, start, width) == (s is other)) for s in (scan, other)]
    points, labels, ring = (
        _joined([getattr(p, name) for p in parts]) for name in ("points", "labels", "ring")
    )
    assert points is not None
    return (
        dataclasses.replace(scan, points=points, labels=labels, ring=ring) if len(points) else scan
    )


def _in_sector(scan: Scan, start: float, width: float) -> np.ndarray:
    azimuth = np.arctan2(scan.points[:, 1], scan.points[:, 0])
    return (azimuth - start) % (2 * np.pi) < width


def _joined(values: list[np.ndarray | None]) -> np.ndarray | None:
    present = [v for v in values if v is not None]
    return np.concatenate(present) if len(present) == len(values) else None


def _only(scan: Scan, kept: np.ndarray) -> Scan:
    labels, ring = (None if v is None else v[kept] for v in (scan.labels, scan.ring))
    return dataclasses.replace(scan, points=scan.points[kept], labels=labels, ring=ring)


def rotation(yaw: float) -> np.ndarray:
    """(2, 2) matrix that turns x, y by `yaw` radians, counter-clockwise seen from above."""
    cos, sin = np.cos(yaw), np.sin(yaw)
    return np.array([[cos, -sin], [sin, cos]])
