"""Random numbers that are alike at neighbouring places."""

import numpy as np
import pytest

from lidarstreets.chance import patchy_normal


def test_numbers_are_normal_and_alike_within_a_patch_only() -> None:
    rng = np.random.default_rng(0)
    corners = rng.uniform(-50, 50, size=(40_000, 3))
    pairs = np.stack([corners, corners + 1e-4])  # nearly all in one cube

    first, second = patchy_normal(rng, pairs.reshape(-1, 3), 0.5, 0.7).reshape(2, -1)
    for numbers in (first, second):
        assert numbers.mean() == pytest.approx(0, abs=0.03)
        assert numbers.std() == pytest.approx(1, abs=0.03)
    assert np.corrcoef(first, second)[0, 1] == pytest.approx(0.7, abs=0.02)

    far_apart = np.stack([corners, corners + np.array([0.6, 0, 0])]).reshape(-1, 3)
    first, second = patchy_normal(rng, far_apart, 0.5, 0.7).reshape(2, -1)
    assert abs(np.corrcoef(first, second)[0, 1]) < 0.03
