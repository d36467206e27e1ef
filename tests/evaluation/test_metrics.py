"""The figures equal those of both official tools, and counting keeps its laws."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from amvnet.data.datasets.open import open_dataset
from amvnet.data.taxonomy import NUSCENES, SEMANTICKITTI, Taxonomy
from amvnet.errors import InputError
from amvnet.evaluation.metrics import Evaluation, confusion, metrics

GOLDEN = Path(__file__).parents[1] / "golden"


def golden(name: str, predictions: str) -> tuple[dict[str, Any], dict[str, Any]]:
    """(the report of this package, what the official tool printed)."""
    dataset = open_dataset(f"{name}:{GOLDEN / name}")
    evaluation = Evaluation(dataset.taxonomy)
    for record in dataset.records(dataset.sequences("val")):
        scan = dataset.read(record)
        assert scan.labels is not None
        prediction = dataset.read_prediction(record, GOLDEN / name / predictions)
        evaluation.add(scan.points, scan.labels, {"predictions": prediction})
    return evaluation.report(name), json.loads((GOLDEN / name / "expected.json").read_text())


def same(ours: dict[str, Any], theirs: dict[str, Any]) -> None:
    assert ours["miou"] == pytest.approx(theirs["miou"], abs=1e-9)
    assert ours["accuracy"] == pytest.approx(theirs["accuracy"], abs=1e-9)
    assert list(ours["iou"]) == list(theirs["iou"])
    for name, value in theirs["iou"].items():
        assert (ours["iou"][name] or 0.0) == pytest.approx(value, abs=1e-9)


def test_semantickitti_equals_the_official_tools() -> None:
    report, expected = golden("semantickitti", "")
    figures = report["methods"]["predictions"]
    same(figures, expected["all"])
    assert len(figures["by_distance"]) == len(expected["by_distance"])
    for ours, theirs in zip(figures["by_distance"], expected["by_distance"], strict=True):
        same(ours, theirs)
        assert (ours["from_m"], ours["to_m"]) == (round(theirs["from_m"]), theirs["to_m"])
        assert ours["points"] > 0


def test_nuscenes_equals_the_official_tool() -> None:
    report, expected = golden("nuscenes", "results")
    figures = report["methods"]["predictions"]
    assert figures["miou"] == pytest.approx(expected["miou"], abs=1e-9)
    assert figures["fwiou"] == pytest.approx(expected["freq_weighted_iou"], abs=1e-9)
    for name, value in figures["iou"].items():
        assert value == (
            None
            if expected["iou_per_class"][name] is None
            else pytest.approx(expected["iou_per_class"][name])
        )


def draw(
    seed: int, count: int = 500, size: int = 16
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    points = rng.normal(0, 20, (count, 4)).astype(np.float32)
    truth, prediction = rng.integers(0, size + 1, (2, count)).astype(np.uint8)
    return points, truth, prediction, rng.random(count) < 0.2


def test_confusion_equals_a_plain_loop() -> None:
    _, truth, prediction, _ = draw(0)
    expected = np.zeros((17, 17), dtype=np.int64)
    for t, p in zip(truth, prediction, strict=True):
        expected[t, p] += 1
    np.testing.assert_array_equal(confusion(truth, prediction, 16), expected)


@pytest.mark.parametrize("taxonomy", [SEMANTICKITTI, NUSCENES], ids=lambda t: t.name)
def test_metrics_equal_plain_loops(taxonomy: Taxonomy) -> None:
    _, truth, prediction, _ = draw(1, size=taxonomy.size)
    truth[truth == 3] = 0  # class 3 is only predicted, class 5 is in neither
    truth[truth == 5], prediction[prediction == 5] = 0, 1
    pairs = [(t, p) for t, p in zip(truth.tolist(), prediction.tolist(), strict=True) if t]
    ious: dict[int, float | None] = {}
    for c in range(1, taxonomy.size + 1):
        union = sum(c in pair for pair in pairs)
        ious[c] = sum(pair == (c, c) for pair in pairs) / union if union else None
    found = metrics(confusion(truth, prediction, taxonomy.size), taxonomy)
    assert list(found["iou"].values()) == pytest.approx(list(ious.values()))
    assert ious[5] is None
    counted = [v for v in ious.values() if v is not None]
    divisor = taxonomy.size if taxonomy.counts_absent else taxonomy.size - 1
    assert found["miou"] == pytest.approx(sum(counted) / divisor)
    assert found["miou_present"] == pytest.approx(sum(counted) / (taxonomy.size - 2))
    assert found["accuracy"] == pytest.approx(np.mean([t == p for t, p in pairs if p]))
    assert found["fwiou"] == pytest.approx(np.mean([ious[t] or 0.0 for t, _ in pairs]))


def test_perfect_prediction_scores_one() -> None:
    ids = np.arange(17)
    found = metrics(confusion(ids, ids, 16), NUSCENES)
    assert all(found[key] == 1.0 for key in ("miou", "miou_present", "accuracy", "fwiou"))


def test_nothing_to_count_is_none_not_a_number() -> None:
    found = metrics(np.zeros((17, 17), dtype=np.int64), NUSCENES)
    assert found["miou"] is found["accuracy"] is found["fwiou"] is None
    assert set(found["iou"].values()) == {None}
    json.dumps(found, allow_nan=False)


def evaluate(*scans: tuple[np.ndarray, ...]) -> Evaluation:
    evaluation = Evaluation(NUSCENES)
    for points, truth, prediction, uncertain in scans:
        evaluation.add(points, truth, {"amvnet": prediction, "rv": truth}, uncertain)
    return evaluation


def test_halves_add_up() -> None:
    whole, a, b = evaluate(draw(2), draw(3)), evaluate(draw(2)), evaluate(draw(3))
    assert (a + b).report("x") == whole.report("x")
    assert a.scans == 1  # the sum left its parts alone
    a.merge(b)
    assert a.report("x") == whole.report("x")


def test_order_of_the_points_changes_nothing() -> None:
    scan = draw(4)
    order = np.random.default_rng(0).permutation(len(scan[0]))
    shuffled = [part[order] for part in scan]
    assert evaluate(scan).report("x") == evaluate(tuple(shuffled)).report("x")


def test_report_has_the_keys_of_the_contract() -> None:
    scan = draw(5)
    report = evaluate(scan).report("nuscenes:here")
    assert list(report) == ["dataset", "scans", "points", "uncertain_fraction", "methods"]
    assert (report["dataset"], report["scans"], report["points"]) == ("nuscenes:here", 1, 500)
    assert report["uncertain_fraction"] == pytest.approx(scan[3].mean())
    assert set(report["methods"]["amvnet"]) == {
        "miou",
        "miou_present",
        "accuracy",
        "fwiou",
        "iou",
        "by_distance",
    }
    assert {"from_m", "to_m", "miou", "accuracy", "points"} <= set(
        report["methods"]["rv"]["by_distance"][0]
    )
    json.dumps(report, allow_nan=False)


def test_uncertain_fraction_is_null_where_nothing_says_so() -> None:
    points, truth, prediction, _ = draw(6)
    evaluation = Evaluation(NUSCENES)
    evaluation.add(points, truth, {"predictions": prediction})
    assert evaluation.report("x")["uncertain_fraction"] is None


def test_distance_bins_are_open_at_both_ends() -> None:
    points = np.array(
        [[0, 0, 0, 0], [0, 0, 1, 0], [10, 0, 0, 0], [0, 10.5, 0, 0], [60, 0, 0, 0]],
        dtype=np.float32,
    )
    ids = np.ones(5, dtype=np.uint8)
    evaluation = Evaluation(NUSCENES)
    evaluation.add(points, ids, {"rv": ids})
    assert [b["points"] for b in evaluation.report("x")["methods"]["rv"]["by_distance"]] == [
        1,
        1,
        0,
        0,
        0,
    ]


def test_what_does_not_fit_is_refused() -> None:
    with pytest.raises(InputError, match="one predicted id"):
        confusion(np.zeros(3, int), np.zeros(4, int), 16)
    with pytest.raises(InputError, match=r"0\.\.16"):
        confusion(np.zeros(1, int), np.full(1, 17), 16)
    with pytest.raises(InputError, match="merge"):
        Evaluation(NUSCENES).merge(Evaluation(SEMANTICKITTI))
