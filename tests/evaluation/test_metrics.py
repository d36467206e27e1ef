"""The figures equal those of both official tools, and counts add up."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from amvnet.data.datasets.open import open_dataset
from amvnet.data.taxonomy import NUSCENES, SEMANTICKITTI, Taxonomy
from amvnet.evaluation.metrics import Evaluation, confusion, metrics

from fixtures.commands import fails, not_none

GOLDEN = Path(__file__).parents[1] / "golden"


# ---- the official tools


def golden_report(name: str, predictions: str) -> dict[str, Any]:
    dataset = open_dataset(f"{name}:{GOLDEN / name}")
    evaluation = Evaluation(dataset.taxonomy)
    for record in dataset.records(dataset.sequences("val")):
        scan = dataset.read(record)
        prediction = dataset.read_prediction(record, GOLDEN / name / predictions)
        evaluation.add(scan.points, not_none(scan.labels), {"predictions": prediction})

    return evaluation.report(name)


def official_figures(name: str) -> dict[str, Any]:
    return dict(json.loads((GOLDEN / name / "expected.json").read_text()))


def assert_same_figures(ours: dict[str, Any], theirs: dict[str, Any]) -> None:
    assert ours["miou"] == pytest.approx(theirs["miou"], abs=1e-9)
    assert ours["accuracy"] == pytest.approx(theirs["accuracy"], abs=1e-9)

    assert list(ours["iou"]) == list(theirs["iou"])
    for name, value in theirs["iou"].items():
        assert (ours["iou"][name] or 0.0) == pytest.approx(value, abs=1e-9)


def test_semantickitti_equals_the_official_tools() -> None:
    figures = golden_report("semantickitti", "")["methods"]["predictions"]
    expected = official_figures("semantickitti")
    assert_same_figures(figures, expected["all"])

    assert len(figures["by_distance"]) == len(expected["by_distance"])
    for ours, theirs in zip(figures["by_distance"], expected["by_distance"], strict=True):
        assert_same_figures(ours, theirs)
        assert (ours["from_m"], ours["to_m"]) == (round(theirs["from_m"]), theirs["to_m"])
        assert ours["points"] > 0


def test_nuscenes_equals_the_official_tool() -> None:
    figures = golden_report("nuscenes", "results")["methods"]["predictions"]
    expected = official_figures("nuscenes")

    assert figures["miou"] == pytest.approx(expected["miou"], abs=1e-9)
    assert figures["fwiou"] == pytest.approx(expected["freq_weighted_iou"], abs=1e-9)

    for name, iou in figures["iou"].items():
        expected_iou = expected["iou_per_class"][name]
        if expected_iou is None:
            assert iou is None
        else:
            assert iou == pytest.approx(expected_iou)


# ---- the formulas


@dataclass
class Example:
    points: np.ndarray
    truth: np.ndarray
    prediction: np.ndarray
    uncertain: np.ndarray


def random_example(seed: int, count: int = 500, size: int = 16) -> Example:
    rng = np.random.default_rng(seed)
    points = rng.normal(0, 20, (count, 4)).astype(np.float32)
    truth, prediction = rng.integers(0, size + 1, (2, count)).astype(np.uint8)
    return Example(points, truth, prediction, uncertain=rng.random(count) < 0.2)


@pytest.mark.parametrize("taxonomy", [SEMANTICKITTI, NUSCENES], ids=lambda t: t.name)
def test_metrics_equal_plain_loops(taxonomy: Taxonomy) -> None:
    example = random_example(1, size=taxonomy.size)
    truth = example.truth
    prediction = example.prediction
    truth[truth == 3] = 0  # class 3 is only predicted
    truth[truth == 5] = 0  # class 5 is neither in the truth nor predicted
    prediction[prediction == 5] = 1

    pairs = []
    for true_id, predicted_id in zip(truth.tolist(), prediction.tolist(), strict=True):
        if true_id > 0:
            pairs.append((true_id, predicted_id))

    ious: dict[int, float | None] = {}
    total = 0.0
    for class_id in range(1, taxonomy.size + 1):
        union = sum(class_id in pair for pair in pairs)
        hits = pairs.count((class_id, class_id))
        ious[class_id] = hits / union if union else None
        total += ious[class_id] or 0.0

    assert ious[5] is None

    figures = metrics(confusion(truth, prediction, taxonomy.size), taxonomy)
    assert list(figures["iou"].values()) == pytest.approx(list(ious.values()))
    divisor = taxonomy.size if taxonomy.counts_absent else taxonomy.size - 1
    assert figures["miou"] == pytest.approx(total / divisor)
    assert figures["miou_present"] == pytest.approx(total / (taxonomy.size - 2))

    correct = []
    iou_of_points = []
    for true_id, predicted_id in pairs:
        iou_of_points.append(ious[true_id] or 0.0)
        if predicted_id > 0 or not taxonomy.counts_absent:
            correct.append(true_id == predicted_id)
    assert figures["accuracy"] == pytest.approx(np.mean(correct))
    assert figures["fwiou"] == pytest.approx(np.mean(iou_of_points))


def test_nothing_to_count_is_none_not_a_number() -> None:
    figures = metrics(np.zeros((17, 17), dtype=np.int64), NUSCENES)
    for key in ("miou", "miou_present", "accuracy", "fwiou"):
        assert figures[key] is None

    assert set(figures["iou"].values()) == {None}
    json.dumps(figures, allow_nan=False)


# ---- evaluations of several scans


def evaluate(*examples: Example) -> Evaluation:
    evaluation = Evaluation(NUSCENES)
    for example in examples:
        predictions = {"amvnet": example.prediction, "rv": example.truth}
        evaluation.add(example.points, example.truth, predictions, example.uncertain)

    return evaluation


def test_halves_add_up() -> None:
    whole = evaluate(random_example(2), random_example(3))
    first = evaluate(random_example(2))
    second = evaluate(random_example(3))

    assert (first + second).report("x") == whole.report("x")
    assert first.scans == 1  # the sum left its parts alone


def test_report_has_the_keys_of_the_contract() -> None:
    example = random_example(5)
    report = evaluate(example).report("nuscenes:here")

    assert list(report) == ["dataset", "scans", "points", "uncertain_fraction", "methods"]
    assert (report["dataset"], report["scans"], report["points"]) == ("nuscenes:here", 1, 500)
    assert report["uncertain_fraction"] == pytest.approx(example.uncertain.mean())

    figures = {"miou", "miou_present", "accuracy", "fwiou", "iou"}
    assert set(report["methods"]["amvnet"]) == {*figures, "by_distance"}
    nearest, *_, farthest = report["methods"]["rv"]["by_distance"]
    assert (nearest["from_m"], farthest["to_m"]) == (0, 50)
    assert {"from_m", "to_m", "miou", "accuracy", "points"} <= set(nearest)
    json.dumps(report, allow_nan=False)


def test_distance_bins_are_open_at_both_ends() -> None:
    xyz = [(0, 0, 0), (0, 0, 1), (10, 0, 0), (0, 10.5, 0), (60, 0, 0)]
    points = np.column_stack([xyz, np.zeros(5)]).astype(np.float32)
    ids = np.ones(5, dtype=np.uint8)
    evaluation = Evaluation(NUSCENES)
    evaluation.add(points, ids, {"rv": ids})

    bins = evaluation.report("x")["methods"]["rv"]["by_distance"]
    assert [extent["points"] for extent in bins] == [1, 1, 0, 0, 0]


def test_what_does_not_fit_is_refused_and_not_counted() -> None:
    fails(lambda: confusion(np.zeros(3, int), np.zeros(4, int), 16), "of one shape")
    fails(lambda: confusion(np.zeros(1, int), np.full(1, 17), 16), "0..16")

    evaluation = Evaluation(NUSCENES)
    ids = np.ones(1, int)
    fails(lambda: evaluation.add(np.ones((1, 3)), ids, {"rv": ids, "bev": ids + 16}), "0..16")
    assert evaluation.scans == 0
    assert not evaluation.matrices
