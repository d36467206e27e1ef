"""Pseudo-labels of two networks: where they agree and are sure, class by class."""

from __future__ import annotations

import numpy as np
import torch

from amvnet.adaptation.agreement import agreement, opinion, pseudo_labels, trust
from amvnet.config.schema import AdaptConfig


def test_pseudo_labels_are_those_of_a_plain_loop() -> None:
    generator = torch.Generator().manual_seed(1)
    classes = 5
    config = AdaptConfig(quantile=0.3, lowest_confidence=0.45, points=20)
    opinions = []
    tables = []
    for _ in range(3):
        f = (torch.randn(400, classes, generator=generator) * 2).softmax(dim=1)
        g = (0.7 * f + 0.3 * torch.rand(400, classes, generator=generator)).pow(1.5)
        g = g / g.sum(dim=1, keepdim=True)
        uncertain = torch.nn.functional.cosine_similarity(f, g) <= 0.85
        opinions.append(opinion(f, g, uncertain))
        tables.append((f.numpy(), g.numpy(), uncertain.numpy()))

    # For each class the confidences of the points that both networks give it.
    confidences: dict[int, list[float]] = {c: [] for c in range(classes)}
    points = []
    for f, g, uncertain in tables:
        for i in range(len(f)):
            mean = np.sqrt(f[i] * g[i])
            confidence = float(np.float16(max(mean) / sum(mean)))
            agrees = f[i].argmax() == g[i].argmax() and not uncertain[i]
            points.append((int(f[i].argmax()), confidence) if agrees else None)
            if agrees:
                confidences[int(f[i].argmax())].append(confidence)

    expected = []
    untold = set()
    for c, values in confidences.items():
        threshold = min(float(np.quantile(np.float32(values), 0.3)), 0.9)
        count = sum(value >= threshold for value in values)
        if threshold < 0.45 or count < 20:
            untold.add(c)
        confidences[c] = [threshold]
    for point in points:
        is_trusted = point is not None and point[0] not in untold
        if is_trusted and point is not None and point[1] >= np.float32(confidences[point[0]][0]):
            expected.append(point[0] + 1)
        else:
            expected.append(0)

    trusted = trust(opinions, classes, config)
    found = np.concatenate([pseudo_labels(scan, trusted) for scan in opinions])
    assert {int(c) for c in np.flatnonzero(~trusted.told)} == untold
    np.testing.assert_array_equal(found, expected)
    assert 0 < (found > 0).mean() < 1


def test_the_agreement_is_the_mean_over_classes_of_what_still_stands() -> None:
    start = [np.array([0, 1, 1, 1, 1, 2], np.uint8), np.array([2, 0], np.uint8)]
    now = [np.array([3, 1, 1, 1, 3, 2], np.uint8), np.array([1, 1], np.uint8)]
    assert agreement(start, now, 3) == np.mean([3 / 4, 1 / 2])
    assert agreement([np.zeros(3, np.uint8)], [np.ones(3, np.uint8)], 3) == 1.0
