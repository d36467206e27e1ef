"""Points in, labels out: each point keeps its place, and lost points change nothing."""

from __future__ import annotations

import math
import subprocess
import sys
from pathlib import Path
from typing import Any, get_args

import numpy as np
import pytest
import torch

import amvnet
from amvnet import InputError, Scan, Segmentation, Segmenter, fuse
from amvnet.data.taxonomy import NUSCENES
from amvnet.evaluation.scoring import labels_by_method
from amvnet.models.methods import METHODS, MethodName
from amvnet.weights.file import Weights, save

from fixtures.commands import fails, not_none
from fixtures.sensors import rings_of
from fixtures.tiny import THRESHOLD, fresh_weights, street, with_model, without

K = 19
POINTS = street(5, 600)[0]
WEIGHTS = fresh_weights()
METHOD_NAMES: tuple[MethodName, ...] = get_args(MethodName)


@pytest.fixture(scope="module")
def segmenter() -> Segmenter:
    return amvnet.load(WEIGHTS)


@pytest.fixture(scope="module")
def result(segmenter: Segmenter) -> Segmentation:
    return segmenter(POINTS)


def labels_by(method: MethodName, points: np.ndarray = POINTS) -> np.ndarray:
    return amvnet.load(WEIGHTS, method=method)(points).labels


def both_networks(result: Segmentation) -> tuple[np.ndarray, np.ndarray]:
    return not_none(result.rv), not_none(result.bev)


def equal_probabilities() -> np.ndarray:
    return np.full((len(POINTS), K), 1 / K, np.float32)


# ---- one scan


def test_the_networks_get_the_scan_turned_by_the_yaw() -> None:
    points, _ = street(0)
    yaw = 2.0
    turned = points.copy()
    for row in turned:
        x, y = map(float, row[:2])
        row[:2] = (math.cos(yaw) * x - math.sin(yaw) * y, math.sin(yaw) * x + math.cos(yaw) * y)
    segmenter = amvnet.load(fresh_weights())
    result = segmenter(points, yaw=yaw)
    assert (result.labels == segmenter(turned).labels).mean() > 0.999
    assert (result.labels != segmenter(points).labels).any()
    np.testing.assert_array_equal(result.require_origin().scan.points, points)
    np.testing.assert_array_equal(segmenter.many([points], [yaw])[0].labels, result.labels)


def test_every_point_gets_a_class_and_its_scores(result: Segmentation) -> None:
    n = len(POINTS)
    assert result.labels.shape == (n,)
    assert result.labels.dtype == np.uint8
    assert result.uncertain.shape == (n,)
    assert result.uncertain.dtype == bool
    assert 1 <= result.labels.min() <= result.labels.max() <= K

    for probabilities in both_networks(result):
        assert np.allclose(probabilities.sum(axis=1), 1, atol=1e-5)
    for scores in (result.scores, *both_networks(result)):
        assert scores.shape == (n, K)
        assert scores.dtype == np.float32
        assert (scores >= 0).all()
    assert np.array_equal(result.labels, result.scores.argmax(axis=1) + 1)


