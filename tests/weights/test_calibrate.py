"""The calibration, which the built-in weights went through."""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

import amvnet
from amvnet.errors import InputError
from amvnet.scan import Scan
from amvnet.training.losses import class_weights
from amvnet.weights.calibrate import calibrate, main, read_counts
from amvnet.weights.file import load, save

from fixtures.commands import fails
from fixtures.tiny import fresh_weights, without

WEIGHTS = fresh_weights()


def test_the_ensemble_weighs_the_networks_and_their_labels_stay(
    random_scan: Callable[..., Scan],
) -> None:
    # The scores of hidden points are means, which do not commute with a factor of the logits.
    assert WEIGHTS.model.range_view.hidden == 0
    scan = random_scan(2000)
    before = amvnet.load(WEIGHTS, method="ensemble")(scan)
    after = amvnet.load(calibrate(WEIGHTS, np.ones(19), 0, 0.7), method="ensemble")(scan)
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

    calibrated = calibrate(WEIGHTS, counts, prior=0.5, bev=0.5)
    path = save(calibrated, tmp_path / "calibrated.safetensors")
    after = amvnet.load(path, method="rv")(scan).labels
    assert (after == rare + 1).sum() < 0.9 * named[rare]


def test_the_shift_undoes_a_share_of_the_class_weights() -> None:
    counts = np.random.default_rng(0).integers(0, 10**6, 19)
    counts[3] = 0
    weights = fresh_weights()
    shifted = calibrate(weights, counts, prior=0.2, bev=0.5)
    shift = shifted.tensors["range_net.scores.bias"] - weights.tensors["range_net.scores.bias"]
    expected = -0.4 * np.log(class_weights(counts))
    np.testing.assert_allclose(shift, expected - expected.mean(), atol=1e-5)


@pytest.mark.parametrize("bev", [0, 1, -0.5, float("nan")])
def test_an_impossible_weight_is_an_input_error(bev: float) -> None:
    with pytest.raises(InputError, match="above 0 and below 1"):
        calibrate(fresh_weights(), np.ones(19), bev=bev)


def test_no_file_that_is_read_or_of_another_kind_is_replaced(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def run(out: Path) -> None:
        arguments = ["calibrate", weights, counts, out]
        monkeypatch.setattr(sys, "argv", list(map(str, arguments)))
        main()

    weights = save(fresh_weights(), tmp_path / "w.safetensors")
    counts = tmp_path / "class_counts.npz"
    np.savez(counts, counts=np.ones(19))
    other = tmp_path / "scan.bin"
    other.write_bytes(bytes(100))
    before = {path: path.read_bytes() for path in (weights, counts, other)}
    for out in before:
        fails(lambda out=out: run(out), out)  # type: ignore[misc]
        assert out.read_bytes() == before[out]

    for _ in range(2):  # a run that is continued writes the file again
        run(tmp_path / "calibrated.safetensors")
    assert load(tmp_path / "calibrated.safetensors").parts == fresh_weights().parts


def test_other_classes_or_a_missing_network_are_an_input_error(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="19 classes"):
        calibrate(fresh_weights(), np.ones(16))
    with pytest.raises(InputError, match="polar_net"):
        calibrate(without(fresh_weights(), "polar_net"), np.ones(19))
    (tmp_path / "counts.npz").write_text("no counts")
    for name in ("counts.npz", "missing.npz"):
        with pytest.raises(InputError, match="class_counts"):
            read_counts(tmp_path / name)
