"""Augmentation of a scan's points in training (section 4.1 of the paper)."""

from __future__ import annotations

import dataclasses

import numpy as np

from amvnet.config import AugmentConfig
from amvnet.scan import Scan


def augment(scan: Scan, config: AugmentConfig, rng: np.random.Generator) -> Scan:
    """Scale, mirror, jitter and turn the points of a scan; labels, rings and intensity stay.

    The same generator state gives the same scan.
    """
    xyz = scan.points[:, :3] * (1 + rng.uniform(-config.scale, config.scale))
    mirrored = rng.random(2) < config.flip
    xyz[:, :2] *= np.where(mirrored, -1, 1)
    if config.jitter:
        xyz += rng.standard_normal(xyz.shape, dtype=np.float32) * config.jitter
    xyz[:, :2] = xyz[:, :2] @ rotation(np.radians(rng.uniform(-config.yaw, config.yaw))).T
    return dataclasses.replace(scan, points=np.column_stack([xyz, scan.points[:, 3:]]).astype(np.float32))


def rotation(yaw: float) -> np.ndarray:
    """(2, 2) matrix that turns x, y by `yaw` radians, counter-clockwise seen from above."""
    cos, sin = np.cos(yaw), np.sin(yaw)
    return np.array([[cos, -sin], [sin, cos]])
