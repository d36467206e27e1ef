"""Disturbed scores are still scores, and less certain ones."""

from __future__ import annotations

import numpy as np
import torch

from amvnet.training.augment import disturb

CLASSES = 19


def scan(seed: int, points: int = 500) -> tuple[torch.Tensor, torch.Tensor]:
    """Return sure scores and points around the sensor."""
    generator = torch.Generator().manual_seed(seed)
    scores = (8 * torch.randn(points, CLASSES, generator=generator)).softmax(dim=1)
    return scores, 20 * torch.randn(points, 4, generator=generator)


def test_disturbed_scores_are_probabilities() -> None:
    for seed in range(20):
        scores, points = scan(seed)

        disturbed = disturb(scores, points, np.random.default_rng(seed))

        assert disturbed.min() >= 0
        torch.testing.assert_close(disturbed.sum(dim=1), torch.ones(len(points)))


def test_disturbed_scores_are_less_certain_and_wrong_in_places_only() -> None:
    kept_shares = []
    for seed in range(20):
        scores, points = scan(seed)

        disturbed = disturb(scores, points, np.random.default_rng(seed))

        assert disturbed.amax(dim=1).mean() < scores.amax(dim=1).mean()
        kept_shares.append((disturbed.argmax(dim=1) == scores.argmax(dim=1)).float().mean().item())
    assert 0.5 < np.mean(kept_shares) < 0.99
    assert min(kept_shares) < 0.95


def test_the_same_generator_disturbs_in_the_same_way() -> None:
    scores, points = scan(0)

    first = disturb(scores, points, np.random.default_rng(5))
    second = disturb(scores, points, np.random.default_rng(5))

    assert torch.equal(first, second)
