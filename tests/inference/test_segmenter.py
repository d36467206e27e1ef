"""Points in, labels out: shapes and places hold, lost points change nothing, and fusion is its own."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import amvnet
from amvnet import InputError, Scan, Segmentation, Segmenter, fuse
from amvnet.data.taxonomy import NUSCENES
from amvnet.inference.methods import METHODS
from amvnet.weights.file import save

from fixtures.worlds import THRESHOLD, fails, fresh_weights, street, without

K = 19
POINTS = street(5, 600)[0]
WEIGHTS = fresh_weights()


@pytest.fixture(scope="module")
def segmenter() -> Segmenter:
    return Segmenter(WEIGHTS)


@pytest.fixture(scope="module")
def result(segmenter: Segmenter) -> Segmentation:
    return segmenter(POINTS)


def test_every_point_gets_a_class_and_its_scores(result: Segmentation) -> None:
    n = len(POINTS)
    assert (result.labels.shape, result.labels.dtype) == ((n,), np.uint8)
    assert (result.uncertain.shape, result.uncertain.dtype) == ((n,), bool)
    assert 1 <= result.labels.min() <= result.labels.max() <= K
    for scores in (result.scores, result.rv, result.bev):
        assert scores is not None
        assert (scores.shape, scores.dtype) == ((n, K), np.float32)
        assert (scores >= 0).all()
    assert np.array_equal(result.labels, result.scores.argmax(axis=1) + 1)


def test_the_networks_scores_are_probabilities(result: Segmentation) -> None:
    assert np.allclose(result.rv.sum(axis=1), 1, atol=1e-5)
    assert np.allclose(result.bev.sum(axis=1), 1, atol=1e-5)


def test_uncertain_is_where_the_cosine_similarity_is_low(result: Segmentation) -> None:
    f, g = result.rv.astype(float), result.bev.astype(float)
    cosine = (f * g).sum(1) / np.linalg.norm(f, axis=1) / np.linalg.norm(g, axis=1)
    clear = np.abs(cosine - THRESHOLD) > 1e-4
    assert np.array_equal(result.uncertain[clear], (cosine <= THRESHOLD)[clear])
    assert 0 < result.uncertain.mean() < 1


def test_certain_points_have_the_geometric_mean(result: Segmentation) -> None:
    certain = ~result.uncertain
    assert np.allclose(result.scores[certain], np.sqrt(result.rv * result.bev)[certain], atol=1e-6)


def lost(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The points with rows of lost returns among them, and where these are."""
    places = np.array([0, 7, 7, 100, len(points)])
    rows = np.array(
        [
            [np.nan, 1, 1, 0.5],
            [1, np.inf, 1, 0.5],
            [1, 1, -np.inf, 0.5],
            [1, 1, 1, np.nan],
            [np.nan] * 4,
        ]
    )
    mask = np.insert(np.zeros(len(points), bool), places, True)
    return np.insert(points, places, rows.astype(np.float32), axis=0), mask


@pytest.mark.parametrize("method", METHODS)
def test_lost_points_stay_in_place_and_change_nothing(method: str) -> None:
    segmenter = Segmenter(WEIGHTS, method=method)
    points, gone = lost(POINTS)
    with_lost, without_lost = segmenter(points), segmenter(POINTS)
    assert np.array_equal(with_lost.labels[~gone], without_lost.labels)
    assert np.array_equal(with_lost.scores[~gone], without_lost.scores)
    assert np.array_equal(with_lost.uncertain[~gone], without_lost.uncertain)
    for values in (
        with_lost.labels,
        with_lost.uncertain,
        with_lost.scores,
        with_lost.rv,
        with_lost.bev,
    ):
        assert values is None or not values[gone].any()


@pytest.mark.parametrize(
    ("method", "asked"), [("rv", {"rv"}), ("bev", {"bev"}), ("ensemble", {"rv", "bev"})]
)
def test_only_the_networks_that_were_asked_have_scores(method: str, asked: set[str]) -> None:
    result = Segmenter(WEIGHTS, method=method)(POINTS)
    assert {name for name in ("rv", "bev") if getattr(result, name) is not None} == asked


@pytest.mark.parametrize("far", [1e20, 3e38, -1e30])
def test_one_absurd_point_changes_nothing_for_the_others(
    segmenter: Segmenter, result: Segmentation, far: float
) -> None:
    points = np.concatenate([POINTS, [[far, 1, 1, 0.5]]]).astype(np.float32)
    found = segmenter(points)
    assert np.array_equal(found.scores[:-1], result.scores)
    assert found.labels[-1] == 0


