"""Pseudo-labels of two networks: where they agree and are sure, class by class."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch

from amvnet.adaptation.agreement import agreement, opinion, pseudo_labels, trust
from amvnet.config.schema import AdaptConfig


class Table(NamedTuple):
    """Probabilities of both networks, (P, K), and the uncertain points, (P,)."""

    f: np.ndarray
    g: np.ndarray
    uncertain: np.ndarray


def loop_over_points(tables: list[Table]) -> list[tuple[int, float]]:
    """Return the train id that both networks name, or 0, and the confidence of each point."""
    points = []
    for table in tables:
        for f, g, uncertain in zip(table.f, table.g, table.uncertain, strict=True):
            mean = np.sqrt(f * g)
            agrees = f.argmax() == g.argmax() and not uncertain
            agreed = int(f.argmax()) + 1 if agrees else 0
            points.append((agreed, float(np.float16(max(mean) / sum(mean)))))
    return points


def test_pseudo_labels_are_those_of_a_plain_loop() -> None:
    generator = torch.Generator().manual_seed(1)
    classes = 5
    config = AdaptConfig(quantile=0.3, lowest_confidence=0.53, points=20)
    opinions = []
    tables = []
    for _ in range(3):
        f = (torch.randn(400, classes, generator=generator) * 2).softmax(dim=1)
        g = (0.7 * f + 0.3 * torch.rand(400, classes, generator=generator)).pow(1.5)
        g = g / g.sum(dim=1, keepdim=True)
        uncertain = torch.nn.functional.cosine_similarity(f, g) <= 0.85
        opinions.append(opinion(f, g, uncertain))
        tables.append(Table(f.numpy(), g.numpy(), uncertain.numpy()))

    points = loop_over_points(tables)
    thresholds = {}
    for name in range(1, classes + 1):
        confidences = [confidence for agreed, confidence in points if agreed == name]
        threshold = min(float(np.quantile(np.array(confidences, np.float32), 0.3)), 0.9)
        count = sum(confidence >= np.float32(threshold) for confidence in confidences)
        if threshold >= 0.53 and count >= 20:
            thresholds[name] = np.float32(threshold)

    expected = []
    for agreed, confidence in points:
        is_sure = agreed in thresholds and confidence >= thresholds[agreed]
        expected.append(agreed if is_sure else 0)

    trusted = trust(opinions, classes, config)
    found = np.concatenate([pseudo_labels(scan, trusted) for scan in opinions])
    assert set(np.flatnonzero(trusted.told) + 1) == set(thresholds)
    assert 0 < len(thresholds) < classes
    np.testing.assert_array_equal(found, expected)
    assert 0 < (found > 0).mean() < 1


def test_the_agreement_is_the_mean_over_classes_of_what_still_stands() -> None:
    start = [np.array([0, 1, 1, 1, 1, 2], np.uint8), np.array([2, 0], np.uint8)]
    now = [np.array([3, 1, 1, 1, 3, 2], np.uint8), np.array([1, 1], np.uint8)]
    assert agreement(start, now, 3) == np.mean([3 / 4, 1 / 2])
    assert agreement([np.zeros(3, np.uint8)], [np.ones(3, np.uint8)], 3) == 1.0
