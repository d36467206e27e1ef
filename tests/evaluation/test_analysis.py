"""The paper's figures: swept without asking the networks again, they equal what asking them gives."""

from __future__ import annotations

import csv
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from matplotlib.image import imread

from amvnet.config.schema import AssertionConfig
from amvnet.data.datasets.open import open_dataset
from amvnet.evaluation import analysis
from amvnet.evaluation import scoring as jobs
from amvnet.evaluation.analysis import BINS, SWEPT, analyze
from amvnet.evaluation.metrics import confusion, metrics
from amvnet.inference.segmenter import Segmenter
from amvnet.models.methods import arithmetic_mean, maximum
from amvnet.weights.file import Weights, load, save

from fixtures.worlds import (
    files,
    fresh_weights,
    make_streets,
    run_cli,
    street,
    without,
    write_recipe,
    write_scan,
)


@pytest.fixture(scope="module")
def world(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("world")
    make_streets(root / "data")
    write_recipe(root / "recipe.yaml")
    save(fresh_weights(), root / "weights.safetensors")
    options = ("--data", root / "data", "--out", root / "run", "--training.head.epochs", 4)
    assert run_cli("train", root / "recipe.yaml", *options) == (0, "")
    return root


@pytest.fixture(scope="module")
def weights(world: Path) -> Weights:
    """Networks that have learnt a little, so that there is an mIoU to speak of."""
    return load(world / "run")


def with_tau(weights: Weights, tau: float) -> Weights:
    return replace(
        weights, model=replace(weights.model, assertion=AssertionConfig("disagreement", tau))
    )


def figures_of(world: Path, weights: Weights) -> tuple[float, dict[str, Any]]:
    """The share of uncertain points and AMVNet's figures, scan by scan through the segmenter."""
    dataset, segmenter = open_dataset(f"semantickitti:{world / 'data'}"), Segmenter(weights)
    matrix, uncertain = 0, []
    for record in dataset.records(["08"]):
        scan = dataset.read(record)
        result = segmenter(scan)
        matrix = matrix + confusion(scan.labels, result.labels, 19)
        uncertain.append(result.uncertain)
    return float(np.concatenate(uncertain).mean()), metrics(matrix, dataset.taxonomy)


@pytest.mark.parametrize("tau", [0.0, 0.31, 0.85, SWEPT / BINS])
def test_a_swept_tau_gives_what_weights_with_that_tau_give(
    world: Path, weights: Weights, tau: float
) -> None:
    dataset = open_dataset(f"semantickitti:{world / 'data'}")
    found = analyze(dataset, dataset.records(["08"]), Segmenter(weights))
    swept = found.sweep()[round(tau * BINS)]
    share, expected = figures_of(world, with_tau(weights, tau))
    assert swept.value == pytest.approx(tau)
    # A point whose similarity is tau to the last bit may fall to either side.
    assert swept.uncertain == pytest.approx(share, abs=0.002)
    assert swept.miou == pytest.approx(expected["miou"], abs=0.002)
    assert swept.accuracy == pytest.approx(expected["accuracy"], abs=0.002)
    assert swept.miou > 0.02


def test_points_that_no_network_sees_count_as_evaluate_counts_them(
    weights: Weights, tmp_path: Path
) -> None:
    points, raw = street(1)
    points[::3, 0] = np.nan
    write_scan(tmp_path, "08", "000000", points, raw)
    dataset = open_dataset(f"semantickitti:{tmp_path}")
    segmenter, records = Segmenter(weights), dataset.records(["08"])
    found = analyze(dataset, records, segmenter)
    expected = jobs.evaluate(dataset, records, jobs.label_by_weights(dataset, segmenter))
    for name, stack in expected.matrices.items():
        np.testing.assert_array_equal(found.evaluation.matrices[name], stack)
    assert (found.evaluation.points, found.evaluation.uncertain) == (
        expected.points,
        expected.uncertain,
    )
    tau = round(weights.model.assertion.threshold * BINS)
    assert found.sweep()[tau].uncertain == pytest.approx(
        expected.uncertain / expected.points, abs=0.005
    )


def test_a_tau_above_those_that_are_swept_is_analyzed(
    world: Path, weights: Weights, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(analysis, "SWEPT", 50)
    dataset = open_dataset(f"semantickitti:{world / 'data'}")
    found = analyze(dataset, dataset.records(["08"]), Segmenter(with_tau(weights, 0.8)))
    share, expected = figures_of(world, with_tau(weights, 0.8))
    assert found.points[50:80].sum() > 0
    assert found.evaluation.uncertain / found.evaluation.asked == pytest.approx(share)
    assert metrics(found.evaluation.matrices["amvnet"][0], dataset.taxonomy) == expected


def test_every_method_is_scored_as_by_the_segmenter(world: Path, weights: Weights) -> None:
    dataset = open_dataset(f"semantickitti:{world / 'data'}")
    matrices = analyze(dataset, dataset.records(["08"]), Segmenter(weights)).evaluation.matrices
    expected = dict.fromkeys(matrices, 0)
    for record in dataset.records(["08"]):
        scan = dataset.read(record)
        result = Segmenter(weights)(scan)
        f, g = torch.from_numpy(result.rv), torch.from_numpy(result.bev)
        scores = {
            "rv": f,
            "bev": g,
            "ensemble": torch.sqrt(f * g),
            "amvnet": torch.from_numpy(result.scores),
        }
        scores |= {"arithmetic": arithmetic_mean(f, g), "maximum": maximum(f, g)}
        for name, values in scores.items():
            expected[name] = expected[name] + confusion(
                scan.labels, values.argmax(dim=1).numpy() + 1, 19
            )
    for name, stack in matrices.items():
        np.testing.assert_array_equal(stack[0], expected[name])


def test_analyze_writes_each_figure_as_picture_table_and_text(world: Path) -> None:
    out = world / "figures"
    code, error = run_cli(
        "analyze", world / "data", "--weights", world / "weights.safetensors", "--out", out
    )
    assert code == 0, error
    drawn = {"similarity", "distance", "tau"}
    assert files(out) == {f"{n}.{e}" for n in drawn for e in ("png", "csv", "md")} | {
        f"{n}.{e}" for n in ("classes", "methods") for e in ("csv", "md")
    }
    for name in drawn:
        picture = imread(out / f"{name}.png")
        assert picture.shape[1] == 960
        assert picture[..., :3].std() > 0.05
    with (out / "similarity.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert sum(int(row["points"]) for row in rows) == 1000
    with (out / "methods.csv").open() as file:
        assert [row["method"] for row in csv.DictReader(file)] == [
            "RV", "BEV", "arithmetic mean", "maximum", "geometric mean", "AMVNet",
        ]  # fmt: skip


def test_more_neighbours_are_swept_with_heads_of_their_own(world: Path) -> None:
    out, weights = world / "swept", world / "weights.safetensors"
    arguments = (
        "analyze",
        world / "data",
        "--weights",
        weights,
        "--out",
        out,
        "--neighbours",
        "2,5",
    )
    arguments += ("--recipe", world / "recipe.yaml")
    code, error = run_cli(*arguments)
    assert code == 0, error
    trained = {n: load(out / "neighbours" / str(n) / "weights.safetensors") for n in (2, 5)}
    given = load(weights)
    for n, found in trained.items():
        assert found.model.point_head.neighbours == n
        assert torch.equal(
            found.tensors["range_net.scores.weight"], given.tensors["range_net.scores.weight"]
        )  # the networks are frozen
    with (out / "neighbours.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [int(row["neighbours"]) for row in rows] == [2, 5]
    name = "point_head.mlp.0.weight"
    assert not torch.equal(trained[2].tensors[name], trained[5].tensors[name])
    lasts = [out / "neighbours" / n / "head" / "last.safetensors" for n in "25"]
    before = [last.stat().st_mtime_ns for last in lasts]
    assert run_cli(*arguments) == (0, "")
    assert [last.stat().st_mtime_ns for last in lasts] == before  # not trained again
    save(fresh_weights(seed=1), world / "other.safetensors")
    code, error = run_cli(*(world / "other.safetensors" if a == weights else a for a in arguments))
    assert (code, error.count("\n")) == (2, 1)
    assert "networks" in error


def test_ablate_trains_four_networks_and_goes_on_where_it_stopped(world: Path) -> None:
    out = world / "ablation"
    arguments = (
        "ablate",
        world / "recipe.yaml",
        "--data",
        world / "data",
        "--out",
        out,
        "--training.rv.epochs",
        1,
    )
    code, error = run_cli(*arguments)
    assert code == 0, error
    with (out / "ablation.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [(row["GRU"], row["class weights"]) for row in rows] == [
        ("no", "no"), ("yes", "no"), ("no", "yes"), ("yes", "yes"),
    ]  # fmt: skip
    assert len({row["accuracy %"] for row in rows}) > 1
    assert not load(out / "rv" / "weights.safetensors").model.range_net.gru
    assert load(out / "rv-gru-weights" / "weights.safetensors").model.range_net.gru
    kept = {
        name: (out / name / "rv" / "last.safetensors").read_bytes() for name in ("rv", "rv-gru")
    }
    table = (out / "ablation.md").read_text()
    (out / "rv-gru" / "rv" / "done").unlink()
    (out / "ablation.md").unlink()
    assert run_cli(*arguments) == (0, "")
    assert (out / "ablation.md").read_text() == table
    make_streets(world / "data2", ("02", "03", "08"))
    code, error = run_cli(*(world / "data2" if a == world / "data" else a for a in arguments))
    assert (code, error.count("\n")) == (2, 1)
    assert "scans" in error
    for name, content in kept.items():
        assert (out / name / "rv" / "last.safetensors").read_bytes()[-1000:] == content[-1000:]


def test_wrong_input_of_analyze_is_one_line(world: Path) -> None:
    save(without(fresh_weights(), "point_head"), world / "headless.safetensors")
    entropy = replace(
        fresh_weights(),
        model=replace(fresh_weights().model, assertion=AssertionConfig("entropy", 0.7)),
    )
    save(entropy, world / "entropy.safetensors")
    whole = world / "weights.safetensors"
    cases = [
        (world / "headless.safetensors", (), "point_head"),
        (world / "entropy.safetensors", (), "disagreement"),
        (whole, ("--neighbours", "3"), "--recipe"),
        (whole, ("--neighbours", "3,x", "--recipe", world / "recipe.yaml"), "3,x"),
        (whole, ("--neighbours", "²", "--recipe", world / "recipe.yaml"), "²"),
        (whole, ("--neighbours", "3", "--recipe", "nonsense"), "nonsense"),
        (whole, ("--neighbours", "3", "--recipe", world / "recipe.yaml", "--split", "all"), "both"),
        (whole, ("--sequences", "77"), "77"),
    ]
    for weights, options, word in cases:
        code, error = run_cli(
            "analyze", world / "data", "--weights", weights, "--out", world / "none", *options
        )
        assert code == 2
        assert error.count("\n") == 1
        assert word in error
    assert not files(world / "none")
