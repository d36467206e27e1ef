"""Disturbed scores are still scores, and less certain ones; a batch has several disturbances."""

from __future__ import annotations

import numpy as np
import torch

from amvnet.config.schema import PointHeadConfig
from amvnet.models.point_head import head_features, point_table
from amvnet.training.augment import disturb
from amvnet.training.head_points import DISTURBED_PARTS, disturb_batch

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


def batch_of(points: int = 160) -> tuple[torch.Tensor, torch.Tensor]:
    """Return the features of all points of a scan; the first neighbour of each is itself."""
    (f, xyzi), (g, _) = scan(1, points), scan(2, points)
    index = torch.arange(points)
    near = torch.stack([index, index.flip(0)], dim=1)
    return head_features(PointHeadConfig(), point_table(xyzi, f, g), index, near)


def test_only_scores_of_a_batch_are_disturbed_and_a_neighbour_as_the_point_itself() -> None:
    point, rows = batch_of()
    scale = PointHeadConfig().position_scale

    after, rows_after = disturb_batch(point, rows, scale, 1.0, np.random.default_rng(0))

    scores = slice(0, 2 * CLASSES)
    assert torch.equal(after[:, 2 * CLASSES :], point[:, 2 * CLASSES :])
    assert torch.equal(rows_after[..., 2 * CLASSES :], rows[..., 2 * CLASSES :])
    assert (after[:, scores] != point[:, scores]).any(dim=1).all()
    torch.testing.assert_close(after[:, scores], rows_after[:, 0, scores])
    for network in after[:, scores].split(CLASSES, dim=1):
        torch.testing.assert_close(network.sum(dim=1), torch.ones(len(point)))


def test_the_parts_of_a_batch_are_disturbed_in_different_ways() -> None:
    (f, xyzi), (g, _) = scan(1, 1), scan(2, 1)
    table = point_table(xyzi, f, g)
    index = torch.zeros(4 * DISTURBED_PARTS, dtype=torch.long)  # the same point again and again
    point, rows = head_features(PointHeadConfig(), table, index, index[:, None])

    after, _ = disturb_batch(point, rows, 0.05, 1.0, np.random.default_rng(0))
    seldom, _ = disturb_batch(point, rows, 0.05, 0.3, np.random.default_rng(0))
    never, _ = disturb_batch(point, rows, 0.05, 0.0, np.random.default_rng(0))

    assert len(after.unique(dim=0)) == DISTURBED_PARTS
    disturbed = (seldom != point).any(dim=1)
    assert disturbed.any()
    assert not disturbed.all()
    assert torch.equal(never, point)


def test_a_batch_smaller_than_its_parts_is_disturbed() -> None:
    point, rows = batch_of(3)
    after, rows_after = disturb_batch(point, rows, 0.0, 1.0, np.random.default_rng(0))
    assert after.shape == point.shape
    assert rows_after.isfinite().all()
    assert (after != point).any(dim=1).all()
