"""The paper's figures: a sweep of tau equals what weights with each tau give."""

from __future__ import annotations

import csv
from dataclasses import dataclass, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from matplotlib.image import imread

import amvnet
from amvnet.config.schema import Recipe
from amvnet.data.datasets.base import Dataset
from amvnet.data.datasets.open import open_dataset
from amvnet.data.taxonomy import SEMANTICKITTI
from amvnet.evaluation import analysis
from amvnet.evaluation.analysis import BINS, SWEPT_BINS, Analysis, analyze
from amvnet.evaluation.metrics import confusion, metrics
from amvnet.evaluation.scoring import evaluate, label_by_weights
from amvnet.inference.timing import run_once
from amvnet.models.methods import METHODS
from amvnet.progress import Reporter, report_nothing
from amvnet.runtime.distributed import Processes
from amvnet.sensors.intensity import PROBABILITIES
from amvnet.training import ablation
from amvnet.weights.file import Weights, load, save

from fixtures import tiny
from fixtures.commands import files, not_none, refused, succeed
from fixtures.tiny import fresh_weights, with_intensities, with_model, write_recipe, write_scan

K = 19
STREET = ("car", "road", "sidewalk", "building")  # the classes of the points
LAST_BIASES = ("range_net.scores.bias", "polar_net.scores.bias", "point_head.fc.1.bias")


@pytest.fixture(scope="module")
def weights() -> Weights:
    """Networks that tend to the classes of the streets, so that many labels are right."""
    weights = fresh_weights()
    found = [SEMANTICKITTI.classes.index(name) for name in STREET]
    tensors = dict(weights.tensors)
    for name in LAST_BIASES:
        bias = tensors[name].clone()
        bias.view(-1, K)[:, found] += 2
        tensors[name] = bias
    return replace(weights, tensors=tensors)


@pytest.fixture(scope="module")
def dataset(world: Path) -> Dataset:
    return open_dataset(f"semantickitti:{world / 'data'}")


def analyze_08(dataset: Dataset, weights: Weights) -> Analysis:
    return analyze(dataset, dataset.records(["08"]), amvnet.load(weights))


def figures_of(dataset: Dataset, weights: Weights) -> tuple[float, dict[str, Any]]:
    """Return the share of uncertain points and AMVNet's figures, scan by scan by the segmenter."""
    segmenter = amvnet.load(weights)
    matrix = np.zeros((K + 1, K + 1), np.int64)
    uncertain = []
    for record in dataset.records(["08"]):
        scan = dataset.read(record)
        result = segmenter(scan)
        matrix += confusion(not_none(scan.labels), result.labels, K)
        uncertain.append(result.uncertain)
    return float(np.concatenate(uncertain).mean()), metrics(matrix, dataset.taxonomy)


def column(path: Path, name: str) -> list[str]:
    with path.open() as file:
        return [row[name] for row in csv.DictReader(file)]


# ---- counts


@pytest.mark.parametrize("tau", [0.0, 0.31, 0.85, SWEPT_BINS / BINS])
def test_a_swept_tau_equals_weights_with_it(dataset: Dataset, weights: Weights, tau: float) -> None:
    value, uncertain, miou, accuracy = analyze_08(dataset, weights).sweep()[round(tau * BINS)]
    share, expected = figures_of(dataset, with_model(weights, "assertion", threshold=tau))
    assert value == pytest.approx(tau)

    # A point whose similarity is tau to the last bit may fall to either side.
    assert uncertain == pytest.approx(100 * share, abs=0.2)
    assert miou == pytest.approx(100 * expected["miou"], abs=0.2)
    assert accuracy == pytest.approx(100 * expected["accuracy"], abs=0.2)
    assert accuracy > 10  # far from nothing


def test_a_swept_tau_gives_what_weights_with_that_tau_give_if_the_head_has_only_disputed_points(
    dataset: Dataset, weights: Weights
) -> None:
    led = with_model(weights, "assertion", lead=1.3)
    _, _, miou, _ = analyze_08(dataset, led).sweep()[85]
    _, expected = figures_of(dataset, with_model(led, "assertion", threshold=0.85))
    assert miou == pytest.approx(100 * expected["miou"], abs=0.02)
    assert miou != pytest.approx(analyze_08(dataset, weights).sweep()[85][2], abs=0.02)


