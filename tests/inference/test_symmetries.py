"""Means over flips and turns are symmetric; over the scan as it is alone, they change nothing."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import get_args

import numpy as np
import pytest
import torch

import amvnet
from amvnet import InputError, Scan, Segmentation, Segmenter
from amvnet.config.schema import AssertionConfig
from amvnet.inference.symmetries import IDENTITY, SYMMETRIES, Symmetry, average
from amvnet.models.methods import TtaName
from amvnet.models.views.points import PointBatch
from amvnet.weights.file import save

from fixtures.worlds import (
    fails,
    fresh_weights,
    make_streets,
    refusal,
    street,
    succeed,
    without,
    write_scan,
)

POINTS = street(5, 600)[0]
FRESH = fresh_weights()
# About half of the points are certain.
WEIGHTS = replace(FRESH, model=replace(FRESH.model, assertion=AssertionConfig(threshold=0.7)))
NAMES: tuple[TtaName, ...] = get_args(TtaName)


def flip_x(points: np.ndarray) -> np.ndarray:
    return points * np.array([-1, 1, 1, 1], np.float32)


def flip_y(points: np.ndarray) -> np.ndarray:
    return points * np.array([1, -1, 1, 1], np.float32)


def quarter_turn(points: np.ndarray) -> np.ndarray:
    """Return the points after a turn by 90 degrees, counter-clockwise from above."""
    x, y, z, intensity = points.T
    return np.column_stack([-y, x, z, intensity])


def half_turn(points: np.ndarray) -> np.ndarray:
    return quarter_turn(quarter_turn(points))


def rounded_turn(points: np.ndarray) -> np.ndarray:
    """Return the points after a turn by 90 degrees with a rotation matrix, which rounds."""
    cos, sin = np.cos(np.pi / 2), np.sin(np.pi / 2)
    turned = points.copy()
    turned[:, :2] = points[:, :2].astype(float) @ np.array([[cos, sin], [-sin, cos]])
    return turned


Change = Callable[[np.ndarray], np.ndarray]
GROUPS: dict[TtaName, list[Change]] = {
    "flips": [flip_x, flip_y],
    "yaw": [quarter_turn, half_turn, rounded_turn],
    "both": [flip_x, flip_y, quarter_turn, half_turn],
}
CASES = [(name, change) for name in NAMES for change in GROUPS[name]]


def probabilities(result: Segmentation) -> tuple[np.ndarray, np.ndarray]:
    """Return f and g, (N, K)."""
    assert result.rv is not None
    assert result.bev is not None
    return result.rv, result.bev


@pytest.mark.parametrize(
    ("name", "change"), CASES, ids=[f"{name}-{change.__name__}" for name, change in CASES]
)
def test_a_scan_that_is_flipped_or_turned_has_the_same_scores(
    name: TtaName, change: Change
) -> None:
    segmenter = Segmenter(WEIGHTS, tta=name)
    expected = segmenter(POINTS)
    actual = segmenter(change(POINTS))
    for before, after in zip(probabilities(expected), probabilities(actual), strict=True):
        assert np.allclose(before, after, atol=1e-5)
    assert (actual.uncertain == expected.uncertain).mean() > 0.995

    # The head sees the coordinates, the geometric mean of the others does not.
    certain = ~(actual.uncertain | expected.uncertain)
    assert certain.any()
    assert np.allclose(actual.scores[certain], expected.scores[certain], atol=1e-5)

    plain = Segmenter(WEIGHTS)
    differences = np.abs(probabilities(plain(POINTS))[0] - probabilities(plain(change(POINTS)))[0])
    assert differences.max() > 0.01


@pytest.mark.parametrize(
    ("name", "changes"),
    [
        ("flips", [np.copy, flip_x, flip_y, half_turn]),
        ("yaw", [np.copy, quarter_turn, half_turn, lambda p: quarter_turn(half_turn(p))]),
    ],
)
def test_scores_are_the_means_of_the_scores_of_changed_scans(
    name: TtaName, changes: list[Change]
) -> None:
    plain = Segmenter(WEIGHTS)
    results = [probabilities(plain(change(POINTS))) for change in changes]
    f, g = np.mean(results, axis=0)

    result = Segmenter(WEIGHTS, tta=name)(POINTS)
    for actual, expected in zip(probabilities(result), (f, g), strict=True):
        assert np.allclose(actual, expected, atol=1e-5)

    # The assertion, the head and the merge work with these means.
    fused = amvnet.fuse(POINTS, f, g, head=WEIGHTS)
    assert (result.labels == fused).mean() > 0.995


def test_the_scan_as_it_is_alone_changes_no_bit() -> None:
    model = Segmenter(WEIGHTS).model
    batch = PointBatch.of([Scan(POINTS), Scan(POINTS[:100])])

    def score(batch: PointBatch) -> tuple[torch.Tensor, ...]:
        scores: tuple[torch.Tensor, ...] = model.score(*model.project(batch))
        return scores

    with torch.inference_mode():
        expected = score(batch)
        actual = average(score, batch, [IDENTITY])
    for before, after in zip(expected, actual, strict=True):
        assert torch.equal(before, after)


def matrix(symmetry: Symmetry) -> tuple[tuple[float, ...], ...]:
    """Return where a symmetry puts the unit vectors of x and y."""
    points = np.array([[1, 0, 0, 0], [0, 1, 0, 0]], np.float32)
    changed = symmetry(PointBatch.of([Scan(points)])).points[:, :2]
    return tuple(map(tuple, (changed + 0.0).tolist()))


@pytest.mark.parametrize(("name", "count"), [("flips", 4), ("yaw", 4), ("both", 8)])
def test_the_symmetries_are_a_group(name: TtaName, count: int) -> None:
    group = [np.array(matrix(symmetry)) for symmetry in SYMMETRIES[name]]
    elements = {matrix(symmetry) for symmetry in SYMMETRIES[name]}
    assert len(group) == len(elements) == count
    for first in group:
        for second in group:
            assert tuple(map(tuple, (first @ second).tolist())) in elements


@pytest.mark.parametrize("method", ["rv", "bev", "rv-knn"])
def test_one_network_alone_is_averaged_too(method: str) -> None:
    network = "bev" if method == "bev" else "rv"
    lacking = "range_net" if method == "bev" else "polar_net"
    weights = without(WEIGHTS, "point_head", lacking)
    segmenter = Segmenter(weights, method=method, tta="flips")  # type: ignore[arg-type]
    expected = probabilities(Segmenter(WEIGHTS, tta="flips")(POINTS))
    actual = getattr(segmenter(POINTS), network)
    assert np.allclose(actual, expected[network == "bev"], atol=1e-6)


def test_an_unknown_augmentation_is_refused() -> None:
    with pytest.raises(InputError, match="flips, yaw, both"):
        Segmenter(WEIGHTS, tta="scale")  # type: ignore[arg-type]


# ---- the command line


@pytest.fixture(scope="module")
def world(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = make_streets(tmp_path_factory.mktemp("world"), sequences=("08",))
    save(WEIGHTS, root / "w.safetensors")
    write_scan(root / "lone", "00", "000000", POINTS, None)
    return root


def test_evaluate_says_what_was_averaged_and_names_the_vote(
    world: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    weights = world / "w.safetensors"
    succeed(f"evaluate {world} --weights {weights} --json {world}/plain.json")
    assert "augmentation" not in capsys.readouterr().out
    options = f"--tta flips --methods rv,rv-knn,amvnet --json {world}/tta.json"
    succeed(f"evaluate {world} --weights {weights} {options}")
    assert "test-time augmentation: flips" in " ".join(capsys.readouterr().out.split())

    plain = json.loads((world / "plain.json").read_text())
    averaged = json.loads((world / "tta.json").read_text())
    assert "tta" not in plain
    assert averaged["tta"] == "flips"
    assert list(plain["methods"]) == ["rv", "bev", "ensemble", "amvnet"]
    assert list(averaged["methods"]) == ["rv", "rv-knn", "amvnet"]
    assert averaged["methods"]["rv"] != plain["methods"]["rv"]
    assert averaged["methods"]["rv"] != averaged["methods"]["rv-knn"]


def test_evaluate_says_which_tau_was_chosen(world: Path) -> None:
    shares = []
    for tau in (0.0, 1.0):
        command = f"evaluate {world} --weights {world}/w.safetensors"
        succeed(f"{command} --tau {tau} --json {world}/tau.json")
        figures = json.loads((world / "tau.json").read_text())
        assert figures["tau"] == tau
        shares.append(figures["uncertain_fraction"])
    assert shares == [0, 1]


def test_predictions_cannot_be_averaged(world: Path) -> None:
    assert "--tta" in refusal(f"evaluate {world} --predictions {world} --tta flips")
    assert "--tau" in refusal(f"evaluate {world} --predictions {world} --tau 0.5")


@pytest.mark.parametrize("method", ["rv-knn", "amvnet"])
def test_predict_writes_the_labels_of_the_segmenter(world: Path, method: str) -> None:
    out = world / method
    options = f"--weights {world}/w.safetensors --method {method} --tta both"
    succeed(f"predict semantickitti:{world} {options} --out {out}")

    segmenter = Segmenter(WEIGHTS, method=method, tta="both")  # type: ignore[arg-type]
    for name in ("000000", "000001"):
        points = np.fromfile(world / f"sequences/08/velodyne/{name}.bin", np.float32)
        expected = segmenter(points.reshape(-1, 4)).raw_ids
        written = np.fromfile(out / f"sequences/08/predictions/{name}.label", np.uint32)
        assert np.array_equal(written, expected)


def test_the_vote_has_no_uncertain_points_to_write(world: Path, tmp_path: Path) -> None:
    command = f"predict semantickitti:{world} --weights {world}/w.safetensors --method rv-knn"
    assert "two networks" in refusal(f"{command} --uncertain --out {tmp_path}")


def test_load_takes_the_augmentation(world: Path) -> None:
    segmenter = amvnet.load(str(world / "w.safetensors"), tta="yaw")
    assert segmenter.tta == "yaw"
    fails(lambda: amvnet.load(str(world / "w.safetensors"), tta="x"), "yaw")  # type: ignore[arg-type]
