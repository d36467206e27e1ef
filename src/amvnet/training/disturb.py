"""Scores made as doubtful as those on scans unlike the training scans, for the point head."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

HOTTEST = 3.0  # largest softmax temperature
CONFUSED = 0.25  # chance of each class of being confused with another
LARGEST_LEAK = 0.8  # of a confused class's probability that goes to the other class
WAVES = (0.5, 3.0)  # waves of the confusion around the sensor, and per 20 m of range
WAVE_RANGE = 20.0  # metres


def disturb(scores: Tensor, points: Tensor, rng: np.random.Generator) -> Tensor:
    """Return the scores of one network for a scan, less certain and wrong in places.

    All probabilities are softened by one softmax temperature. Then a part of the probability of
    some classes goes to another class, more in some directions and at some ranges than in others.
    A head that learns from such scores cannot rely on a network's every word, as it could on scans
    like those of the network's training.

    Args:
        scores: (P, K) probabilities.
        points: (P, 4) x, y, z, intensity.
        rng: draws the changes.

    Returns:
        (P, K) probabilities.
    """
    temperature = float(np.exp(rng.uniform(0, np.log(HOTTEST))))
    softened = scores.clamp_min(1e-7).log().div(temperature).softmax(dim=1)

    classes = scores.shape[1]
    leak = np.eye(classes, dtype=np.float32)
    for confused in np.flatnonzero(rng.random(classes) < CONFUSED):
        share = rng.uniform(0, LARGEST_LEAK)
        leak[confused, confused] -= share
        leak[confused, rng.integers(classes)] += share

    # From 0 to 1, in waves around the sensor and away from it.
    azimuth = torch.atan2(points[:, 1], points[:, 0])
    distance = points[:, :2].norm(dim=1)
    around = round(rng.uniform(*WAVES)) * azimuth
    away = 2 * np.pi * rng.uniform(*WAVES) / WAVE_RANGE * distance
    strength = 0.5 + 0.5 * torch.sin(around + away + rng.uniform(0, 2 * np.pi))

    confused_scores = softened @ torch.from_numpy(leak).to(softened)
    return softened + strength[:, None].to(softened) * (confused_scores - softened)
