"""A run says how sure its labels are, and warns if the weights do not know such scans."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import amvnet
from amvnet.inference.predict import ADVICE
from amvnet.weights.file import UNCERTAIN, USUAL_UNCERTAIN, Weights, load, save
from amvnet.weights.verdict import Verdict

from fixtures.commands import not_none, run_cli
from fixtures.tiny import fresh_weights, street, with_model, without

POINTS = street(5, 400)[0]


def with_usual(share: Any) -> Weights:
    weights = fresh_weights()
    return replace(weights, metrics={**weights.metrics, "point_head": {UNCERTAIN: share}})


# ---- the share that is usual


@pytest.mark.parametrize("share", [0, 0.0, 0.125, 1.0])
def test_the_usual_share_is_that_of_the_validation(share: float, tmp_path: Path) -> None:
    assert load(save(with_usual(share), tmp_path / "w.safetensors")).usual_uncertain == share


@pytest.mark.parametrize("metrics", [{}, {"point_head": {}}])
def test_weights_that_do_not_say_have_a_default(metrics: dict[str, Any]) -> None:
    assert replace(fresh_weights(), metrics=metrics).usual_uncertain == USUAL_UNCERTAIN


@pytest.mark.parametrize("share", [-0.1, 1.1, float("nan"), "0.5", None, [0.5]])
def test_a_share_that_is_none_is_not_believed(share: object) -> None:
    assert with_usual(share).usual_uncertain == USUAL_UNCERTAIN


# ---- the verdict


@pytest.mark.parametrize("usual", [0.0, 0.05, 0.2, 0.45, 0.9])
def test_the_usual_share_is_trusted_and_disagreement_everywhere_is_not(usual: float) -> None:
    assert not Verdict(usual, usual).is_doubtful
    assert Verdict(1.0, usual).is_doubtful
    doubtful = [Verdict(share, usual).is_doubtful for share in np.linspace(0, 1, 101)]
    assert doubtful == sorted(doubtful)  # once doubtful, always doubtful


def test_few_uncertain_points_are_never_doubtful() -> None:
    assert not Verdict(0.0004, 0.0).is_doubtful
    assert Verdict(0.04, 0.0).is_doubtful


def test_the_verdict_is_a_line_with_both_shares() -> None:
    assert str(Verdict(0.25, 0.2)) == "25.0% of the points are uncertain (usual: 20.0%)"
    line = str(Verdict(0.93, 0.2))
    assert line.startswith("do not rely on these labels: 93.0%")
    assert "\n" not in line


def test_labels_of_another_tau_are_not_judged_by_the_share_usual_for_the_weights() -> None:
    weights = with_usual(0.001)
    tau = weights.model.assertion.threshold
    assert amvnet.load(weights, tau=tau)(POINTS).verdict == amvnet.load(weights)(POINTS).verdict

    verdict = not_none(amvnet.load(weights, tau=1.0)(POINTS).verdict)
    assert verdict.share == 1
    assert not verdict.is_doubtful
    assert str(verdict) == "100.0% of the points are uncertain"


def test_a_result_has_the_share_of_its_valid_points() -> None:
    points = np.concatenate([POINTS, np.full((100, 4), np.nan, np.float32)])
    result = amvnet.load(with_usual(0.1))(points)
    assert result.verdict is not None
    assert result.verdict.share == result.uncertain[: len(POINTS)].mean()
    assert result.verdict.usual == 0.1


@pytest.mark.parametrize("method", ["rv", "rv-knn", "bev"])
def test_one_network_is_judged_by_its_mean_entropy(method: Any) -> None:
    points = np.concatenate([POINTS, np.full((100, 4), np.nan, np.float32)])
    result = amvnet.load(fresh_weights(), method=method)(points)
    network = not_none(result.bev if method == "bev" else result.rv)
    classes = network.shape[1]
    entropies = []
    for row in network[: len(POINTS)].tolist():
        entropies.append(sum(-p * math.log(p, classes) for p in row if p > 0))
    verdict = not_none(result.verdict)
    assert verdict.share == pytest.approx(np.mean(entropies), abs=1e-6)
    assert verdict.is_doubtful  # the network has learnt nothing
    assert "entropy" in str(verdict)


@pytest.mark.parametrize(
    ("method", "real", "changed"), [("rv", 0.20, 0.40), ("rv-knn", 0.20, 0.40), ("bev", 0.27, 0.35)]
)
def test_one_network_is_trusted_on_real_scans(method: str, real: float, changed: float) -> None:
    """The largest entropy of a real scan, and the smallest of most changed ones (docs/log.md)."""
    assert not Verdict.of(method, real, 0.9).is_doubtful
    assert Verdict.of(method, changed, 0.9).is_doubtful


def test_points_that_a_map_of_classes_ignores_count_as_others_do() -> None:
    result = amvnet.load(with_usual(0.1))(POINTS)
    assert replace(result, labels=np.zeros_like(result.labels)).doubt == result.doubt


# ---- the command


def said(world: Path, out: Path, weights: Weights, capsys: Any, *options: str) -> str:
    path = save(weights, out / "w.safetensors")
    words = ("predict", world / "data", "--weights", path, "--out", out / "labels", *options)
    assert run_cli(*words, "--sequences", "00") == (0, "")
    return str(capsys.readouterr().out)


@pytest.mark.parametrize("at_once", ["1", "2"])
def test_predict_says_the_share_of_the_run(
    world: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], at_once: str
) -> None:
    weights = with_usual(1.0)
    segmenter = amvnet.load(weights)
    uncertain = [segmenter(street(scan)[0]).uncertain for scan in range(2)]
    verdict = Verdict(float(np.concatenate(uncertain).mean()), 1.0)

    text = said(world, tmp_path, weights, capsys, "--at-once", at_once)
    assert str(verdict) in text
    assert ADVICE not in text


def test_predict_warns_and_says_what_to_try(
    world: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    weights = with_model(with_usual(0.0), "assertion", threshold=1.0)  # uncertain everywhere
    text = said(world, tmp_path, weights, capsys)
    (warning,) = [line for line in text.splitlines() if line.startswith("warning: ")]
    assert "100.0%" in warning
    for word in ("--height", "--axes", "--intensity-scale", "weights of another sensor"):
        assert word in warning


def test_predict_warns_even_if_some_scans_are_broken(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    street(0)[0].tofile(tmp_path / "a.bin")
    (tmp_path / "b.bin").write_bytes(b"123")
    path = save(with_usual(0.5), tmp_path / "w.safetensors")
    options = ("--weights", path, "--out", tmp_path / "labels")
    code, _ = run_cli("predict", tmp_path / "a.bin", tmp_path / "b.bin", *options)
    assert code == 3
    assert "of the points are uncertain" in capsys.readouterr().out


def test_predict_by_one_network_says_nothing_of_it(
    world: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    weights = without(fresh_weights(), "polar_net", "point_head")
    assert "uncertain" not in said(world, tmp_path, weights, capsys, "--method", "rv")


@pytest.mark.parametrize("method", ["rv", "bev"])
def test_predict_warns_of_one_network_that_is_not_sure(
    world: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], method: str
) -> None:
    text = said(world, tmp_path, fresh_weights(), capsys, "--method", method)
    assert "warning: do not rely on these labels: " in text
    assert "is the mean entropy of the network (usual: " in text
