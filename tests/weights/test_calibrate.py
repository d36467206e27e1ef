"""benchmarks/calibrate.py, which the built-in weights went through."""

from __future__ import annotations

import runpy
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

import amvnet
from amvnet.scan import Scan

SCRIPT = Path(__file__).parents[2] / "benchmarks/calibrate.py"
WEIGHTS = "sim-hdl64e"


def calibrated(tmp_path: Path, counts: np.ndarray, *options: str) -> Path:
    """Return the file of the calibrated weights."""
    np.savez(tmp_path / "counts.npz", counts=counts)
    out = tmp_path / "calibrated.safetensors"
    with pytest.MonkeyPatch.context() as patch:
        files = [WEIGHTS, str(tmp_path / "counts.npz"), str(out)]
        patch.setattr(sys, "argv", [str(SCRIPT), *files, *options])
        runpy.run_path(str(SCRIPT), run_name="__main__")
    return out


def test_the_ensemble_weighs_the_networks_and_their_labels_stay(
    tmp_path: Path, random_scan: Callable[..., Scan]
) -> None:
    path = calibrated(tmp_path, np.ones(19), "--prior", "0", "--bev", "0.7")
    scan = random_scan(2000)
    before = amvnet.load(WEIGHTS, method="ensemble")(scan)
    after = amvnet.load(path, method="ensemble")(scan)
    assert before.rv is not None
    assert before.bev is not None
    assert after.rv is not None
    assert after.bev is not None
    assert (after.rv.argmax(1) == before.rv.argmax(1)).all()
    assert (after.bev.argmax(1) == before.bev.argmax(1)).all()

    valid = before.labels > 0
    expected = (before.rv**0.3 * before.bev**0.7)[valid]
    scores = after.scores[valid]
    np.testing.assert_allclose(
        scores / scores.sum(1, keepdims=True), expected / expected.sum(1, keepdims=True), atol=1e-4
    )


def test_rare_classes_are_named_less_often(
    tmp_path: Path, random_scan: Callable[..., Scan]
) -> None:
    scan = random_scan(2000)
    before = amvnet.load(WEIGHTS, method="rv")(scan).labels
    named = np.bincount(before, minlength=20)[1:]
    rare = int(named.argmax())
    counts = np.full(19, 1e6)
    counts[rare] = 1e3

    path = calibrated(tmp_path, counts, "--prior", "0.5", "--bev", "0.5")
    after = amvnet.load(path, method="rv")(scan).labels
    assert (after == rare + 1).sum() < 0.9 * named[rare]