def test_models_that_are_sure_of_different_classes_do_not_fuse_to_a_third() -> None:
    f, g = (np.eye(19, dtype=np.float32)[np.full(len(POINTS), c)] for c in (5, 8))
    assert set(fuse(POINTS, f, g).tolist()) <= {6, 9}


def test_scores_that_are_no_numbers_are_refused() -> None:
    f = np.full((len(POINTS), 19), 1 / 19, np.float32)
    fails(lambda: fuse(POINTS, f, np.full_like(f, np.nan)), "finite")


def test_by_method_is_what_each_method_gives_alone(segmenter: Segmenter) -> None:
    found, uncertain = segmenter.by_method(Scan(POINTS))
    for method, labels in found.items():
        assert np.array_equal(labels, Segmenter(WEIGHTS, method=method)(POINTS).labels)
    assert np.array_equal(uncertain, segmenter(POINTS).uncertain)
    assert set(found) == {"rv", "bev", "ensemble", "amvnet"}


def test_weights_may_be_given_as_a_path(tmp_path: Path) -> None:
    path = save(WEIGHTS, tmp_path / "w.safetensors")
    assert np.array_equal(Segmenter(path)(POINTS).labels, Segmenter(str(path))(POINTS).labels)
    f = np.full((len(POINTS), 19), 1 / 19, np.float32)
    assert len(fuse(POINTS, f, f, head=path)) == len(POINTS)


def test_fusing_leaves_the_callers_head_as_it_was() -> None:
    head = WEIGHTS.build().point_head
    assert head is not None
    head.train()
    f = np.full((len(POINTS), 19), 1 / 19, np.float32)
    fuse(POINTS, f, f, head=head)
    assert head.training


def test_permuted_points_have_permuted_labels(segmenter: Segmenter, result: Segmentation) -> None:
    order = np.random.default_rng(0).permutation(len(POINTS))
    permuted = segmenter(POINTS[order])
    assert np.allclose(permuted.rv, result.rv[order], atol=1e-5)
    assert np.allclose(permuted.bev, result.bev[order], atol=1e-5)
    assert (permuted.labels == result.labels[order]).mean() > 0.995


def test_the_same_points_have_the_same_labels_again(
    segmenter: Segmenter, result: Segmentation
) -> None:
    assert np.array_equal(segmenter(POINTS.copy()).scores, result.scores)


def test_a_scan_is_its_points(segmenter: Segmenter, result: Segmentation) -> None:
    assert np.array_equal(segmenter(Scan(POINTS)).labels, result.labels)
    assert np.array_equal(segmenter(POINTS.astype(np.float64)).labels, result.labels)


def test_points_are_not_changed(segmenter: Segmenter) -> None:
    points = POINTS.copy()
    segmenter(points)
    assert np.array_equal(points, POINTS)


def test_a_lone_point_is_segmented(segmenter: Segmenter) -> None:
    assert segmenter(POINTS[:1]).labels.shape == (1,)


@pytest.mark.parametrize(
    "points", [np.zeros((0, 4)), np.full((5, 4), np.nan)], ids=["empty", "NaN"]
)
@pytest.mark.parametrize("method", METHODS)
def test_a_scan_without_points_is_refused(points: np.ndarray, method: str) -> None:
    with pytest.raises(InputError):
        Segmenter(WEIGHTS, method=method)(points.astype(np.float32))


@pytest.mark.parametrize("shape", [(5,), (5, 3), (5, 5)])
def test_points_of_other_columns_are_refused(segmenter: Segmenter, shape: tuple[int, ...]) -> None:
    with pytest.raises(InputError):
        segmenter(np.ones(shape, np.float32))


def test_each_method_has_its_own_scores(result: Segmentation) -> None:
    expected = {"rv": result.rv, "bev": result.bev, "ensemble": np.sqrt(result.rv * result.bev)}
    for method, scores in expected.items():
        found = Segmenter(WEIGHTS, method=method)(POINTS)
        assert np.allclose(found.scores, scores, atol=1e-6)
        assert found.uncertain.any() == (method == "ensemble")


def test_by_method_equals_each_method(segmenter: Segmenter) -> None:
    points, _ = lost(POINTS)
    found, uncertain = segmenter.by_method(Scan(points), METHODS)
    assert list(found) == list(METHODS)
    for method, labels in found.items():
        assert np.array_equal(labels, Segmenter(WEIGHTS, method=method)(points).labels)
    assert np.array_equal(uncertain, segmenter(points).uncertain)