def with_lost_returns(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Insert rows of lost returns; return all points, and which of them are lost."""
    rows = [
        [np.nan, 1, 1, 0.5],
        [1, np.inf, 1, 0.5],
        [1, 1, -np.inf, 0.5],
        [np.nan, np.nan, np.nan, np.nan],
    ]
    indices = np.array([0, 7, 7, len(points)])
    is_lost = np.insert(np.zeros(len(points), bool), indices, True)
    return np.insert(points, indices, np.array(rows, np.float32), axis=0), is_lost


@pytest.mark.parametrize("method", METHOD_NAMES)
def test_lost_points_stay_in_place_and_change_nothing(method: MethodName) -> None:
    segmenter = amvnet.load(WEIGHTS, method=method)
    points, is_lost = with_lost_returns(POINTS)
    expected = segmenter(POINTS)
    actual = segmenter(points)
    for name in ("labels", "scores", "uncertain"):
        values = getattr(actual, name)
        assert np.array_equal(values[~is_lost], getattr(expected, name))
        assert not values[is_lost].any()
    for probabilities in (actual.rv, actual.bev):
        if probabilities is not None:
            assert not probabilities[is_lost].any()


@pytest.mark.parametrize("far", [1e20, 3e38, -1e30])
def test_absurd_points_stay_alone(segmenter: Segmenter, result: Segmentation, far: float) -> None:
    actual = segmenter(np.concatenate([POINTS, [[far, 1, 1, 0.5]]]).astype(np.float32))
    assert np.array_equal(actual.scores[:-1], result.scores)
    assert actual.labels[-1] == 0


def test_permuted_points_have_permuted_labels(segmenter: Segmenter, result: Segmentation) -> None:
    order = np.random.default_rng(0).permutation(len(POINTS))
    permuted = segmenter(POINTS[order])
    for actual, expected in zip(both_networks(permuted), both_networks(result), strict=True):
        assert np.allclose(actual, expected[order], atol=1e-5)
    assert (permuted.labels == result.labels[order]).mean() > 0.995


def test_a_scan_is_its_points_which_stay(segmenter: Segmenter, result: Segmentation) -> None:
    before = POINTS.copy()
    assert np.array_equal(segmenter(Scan(POINTS)).labels, result.labels)
    assert np.array_equal(segmenter(POINTS.astype(np.float64)).labels, result.labels)
    assert segmenter(POINTS[:1]).labels.shape == (1,)
    assert np.array_equal(POINTS, before)


@pytest.mark.parametrize(
    "points", [np.zeros((0, 4)), np.full((5, 4), np.nan)], ids=["empty", "NaN"]
)
@pytest.mark.parametrize("method", METHOD_NAMES)
def test_a_scan_without_points_is_refused(points: np.ndarray, method: MethodName) -> None:
    fails(lambda: amvnet.load(WEIGHTS, method=method)(points.astype(np.float32)))


def test_probabilities_are_the_scores_with_rows_that_sum_to_1(segmenter: Segmenter) -> None:
    points, is_lost = with_lost_returns(POINTS)
    result = segmenter(points)
    sums = result.probabilities.sum(axis=1)
    assert np.allclose(sums[~is_lost], 1, atol=1e-5)
    assert not sums[is_lost].any()
    assert result.probabilities.dtype == np.float32
    assert np.array_equal(result.probabilities.argmax(axis=1), result.scores.argmax(axis=1))

    of_label = result.probabilities[np.arange(len(points)), result.labels.astype(int) - 1]
    assert np.array_equal(result.confidence[~is_lost], of_label[~is_lost])
    assert not result.confidence[is_lost].any()
    # The scores stay as the paper has them.
    assert (result.scores.sum(axis=1)[~is_lost & ~result.uncertain] < 0.999).any()


def test_a_point_without_any_score_is_of_every_class_alike() -> None:
    scores = np.zeros((2, K), np.float32)
    result = Segmentation(np.array([1, 0], np.uint8), np.zeros(2, bool), scores)
    assert np.array_equal(result.probabilities[0], np.full(K, 1 / K, np.float32))
    assert not result.probabilities[1].any()


# ---- what holds the points


class Table:
    """The part of a table of pandas that is used."""

    def to_records(self, index: bool) -> np.ndarray:
        assert not index
        names = ("intensity", "x", "y", "z", "time")
        records = np.zeros(len(POINTS), [(name, "f4") for name in names])
        for column, name in enumerate("xyz"):
            records[name] = POINTS[:, column]
        records["intensity"] = POINTS[:, 3]
        return records


@pytest.mark.parametrize(
    "points",
    [
        tuple(map(tuple, POINTS)),
        torch.from_numpy(POINTS).double().requires_grad_(),
        Table(),
        Table().to_records(index=False).reshape(2, -1),
    ],
    ids=["tuple", "tensor with gradient", "table", "organised records"],
)
def test_whatever_holds_the_points_gives_the_same_labels(
    segmenter: Segmenter, result: Segmentation, points: Any
) -> None:
    assert np.array_equal(segmenter(points).labels, result.labels)
    assert np.array_equal(segmenter.many([points])[0].labels, result.labels)


def test_names_of_columns_may_be_a_list(segmenter: Segmenter, result: Segmentation) -> None:
    names = ["y", "x", "z", "intensity"]
    swapped = POINTS[:, [1, 0, 2, 3]]
    assert np.array_equal(segmenter(swapped, columns=names).labels, result.labels)
    assert np.array_equal(segmenter(swapped, columns="y, x,z,intensity").labels, result.labels)


def test_half_precision_is_read(segmenter: Segmenter) -> None:
    halves = torch.from_numpy(POINTS).bfloat16()
    assert np.array_equal(segmenter(halves).labels, segmenter(halves.float().numpy()).labels)


def test_masked_points_are_lost(segmenter: Segmenter) -> None:
    masked = np.ma.masked_array(POINTS, mask=False)
    masked[7, 1] = np.ma.masked
    labels = segmenter(masked).labels
    assert labels[7] == 0
    assert np.delete(labels, 7).all()


@pytest.mark.parametrize(
    ("points", "found"),
    [
        (None, "None"),
        ([POINTS[:5], POINTS[:6]], "list"),
        ({"x": 1}, "x"),
        ({"x": np.arange(3000), "y": np.arange(3000)}, "'y': array"),
        ((row for row in POINTS), "generator"),
        ([], "(0,)"),
        (POINTS.astype(str), "<U32"),
        (POINTS > 0, "bool"),
        (POINTS * 1j, "complex64"),
        (np.stack([POINTS, POINTS]), "give several scans to Segmenter.many"),
        (np.zeros(9, [("x", "f4"), ("y", "f4"), ("intensity", "f4")]), "z"),
        (np.zeros(9, [("x", "U4"), ("y", "f4"), ("z", "f4")]), "x"),
        (np.zeros(9, [("x", "f4", 2), ("y", "f4"), ("z", "f4")]), "x"),
    ],
)
def test_what_is_no_scan_is_one_line(segmenter: Segmenter, points: Any, found: str) -> None:
    for call in (segmenter, lambda points: segmenter.many([points])):
        with pytest.raises(InputError, match=r"\Ascan: expected .*") as caught:
            call(points)
        assert found in str(caught.value)
        assert "\n" not in str(caught.value)


# ---- methods


def test_each_method_has_its_own_scores(result: Segmentation) -> None:
    rv, bev = both_networks(result)
    expected: dict[MethodName, np.ndarray] = {"rv": rv, "bev": bev, "ensemble": np.sqrt(rv * bev)}
    for method, scores in expected.items():
        actual = amvnet.load(WEIGHTS, method=method)(POINTS)
        assert np.allclose(actual.scores, scores, atol=1e-6)
        assert actual.uncertain.any() == (method == "ensemble")
        assert (actual.rv is None) == (method == "bev")
        assert (actual.bev is None) == (method == "rv")


def test_by_method_equals_each_method(segmenter: Segmenter) -> None:
    points, _ = with_lost_returns(POINTS)
    labels, uncertain, _ = labels_by_method(segmenter, Scan(points), METHOD_NAMES)
    assert tuple(METHODS) == METHOD_NAMES
    assert tuple(labels) == METHOD_NAMES
    for method in METHOD_NAMES:
        assert np.array_equal(labels[method], labels_by(method, points))
    assert uncertain is not None
    assert np.array_equal(uncertain, segmenter(points).uncertain)


def test_a_method_includes_those_that_need_no_more_than_its_networks() -> None:
    expected = {
        "ensemble": ["rv", "rv-knn", "bev", "arithmetic", "maximum", "ensemble"],
        "rv": ["rv", "rv-knn"],
        "bev": ["bev"],
    }
    for method, names in expected.items():
        segmenter = amvnet.load(WEIGHTS, method=method)  # type: ignore[arg-type]
        labels, *_ = labels_by_method(segmenter, Scan(POINTS), METHOD_NAMES)
        assert list(labels) == names
        for name in names:
            assert np.array_equal(labels[name], labels_by(name))  # type: ignore[arg-type]


@pytest.mark.parametrize(("method", "other"), [("rv", "polar_net"), ("bev", "range_net")])
def test_by_method_of_one_network_is_that_network(method: MethodName, other: str) -> None:
    one_network = without(WEIGHTS, "point_head", other)
    labels, uncertain, _ = labels_by_method(amvnet.load(one_network, method=method), Scan(POINTS))
    assert list(labels) == [method]
    assert uncertain is None
    assert np.array_equal(labels[method], labels_by(method))


def test_weights_without_head_are_an_ensemble_and_no_more() -> None:
    headless = without(WEIGHTS, "point_head")
    with pytest.raises(InputError, match=r"no point_head.*rv or bev or ensemble$"):
        amvnet.load(headless)
    ensemble = amvnet.load(headless, method="ensemble")(POINTS)
    assert np.array_equal(ensemble.labels, labels_by("ensemble"))


# ---- options


def test_weights_may_be_given_as_a_path(tmp_path: Path) -> None:
    path = save(WEIGHTS, tmp_path / "w.safetensors")
    assert np.array_equal(amvnet.load(path)(POINTS).labels, amvnet.load(str(path))(POINTS).labels)

    f = equal_probabilities()
    assert len(fuse(POINTS, f, f, head=path)) == len(POINTS)


def test_tau_is_that_of_the_weights_unless_it_is_given(result: Segmentation) -> None:
    assert np.array_equal(amvnet.load(WEIGHTS, tau=THRESHOLD)(POINTS).scores, result.scores)

    shares = []
    for tau in (0.0, 0.5 * THRESHOLD, THRESHOLD, 1.0):
        rv, bev = both_networks(result)
        cosine = (rv * bev).sum(axis=1) / np.linalg.norm(rv, axis=1) / np.linalg.norm(bev, axis=1)
        actual = amvnet.load(WEIGHTS, tau=tau)(POINTS)
        is_clear = np.abs(cosine - tau) > 1e-4
        assert np.array_equal(actual.uncertain[is_clear], (cosine <= tau)[is_clear])
        shares.append(actual.uncertain.mean())
    assert shares == sorted(shares)
    assert shares[-1] == 1
    assert np.array_equal(amvnet.load(WEIGHTS, tau=0)(POINTS).labels, labels_by("ensemble"))


@pytest.mark.parametrize("tau", [-0.1, 1.01, float("nan")])
def test_a_tau_that_is_no_cosine_of_probabilities_is_refused(tau: float) -> None:
    fails(lambda: amvnet.load(WEIGHTS, tau=tau), "tau", "0 to 1", str(tau))
    f = equal_probabilities()
    fails(lambda: fuse(POINTS, f, f, tau=tau), "tau", "0 to 1", str(tau))


@pytest.mark.parametrize(
    ("option", "value"), [("device", "abacus"), ("device", "cuda:99"), ("method", "vote")]
)
def test_an_unknown_device_or_method_is_refused(option: str, value: Any) -> None:
    fails(lambda: amvnet.load(WEIGHTS, **{option: value}))


def test_rows_by_ring_need_a_ring() -> None:
    segmenter = amvnet.load(fresh_weights(NUSCENES))
    fails(lambda: segmenter(POINTS), "ring")
    assert segmenter(Scan(POINTS, ring=rings_of(POINTS, 32))).labels.max() <= 16


def test_the_columns_of_a_file_are_as_the_user_says(tmp_path: Path) -> None:
    points = POINTS[:, [1, 0, 2, 3]]
    path = tmp_path / "scan.bin"
    points.astype(np.float32).tofile(path)
    POINTS.astype(np.float32).tofile(tmp_path / "usual.bin")
    segmenter = amvnet.load(WEIGHTS)
    expected = segmenter(tmp_path / "usual.bin").labels
    assert np.array_equal(segmenter(path, columns="y,x,z,intensity").labels, expected)
    assert not np.array_equal(segmenter(path).labels, expected)


def test_a_scan_has_its_own_columns() -> None:
    fails(lambda: amvnet.load(WEIGHTS)(Scan(POINTS), columns="y,x,z,intensity"), "columns")


def test_the_rows_of_a_scan_take_precedence_over_its_elevations_and_rings() -> None:
    """By elevation, the lasers of another sensor would be in other rows."""
    for weights in (WEIGHTS, fresh_weights(NUSCENES)):
        segmenter = amvnet.load(weights)
        height = weights.model.range_view.height
        ring = rings_of(POINTS, height)
        others = ring // 2
        by_ring = not_none(segmenter_by_ring(weights)(Scan(POINTS, ring=ring)).scores)

        by_row = segmenter(Scan(POINTS, ring=others, row=height - 1 - ring)).scores
        assert np.array_equal(by_row, by_ring)
        assert not np.array_equal(segmenter(Scan(POINTS, ring=others)).scores, by_ring)


def segmenter_by_ring(weights: Weights) -> Segmenter:
    return amvnet.load(with_model(weights, "range_view", rows="ring"))


def test_scans_with_rows_and_without_go_through_the_networks_together() -> None:
    segmenter = amvnet.load(WEIGHTS)
    height = WEIGHTS.model.range_view.height
    row = np.random.default_rng(0).integers(0, height, len(POINTS))
    scans = [Scan(POINTS), Scan(POINTS, row=row), Scan(POINTS, ring=rings_of(POINTS, height))]
    for scan, result in zip(scans, segmenter.many(scans), strict=True):
        np.testing.assert_allclose(result.scores, segmenter(scan).scores, atol=1e-5)


def test_rows_of_other_weights_are_refused() -> None:
    row = np.full(len(POINTS), WEIGHTS.model.range_view.height)
    fails(lambda: amvnet.load(WEIGHTS)(Scan(POINTS, row=row)), "rows from 0 to")


# ---- fusion of scores


@pytest.mark.parametrize(
    "points", [POINTS, with_lost_returns(POINTS)[0]], ids=["whole", "with lost points"]
)
def test_fused_scores_give_the_segmenters_labels(segmenter: Segmenter, points: np.ndarray) -> None:
    expected = segmenter(points)
    rv, bev = both_networks(expected)
    head = segmenter.model.point_head
    assert np.array_equal(fuse(points, rv, bev, head, tau=THRESHOLD), expected.labels)
    tensor, f, g = map(torch.from_numpy, (points, rv, bev))
    assert np.array_equal(fuse(tensor, f, g, WEIGHTS), expected.labels)  # with their own threshold
    without_head = fuse(points, rv, bev)
    assert np.array_equal(without_head, amvnet.load(WEIGHTS, method="ensemble")(points).labels)


def test_fusing_with_weights_takes_their_lead(result: Segmentation) -> None:
    weights = with_model(WEIGHTS, "assertion", lead=1.3)
    expected = amvnet.load(weights)(POINTS)
    assert np.array_equal(expected.uncertain, result.uncertain)
    assert np.count_nonzero(expected.labels != result.labels) > 0
    assert np.array_equal(fuse(POINTS, *both_networks(result), head=weights), expected.labels)


def test_agreement_needs_no_head(result: Segmentation) -> None:
    rv, _ = both_networks(result)
    assert np.array_equal(fuse(POINTS, rv, rv, WEIGHTS), rv.argmax(axis=1) + 1)


def test_fusing_leaves_the_callers_head_as_it_was() -> None:
    head = not_none(WEIGHTS.build().point_head)
    head.train()
    f = equal_probabilities()
    fuse(POINTS, f, f, head=head)
    assert head.training


def test_models_that_are_sure_of_different_classes_do_not_fuse_to_a_third() -> None:
    certain = np.eye(K, dtype=np.float32)
    f = certain[np.full(len(POINTS), 5)]
    g = certain[np.full(len(POINTS), 8)]
    assert set(fuse(POINTS, f, g).tolist()) <= {6, 9}


def test_scores_that_are_no_numbers_are_refused() -> None:
    f = equal_probabilities()
    fails(lambda: fuse(POINTS, f, np.full_like(f, np.nan)), "finite")


def wrong_shapes() -> dict[str, tuple[np.ndarray, np.ndarray]]:
    scores = equal_probabilities()
    labels = np.ones(len(POINTS))
    return {
        "fewer points": (scores[:-1], scores[:-1]),
        "one of fewer points": (scores, scores[:-1]),
        "other classes": (scores, scores[:, :-1]),
        "classes of no head": (scores[:, :-1], scores[:, :-1]),
        "labels": (labels, labels),
    }


@pytest.mark.parametrize("kind", wrong_shapes())
def test_fusing_scores_of_wrong_shapes_is_refused(kind: str) -> None:
    f, g = wrong_shapes()[kind]
    fails(lambda: fuse(POINTS, f, g, head=WEIGHTS))


def test_fusing_with_weights_without_a_head_is_refused(result: Segmentation) -> None:
    headless = without(WEIGHTS, "point_head")
    fails(lambda: fuse(POINTS, *both_networks(result), head=headless), "head")


# ---- the package


PEAK = """
import sys, amvnet, numpy as np
from amvnet.runtime.memory import keep_freed_memory
keep_freed_memory()
points = np.random.default_rng(0).normal(size=(int(sys.argv[2]), 4)).astype(np.float32) * 10
points[:, 3] = 0.5
amvnet.load(sys.argv[1])(points)
with open("/proc/self/status") as file:
    status = dict(line.split(":", 1) for line in file)
print(1024 * int(status["VmHWM"].split()[0]))
"""


@pytest.mark.full
@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="reads /proc")
def test_a_point_of_a_large_scan_needs_few_bytes(tmp_path: Path) -> None:
    """Four tables of 19 scores and 15 neighbours alone are 364 bytes."""
    weights = save(fresh_weights(), tmp_path / "w.safetensors")
    peaks = []
    for points in (1_200_000, 2_400_000):
        command = [sys.executable, "-c", PEAK, str(weights), str(points)]
        peaks.append(int(subprocess.run(command, check=True, capture_output=True).stdout))
    assert (peaks[1] - peaks[0]) / 1_200_000 < 450