@pytest.mark.parametrize("are_matched", [False, True])
def test_points_that_no_network_sees_count_as_evaluate_counts_them(
    weights: Weights, tmp_path: Path, are_matched: bool
) -> None:
    if are_matched:
        weights = with_matched_intensities(weights)
    points, raw = tiny.street(1)
    points[::3, 0] = np.nan
    write_scan(tmp_path, "08", "000000", points, raw)
    dataset = open_dataset(f"semantickitti:{tmp_path}")
    records = dataset.records(["08"])

    segmenter = amvnet.load(weights)
    analyzed = analyze(dataset, records, segmenter)
    evaluation = analyzed.evaluation
    expected = evaluate(dataset, records, label_by_weights(segmenter, tuple(METHODS)))
    assert set(expected.matrices) - set(evaluation.matrices) == {"rv-knn"}
    for method, matrices in evaluation.matrices.items():
        np.testing.assert_array_equal(matrices, expected.matrices[method])
    assert (evaluation.points, evaluation.uncertain) == (expected.points, expected.uncertain)

    _, uncertain, _, _ = analyzed.sweep()[round(weights.model.assertion.threshold * BINS)]
    assert uncertain == pytest.approx(100 * expected.uncertain / expected.points, abs=0.5)


def test_a_tau_above_those_that_are_swept_is_analyzed(
    dataset: Dataset, weights: Weights, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(analysis, "SWEPT_BINS", 50)
    weights = with_model(weights, "assertion", threshold=0.8)
    analyzed = analyze_08(dataset, weights)
    evaluation = analyzed.evaluation
    assert analyzed.points[50:80].sum() > 0

    share, expected = figures_of(dataset, weights)
    assert evaluation.uncertain / evaluation.asked == pytest.approx(share)
    assert metrics(evaluation.matrices["amvnet"][0], dataset.taxonomy) == expected


def with_matched_intensities(weights: Weights) -> Weights:
    """Return weights that bring each scan's intensities to others, as simulated ones do."""
    quantiles = (np.linspace(0, 1, len(PROBABILITIES)) ** 3).tolist()
    return with_intensities(weights, quantiles, is_matched=True)


def test_a_scan_is_timed_as_it_is_segmented(dataset: Dataset, weights: Weights) -> None:
    scan = dataset.read(dataset.records(["08"])[0])
    written: list[np.ndarray] = []
    matched = amvnet.load(with_matched_intensities(weights))
    run_once(matched, lambda: scan, written.append)

    np.testing.assert_array_equal(written[0], matched(scan).labels)
    assert (written[0] != amvnet.load(weights)(scan).labels).any()


# ---- the command `analyze`


@pytest.mark.full
def test_analyze_writes_each_figure_as_picture_and_table(world: Path, tmp_path: Path) -> None:
    out = tmp_path
    succeed(f"analyze {world}/data --weights {world}/w.safetensors --out {out}")

    names = {"classes.csv", "methods.csv"}
    for figure in ("similarity", "distance", "tau"):
        names |= {f"{figure}.png", f"{figure}.csv"}
        picture = imread(out / f"{figure}.png")
        assert picture.shape[1] == 960
        assert picture[..., :3].std() > 0.05  # something is drawn
    assert files(out) == names

    assert sum(map(int, column(out / "similarity.csv", "points"))) == 1000
    simple = ["arithmetic mean", "maximum", "geometric mean"]
    assert column(out / "methods.csv", "method") == ["RV", "BEV", *simple, "AMVNet"]


@pytest.mark.full
def test_more_neighbours_are_swept_with_heads_of_their_own(world: Path, tmp_path: Path) -> None:
    out = tmp_path / "swept"
    options = f"--out {out} --neighbours 2,5 --recipe {world}/recipe.yaml"
    command = f"analyze {world}/data --weights {world}/w.safetensors {options}"
    succeed(command)
    assert column(out / "neighbours.csv", "neighbours") == ["2", "5"]

    # The networks are frozen, the heads are not.
    networks = load(world / "w.safetensors")
    two = load(out / "neighbours/2/weights.safetensors")
    five = load(out / "neighbours/5/weights.safetensors")
    assert two.model.point_head.neighbours == 2
    assert five.model.point_head.neighbours == 5
    name = "range_net.scores.weight"
    assert torch.equal(two.tensors[name], networks.tensors[name])
    assert torch.equal(five.tensors[name], networks.tensors[name])
    name = "point_head.mlp.0.weight"
    assert not torch.equal(two.tensors[name], five.tensors[name])

    # The heads are not trained a second time.
    two_last = out / "neighbours/2/head/last.safetensors"
    five_last = out / "neighbours/5/head/last.safetensors"
    two_time = two_last.stat().st_mtime_ns
    five_time = five_last.stat().st_mtime_ns
    succeed(f"{command} --overwrite")
    assert two_last.stat().st_mtime_ns == two_time
    assert five_last.stat().st_mtime_ns == five_time

    other = save(fresh_weights(seed=1), tmp_path / "other.safetensors")
    refused(f"{command} --overwrite".replace(f"{world}/w.safetensors", str(other)), "networks")


@pytest.mark.full
def test_taus_are_swept_with_heads_of_their_own(world: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    recipe = write_recipe(tmp_path / "short.yaml", training={"head": {"epochs": 1, "points": 200}})
    options = f"--out {out} --taus 1,0.5 --recipe {recipe}"
    succeed(f"analyze {world}/data --weights {world}/w.safetensors {options}")
    assert column(out / "taus.csv", "tau") == ["0.5", "1.0"]
    assert column(out / "taus.csv", "uncertain %")[1].startswith("100")

    half = load(out / "taus/0.5/weights.safetensors")
    every = load(out / "taus/1/weights.safetensors")
    assert half.model.assertion.threshold == 0.5
    assert every.model.assertion.threshold == 1
    name = "point_head.mlp.0.weight"
    assert not torch.equal(half.tensors[name], every.tensors[name])


def test_wrong_input_of_analyze_is_one_line(world: Path, tmp_path: Path) -> None:
    recipe = f"--recipe {world}/recipe.yaml"
    cases = [
        ("headless", "", "point_head"),
        ("w", "--neighbours 3", "--recipe"),
        ("w", "--taus 0.5", "--recipe"),
        ("w", f"--taus 1.5 {recipe}", "taus"),
        ("w", f"--neighbours 3,x {recipe}", "found 'x'"),
        ("w", f"--neighbours ² {recipe}", "²"),
        ("w", "--neighbours 3 --recipe nonsense", "nonsense"),
        ("w", f"--neighbours 3 {recipe} --split all", "both"),
        ("w", "--sequences 77", "77"),
    ]
    for name, options, word in cases:
        arguments = f"--weights {world}/{name}.safetensors --out {tmp_path}/none {options}"
        refused(f"analyze {world}/data {arguments}", word)
    assert not files(tmp_path)


# ---- the command `ablate`


@dataclass(frozen=True)
class PlanOfTwo:
    """The plan of the second of two processes, as far as `ablate` asks for it."""

    recipe: Recipe
    out: Path
    data: Any
    processes: Processes
    stage: str | None = None
    report: Reporter = report_nothing


def test_ablate_scores_on_the_gpu_of_its_process(monkeypatch: pytest.MonkeyPatch) -> None:
    devices = []
    evaluation = SimpleNamespace(matrices={"rv": np.ones((1, 20, 20))})
    monkeypatch.setattr(ablation, "choose_device", lambda name: "cuda")
    monkeypatch.setattr(ablation, "train", lambda plan: plan.out)
    monkeypatch.setattr(ablation, "load", lambda path, device, *_: devices.append(device))
    monkeypatch.setattr(ablation, "label_by_weights", lambda *_: None)
    monkeypatch.setattr(ablation, "evaluate", lambda *_, **options: evaluation)

    source = SimpleNamespace(dataset=SimpleNamespace(taxonomy=SEMANTICKITTI))
    data = SimpleNamespace(sources=[source], val=[])
    plan: Any = PlanOfTwo(Recipe(), Path("out"), data, Processes(rank=1, size=2, local_rank=1))
    assert len(list(ablation.ablate(plan, "auto"))) == 4
    assert devices == ["cuda:1"] * 4


@pytest.mark.full
def test_ablate_trains_four_networks_and_goes_on_later(world: Path, tmp_path: Path) -> None:
    out = tmp_path / "ablation"
    options = f"--out {out} --training.rv.epochs 1"
    command = f"ablate {world}/recipe.yaml --data {world}/data {options}"
    succeed(command)

    table = out / "ablation.csv"
    assert column(table, "GRU") == ["no", "yes", "no", "yes"]
    assert column(table, "class weights") == ["no", "no", "yes", "yes"]
    assert len(set(column(table, "accuracy %"))) > 1
    assert not load(out / "rv/weights.safetensors").model.range_net.gru
    assert load(out / "rv-gru-weights/weights.safetensors").model.range_net.gru

    # One network and the table are unfinished: the table becomes the same again.
    ends = {}
    for path in (out / "rv/rv/last.safetensors", out / "rv-gru/rv/last.safetensors"):
        ends[path] = path.read_bytes()[-1000:]
    text = (out / "ablation.csv").read_text()
    (out / "rv-gru/rv/done").unlink()
    (out / "ablation.csv").unlink()
    succeed(command)
    assert (out / "ablation.csv").read_text() == text

    other = tiny.make_streets(tmp_path / "data", ("02", "03", "08"))
    refused(command.replace(f"{world}/data", str(other)), "scans")
    for path, end in ends.items():
        assert path.read_bytes()[-1000:] == end