@pytest.mark.parametrize("part", ["range_net", "polar_net"])
def test_by_method_of_one_network_is_that_network(part: str) -> None:
    method = {"range_net": "rv", "polar_net": "bev"}[part]
    alone = without(WEIGHTS, "point_head", *({"range_net", "polar_net"} - {part}))
    found, uncertain = Segmenter(alone, method=method).by_method(Scan(POINTS))
    assert (list(found), uncertain) == ([method], None)
    assert np.array_equal(found[method], Segmenter(WEIGHTS, method=method)(POINTS).labels)


def test_weights_without_head_are_an_ensemble_and_no_more() -> None:
    headless = without(WEIGHTS, "point_head")
    with pytest.raises(InputError, match="point_head"):
        Segmenter(headless)
    ensemble = Segmenter(headless, method="ensemble")(POINTS)
    assert np.array_equal(ensemble.labels, Segmenter(WEIGHTS, method="ensemble")(POINTS).labels)


@pytest.mark.parametrize(
    ("option", "value"), [("method", "vote"), ("device", "abacus"), ("device", "cuda:99")]
)
def test_an_unknown_method_or_device_is_refused(option: str, value: str) -> None:
    with pytest.raises(InputError):
        Segmenter(WEIGHTS, **{option: value})


def test_rows_by_ring_need_a_ring() -> None:
    segmenter = Segmenter(fresh_weights(NUSCENES))
    with pytest.raises(InputError, match="ring"):
        segmenter(POINTS)
    ring = np.arange(len(POINTS)) % 32
    assert segmenter(Scan(POINTS, ring=ring)).labels.max() <= 16


@pytest.mark.parametrize("points", [POINTS, lost(POINTS)[0]], ids=["whole", "with lost points"])
def test_fusing_the_networks_scores_gives_the_segmenters_labels(
    segmenter: Segmenter, points: np.ndarray
) -> None:
    own = segmenter(points)
    assert np.array_equal(
        fuse(points, own.rv, own.bev, segmenter.model.point_head, tau=THRESHOLD), own.labels
    )
    assert np.array_equal(fuse(points, own.rv, own.bev, WEIGHTS, tau=THRESHOLD), own.labels)


def test_fusing_with_weights_takes_their_own_threshold(
    segmenter: Segmenter, result: Segmentation
) -> None:
    assert np.array_equal(fuse(POINTS, result.rv, result.bev, head=WEIGHTS), result.labels)


def test_fusing_without_a_head_is_the_ensemble(result: Segmentation) -> None:
    expected = Segmenter(WEIGHTS, method="ensemble")(POINTS).labels
    assert np.array_equal(fuse(POINTS, result.rv, result.bev), expected)


def test_agreement_needs_no_head(result: Segmentation) -> None:
    assert np.array_equal(fuse(POINTS, result.rv, result.rv, WEIGHTS), result.rv.argmax(axis=1) + 1)


def wrong_shapes() -> dict[str, tuple[np.ndarray, np.ndarray]]:
    n, right = len(POINTS), np.full((len(POINTS), K), 1 / K, np.float32)
    return {
        "fewer points": (right[:-1], right[:-1]),
        "one of fewer points": (right, right[:-1]),
        "other classes": (right, right[:, :-1]),
        "classes of no head": (right[:, :-1], right[:, :-1]),
        "labels": (np.ones(n), np.ones(n)),
    }


@pytest.mark.parametrize("kind", wrong_shapes())
def test_fusing_scores_of_wrong_shapes_is_refused(kind: str) -> None:
    with pytest.raises(InputError):
        fuse(POINTS, *wrong_shapes()[kind], head=WEIGHTS)


def test_fusing_with_weights_without_a_head_is_refused(result: Segmentation) -> None:
    with pytest.raises(InputError, match="head"):
        fuse(POINTS, result.rv, result.bev, head=without(WEIGHTS, "point_head"))


def test_importing_the_package_does_not_import_torch() -> None:
    code = "import sys, amvnet, amvnet.cli.main; print({'torch', 'lightning', 'matplotlib', 'scipy'} & set(sys.modules))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "set()"


def test_every_exported_name_is_there() -> None:
    assert all(hasattr(amvnet, name) for name in amvnet.__all__)
    assert not hasattr(amvnet, "nothing")
