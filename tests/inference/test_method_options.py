"""Methods beside the paper's four, and another tau, by `evaluate` and `predict`."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import amvnet
from amvnet.config.schema import AssertionConfig
from amvnet.weights.file import save

from fixtures.commands import refused, succeed
from fixtures.tiny import fresh_weights, make_streets

FRESH = fresh_weights()
# About half of the points are certain.
WEIGHTS = replace(FRESH, model=replace(FRESH.model, assertion=AssertionConfig(threshold=0.7)))


@pytest.fixture(scope="module")
def world(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = make_streets(tmp_path_factory.mktemp("world"), sequences=("08",))
    save(WEIGHTS, root / "w.safetensors")
    return root


def test_evaluate_scores_the_methods_that_are_named(world: Path) -> None:
    weights = world / "w.safetensors"
    succeed(f"evaluate {world} --weights {weights} --json {world}/plain.json")
    options = f"--methods rv,rv-knn,amvnet --json {world}/vote.json"
    succeed(f"evaluate {world} --weights {weights} {options}")

    plain = json.loads((world / "plain.json").read_text())["methods"]
    chosen = json.loads((world / "vote.json").read_text())["methods"]
    assert list(plain) == ["rv", "bev", "ensemble", "amvnet"]
    assert list(chosen) == ["rv", "rv-knn", "amvnet"]
    assert chosen["rv"] == plain["rv"] != chosen["rv-knn"]


def test_evaluate_says_which_tau_was_chosen(world: Path) -> None:
    shares = []
    for tau in (0.0, 1.0):
        command = f"evaluate {world} --weights {world}/w.safetensors"
        succeed(f"{command} --tau {tau} --json {world}/tau.json --overwrite")
        figures = json.loads((world / "tau.json").read_text())
        assert figures["tau"] == tau
        shares.append(figures["uncertain_fraction"])
    assert shares == [0, 1]


def test_predictions_have_no_tau(world: Path) -> None:
    refused(f"evaluate {world} --predictions {world} --tau 0.5", "--tau")


@pytest.mark.parametrize("method", ["rv-knn", "amvnet"])
def test_predict_writes_the_labels_of_the_segmenter(world: Path, method: str) -> None:
    out = world / method
    options = f"--weights {world}/w.safetensors --method {method}"
    succeed(f"predict semantickitti:{world} {options} --out {out}")

    segmenter = amvnet.load(WEIGHTS, method=method)  # type: ignore[arg-type]
    for name in ("000000", "000001"):
        points = np.fromfile(world / f"sequences/08/velodyne/{name}.bin", np.float32)
        expected = segmenter(points.reshape(-1, 4)).raw_ids
        written = np.fromfile(out / f"sequences/08/predictions/{name}.label", np.uint32)
        assert np.array_equal(written, expected)


def test_the_vote_has_no_uncertain_points_to_write(world: Path, tmp_path: Path) -> None:
    command = f"predict semantickitti:{world} --weights {world}/w.safetensors --method rv-knn"
    refused(f"{command} --uncertain --out {tmp_path}", "two networks")
