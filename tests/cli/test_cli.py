"""The contract of the command line: exit codes, one line for a user's mistake, whole files in the promised places."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from amvnet.cli.main import VERBS, main
from amvnet.data.taxonomy import NUSCENES, SEMANTICKITTI
from amvnet.inference.segmenter import Segmenter
from amvnet.training import run as runner
from amvnet.weights.file import save

from fixtures.worlds import (
    GOLDEN,
    files,
    fresh_weights,
    make_streets,
    run_cli,
    street,
    without,
    write_recipe,
)

OVERALL = {"miou", "miou_present", "accuracy", "fwiou", "iou"}
RAW_IDS = set(SEMANTICKITTI.train_to_raw[1:])


@pytest.fixture(scope="module")
def world(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A data set, weights of two benchmarks, a recipe, lone scans good and bad; nothing may change them."""
    root = tmp_path_factory.mktemp("world")
    make_streets(root / "data")
    write_recipe(root / "recipe.yaml")
    save(fresh_weights(), root / "w.safetensors")
    save(fresh_weights(NUSCENES), root / "nuscenes.safetensors")
    save(without(fresh_weights(), "point_head"), root / "headless.safetensors")
    model = fresh_weights().model
    loss = replace(model, assertion=replace(model.assertion, name="loss"))
    save(replace(fresh_weights(), model=loss), root / "loss.safetensors")
    street(7, 300)[0].tofile(root / "lone.bin")
    (root / "empty.bin").write_bytes(b"")
    np.full((5, 4), np.nan, np.float32).tofile(root / "nan.bin")
    (root / "truncated.bin").write_bytes((root / "lone.bin").read_bytes()[:-3])
    shutil.copytree(root / "data", root / "mislabelled")
    label = root / "mislabelled/sequences/08/labels/000001.label"
    label.write_bytes(label.read_bytes()[:-4])
    (root / "latin1.yaml").write_bytes(b"taxonomy: \xff\xfe")
    (root / "loop.yaml").write_text(f"base: {root / 'loop.yaml'}")
    (root / "typo.yaml").write_text("base: semantickitti-compact\ntraining: {rv: {epoch: 3}}")
    return root


# ---- a user's mistakes


TRAIN = "train {w}/recipe.yaml --data {w}/data --out {out}"
PREDICT = "predict {w}/lone.bin --weights {w}/w.safetensors --out {out}"
MISTAKES = {
    "unknown verb": "segment {w}/lone.bin",
    "no arguments": "predict",
    "no weights": "predict {w}/lone.bin --out {out}",
    "no data": "train {w}/recipe.yaml --out {out}",
    "neither weights nor predictions": "evaluate {w}/data",
    "both weights and predictions": "evaluate {w}/data --weights {w}/w.safetensors --predictions {w}/data",
    "an argument too many": "info {w}/w.safetensors {w}/w.safetensors",
    "unknown option": PREDICT + " --colour red",
    "unknown method": PREDICT + " --method vote",
    "unknown device": PREDICT + " --device abacus",
    "unknown split": "evaluate {w}/data --weights {w}/w.safetensors --split best",
    "unknown stage": TRAIN + " --stage nose",
    "empty scan": "predict {w}/empty.bin --weights {w}/w.safetensors --out {out}",
    "scan of NaN alone": "predict {w}/nan.bin --weights {w}/w.safetensors --out {out}",
    "truncated scan": "predict {w}/truncated.bin --weights {w}/w.safetensors --out {out}",
    "weights that are no weights": "predict {w}/lone.bin --weights {w}/lone.bin --out {out}",
    "input not there": "predict {w}/lone.bin {w}/none.bin --weights {w}/w.safetensors --out {out}",
    "weights not there": "predict {w}/lone.bin --weights {w}/none --out {out}",
    "data not there": "evaluate {w}/none --weights {w}/w.safetensors",
    "predictions not there": "evaluate {w}/data --predictions {w}/none",
    "no prediction of a scan": "evaluate {w}/data --predictions {w}/data --json {out}/m.json",
    "output is a file": "predict {w}/lone.bin --weights {w}/w.safetensors --out {w}/w.safetensors",
    "run is a file": "train {w}/recipe.yaml --data {w}/data --stage rv --out {w}/w.safetensors",
    "same name twice": "predict {w}/lone.bin {w}/lone.bin --weights {w}/w.safetensors --out {out}",
    "weights of other classes": "predict {w}/data --weights {w}/nuscenes.safetensors --out {out}",
    "scored weights of other classes": "evaluate {w}/data --weights {w}/nuscenes.safetensors --json {out}/m.json",
    "init of other classes": TRAIN + " --stage rv --init {w}/nuscenes.safetensors",
    "init of other classes for the head": TRAIN + " --stage head --init {w}/nuscenes.safetensors",
    "recipe of other classes": "train nuscenes-compact --data {w}/data --out {out}",
    "weights without head": "predict {w}/data --weights {w}/headless.safetensors --out {out}",
    "missing sequence": "predict {w}/data --weights {w}/w.safetensors --out {out} --sequences 05",
    "missing sequence to score": "evaluate {w}/data --weights {w}/w.safetensors --sequences 05 --json {out}/m.json",
    "missing sequence to learn": TRAIN + " --train-sequences 05 --val-sequences 08",
    "wrong label count": "evaluate {w}/mislabelled --weights {w}/w.safetensors --json {out}/m.json",
    "learning what validates": TRAIN + " --train-sequences 00,08 --val-sequences 08",
    "head without networks": TRAIN + " --stage head",
    "more folds than sequences": TRAIN
    + " --stage head --init {w}/w.safetensors --training.head.folds 3",
    "unknown recipe": "train best --data {w}/data --out {out}",
    "unknown key in a recipe": "train {w}/typo.yaml --data {w}/data --out {out}",
    "recipe that is no text": "train {w}/latin1.yaml --data {w}/data --out {out}",
    "recipe based on itself": "train {w}/loop.yaml --data {w}/data --out {out}",
    "unknown key of a recipe": TRAIN + " --training.rv.colour red",
    "letters for a number": TRAIN + " --training.rv.epochs many",
    "no epochs": TRAIN + " --stage rv --training.rv.epochs 0",
    "negative epochs": TRAIN + " --stage rv --training.rv.epochs=-1",
    "empty batches": TRAIN + " --stage rv --training.rv.batch 0",
    "negative learning rate": TRAIN + " --stage rv --training.rv.lr=-1",
    "no warm-up": TRAIN + " --stage rv --training.rv.warmup 0",
    "no accumulation": TRAIN + " --stage rv --training.rv.accumulate 0",
    "negative workers": TRAIN + " --stage rv --training.workers=-1",
    "unknown accelerator": TRAIN + " --stage rv --training.accelerator abacus",
    "image without columns": TRAIN + " --stage rv --model.range_view.width 0",
    "sizes that do not fit each other": TRAIN + " --stage rv --model.range_net.widths [16,16]",
    "run below a file": "train {w}/recipe.yaml --data {w}/data --stage rv --out {w}/w.safetensors/run",
    "figures below a file": "evaluate {w}/data --weights {w}/w.safetensors --json {w}/lone.bin/m.json",
    "assertion that needs labels": "predict {w}/lone.bin --weights {w}/loss.safetensors --out {out}",
    "device without numbers": PREDICT + " --device meta",
    "unknown sensor": "simulate {out} --sensor eye",
    "nothing to time": "bench --weights {w}/w.safetensors --scan {w}/lone.bin --runs 0",
    "no head to time": "bench --weights {w}/headless.safetensors --scan {w}/lone.bin",
    "more than all points to time": "bench --weights {w}/w.safetensors --scan {w}/lone.bin --uncertain 2",
    "unknown engine to time": "bench --weights {w}/w.safetensors --scan {w}/lone.bin --engines tensorrt",
    "no scans": "simulate {out} --scans 0",
}


@pytest.mark.parametrize("mistake", MISTAKES)
def test_a_mistake_is_one_line_and_leaves_nothing(
    mistake: str, world: Path, tmp_path: Path
) -> None:
    before = files(world)
    code, error = run_cli(*MISTAKES[mistake].format(w=world, out=tmp_path / "out").split())
    assert (code, error.count("\n")) == (2, 1), error
    assert error.startswith("amvnet: ")
    assert files(world) == before
    left = files(tmp_path) - {
        "out/recipe.yaml",
        "out/run.yaml",
        "out/class_counts.npz",
    }  # a run says at once what it is
    assert not left


def test_a_run_with_wrong_labels_keeps_no_weights(world: Path, tmp_path: Path) -> None:
    arguments = ("--data", world / "mislabelled", "--stage", "rv", "--out", tmp_path)
    code, error = run_cli("train", world / "recipe.yaml", *arguments)
    assert code == 2
    assert error.splitlines()[-1].startswith("amvnet: ")
    assert "499" in error
    assert not [name for name in files(tmp_path) if name.endswith((".safetensors", "done"))]


def test_a_broken_scan_leaves_the_others_whole(world: Path, tmp_path: Path) -> None:
    inputs = (world / "lone.bin", world / "truncated.bin")
    assert (
        run_cli("predict", *inputs, "--weights", world / "w.safetensors", "--out", tmp_path)[0] == 3
    )
    assert files(tmp_path) == {"lone.label"}
    assert len(np.fromfile(tmp_path / "lone.label", np.uint32)) == 300


def test_without_a_verb_the_usage_is_shown(capsys: pytest.CaptureFixture[str]) -> None:
    assert main([]) == 2
    assert main(["--help"]) == 0
    shown = capsys.readouterr().out
    assert all(f"  {verb} " in shown for verb in VERBS)


@pytest.mark.parametrize("verb", VERBS)
def test_every_verb_has_help(verb: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as leave:
        main([verb, "--help"])
    assert leave.value.code == 0
    assert f"amvnet {verb}" in capsys.readouterr().out


@pytest.mark.parametrize(
    "order",
    [lambda recipe, rest: [recipe, *rest], lambda recipe, rest: [*rest, recipe]],
    ids=["first", "last"],
)
def test_a_recipe_counts_wherever_it_stands(
    order: Callable[..., list[Any]], world: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    made: list[runner.Run] = []
    monkeypatch.setattr(runner.Run, "stages", lambda self, *_: made.append(self) or tmp_path)
    code, _ = run_cli(
        "train", *order(world / "recipe.yaml", ["--data", world / "data", "--out", tmp_path])
    )
    assert code in (0, 2)
    if code == 0:
        assert made[0].recipe.model.range_view.width == 64
        assert made[0].recipe.training.rv.epochs == 3


# ---- predict


def test_a_data_set_is_segmented_into_the_benchmarks_layout(world: Path, tmp_path: Path) -> None:
    assert (
        run_cli("predict", world / "data", "--weights", world / "w.safetensors", "--out", tmp_path)[
            0
        ]
        == 0
    )
    scans = [
        f"sequences/{s}/predictions/{i:06d}.label" for s in ("00", "01", "08") for i in range(2)
    ]
    assert files(tmp_path) == set(scans)
    for name in scans:
        raw = np.fromfile(tmp_path / name, np.uint32)
        assert len(raw) == 500
        assert set(raw.tolist()) <= RAW_IDS


def test_lone_scans_are_segmented_by_name_as_the_segmenter_does(
    world: Path, tmp_path: Path
) -> None:
    assert (
        run_cli(
            "predict", world / "lone.bin", "--weights", world / "w.safetensors", "--out", tmp_path
        )[0]
        == 0
    )
    assert files(tmp_path) == {"lone.label"}
    points = np.fromfile(world / "lone.bin", np.float32).reshape(-1, 4)
    labels = Segmenter(str(world / "w.safetensors"))(points).labels
    assert np.array_equal(
        np.fromfile(tmp_path / "lone.label", np.uint32), SEMANTICKITTI.to_raw(labels)
    )


def test_scores_are_both_networks_probabilities_in_half_precision(
    world: Path, tmp_path: Path
) -> None:
    options = (
        "--weights",
        world / "w.safetensors",
        "--out",
        tmp_path,
        "--scores",
        "--sequences",
        "08",
    )
    assert run_cli("predict", world / "data", *options)[0] == 0
    folder = "sequences/08/predictions"
    assert files(tmp_path) == {
        f"{folder}/{i:06d}.{end}" for i in range(2) for end in ("label", "npz")
    }
    points = np.fromfile(world / "data/sequences/08/velodyne/000000.bin", np.float32).reshape(-1, 4)
    result = Segmenter(str(world / "w.safetensors"))(points)
    with np.load(tmp_path / folder / "000000.npz", allow_pickle=False) as kept:
        assert set(kept.files) == {"rv", "bev"}
        for name, scores in (("rv", result.rv), ("bev", result.bev)):
            assert (kept[name].dtype, kept[name].shape) == (np.float16, (500, 19))
            assert np.array_equal(kept[name], scores.astype(np.float16))


@pytest.mark.parametrize("method", ["rv", "bev", "ensemble"])
def test_weights_without_head_predict_by_the_other_methods(
    method: str, world: Path, tmp_path: Path
) -> None:
    options = ("--weights", world / "headless.safetensors", "--out", tmp_path, "--method", method)
    assert run_cli("predict", world / "lone.bin", *options)[0] == 0
    assert files(tmp_path) == {"lone.label"}


# ---- evaluate


@pytest.fixture(scope="module")
def scored(world: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What `evaluate --weights --json --pictures` wrote."""
    out = tmp_path_factory.mktemp("scored")
    options = (
        "--weights",
        world / "w.safetensors",
        "--json",
        out / "m.json",
        "--pictures",
        out / "pictures",
    )
    assert run_cli("evaluate", world / "data", *options)[0] == 0
    return out


def test_the_figures_have_the_contracts_structure(world: Path, scored: Path) -> None:
    figures = json.loads((scored / "m.json").read_text())
    assert set(figures) == {"dataset", "scans", "points", "uncertain_fraction", "methods"}
    assert (figures["scans"], figures["points"]) == (2, 1000)
    assert 0 < figures["uncertain_fraction"] < 1
    assert list(figures["methods"]) == ["rv", "bev", "ensemble", "amvnet"]
    for method in figures["methods"].values():
        assert set(method) == OVERALL | {"by_distance"}
        assert list(method["iou"]) == list(SEMANTICKITTI.classes)
        assert all(0 <= method[key] <= 1 for key in OVERALL - {"iou"})
        assert [(b["from_m"], b["to_m"]) for b in method["by_distance"]] == [
            (i, i + 10) for i in range(0, 50, 10)
        ]
        assert all(OVERALL | {"from_m", "to_m"} <= set(b) for b in method["by_distance"])


def test_pictures_are_drawn_and_nothing_else_is_left(scored: Path) -> None:
    assert files(scored) == {"m.json", "pictures/08_000000.png", "pictures/08_000001.png"}
    assert all(path.read_bytes().startswith(b"\x89PNG") for path in (scored / "pictures").iterdir())


@pytest.mark.parametrize("method", ["rv", "bev", "ensemble", "amvnet"])
def test_predictions_score_as_the_weights_that_made_them(
    method: str, world: Path, scored: Path, tmp_path: Path
) -> None:
    weights = ("--weights", world / "w.safetensors", "--method", method)
    assert (
        run_cli("predict", world / "data", *weights, "--out", tmp_path, "--sequences", "08")[0] == 0
    )
    assert (
        run_cli(
            "evaluate", world / "data", "--predictions", tmp_path, "--json", tmp_path / "m.json"
        )[0]
        == 0
    )
    figures = json.loads((tmp_path / "m.json").read_text())
    assert figures["uncertain_fraction"] is None
    assert figures["methods"] == {
        "predictions": json.loads((scored / "m.json").read_text())["methods"][method]
    }


def test_sequences_that_are_named_are_scored(world: Path, tmp_path: Path) -> None:
    options = (
        "--weights",
        world / "headless.safetensors",
        "--sequences",
        "00,01",
        "--json",
        tmp_path / "m.json",
    )
    assert run_cli("evaluate", world / "data", *options)[0] == 0
    figures = json.loads((tmp_path / "m.json").read_text())
    assert figures["scans"] == 4
    assert list(figures["methods"]) == ["rv", "bev", "ensemble"]


@pytest.mark.parametrize(("name", "predictions"), [("semantickitti", "."), ("nuscenes", "results")])
def test_the_golden_sets_score_as_the_official_tools_say(
    name: str, predictions: str, tmp_path: Path
) -> None:
    data, out = GOLDEN / name, tmp_path / "m.json"
    assert (
        run_cli("evaluate", f"{name}:{data}", "--predictions", data / predictions, "--json", out)[0]
        == 0
    )
    ours = json.loads(out.read_text())["methods"]["predictions"]
    said = json.loads((data / "expected.json").read_text())
    expected = (
        {"miou": said["miou"], "iou": said["iou_per_class"]} if name == "nuscenes" else said["all"]
    )
    assert ours["miou"] == pytest.approx(expected["miou"], abs=1e-9)
    assert set(ours["iou"]) == set(expected["iou"]) - {"ignore"}
    for label, value in ours["iou"].items():
        assert (value or 0) == pytest.approx(expected["iou"][label] or 0, abs=1e-9)


# ---- info


def test_info_says_what_the_weights_are(world: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["info", str(world / "w.safetensors")]) == 0
    shown = capsys.readouterr().out
    words = (
        "19 of semantickitti",
        "16 x 64",
        "range_net",
        "polar_net",
        "point_head",
        "| 50.0 |",
        "amvnet.load",
    )
    assert all(word in shown for word in words)


def test_info_says_what_is_installed(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["info"]) == 0
    shown = capsys.readouterr().out
    assert all(word in shown for word in ("torch", "lightning", "semantickitti-compact", "cpu"))


# ---- bench


def test_bench_times_every_stage(world: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert (
        main(
            [
                "bench",
                "--weights",
                f"{world}/w.safetensors",
                "--scan",
                f"{world}/lone.bin",
                "--runs",
                "1",
            ]
        )
        == 0
    )
    shown = " ".join(capsys.readouterr().out.split())
    assert all(
        stage in shown
        for stage in ("300 points", "read", "RV", "BEV", "neighbours", "head", "fusion", "limit")
    )


def test_benchs_figures_add_up(world: Path, tmp_path: Path) -> None:
    command = (
        f"bench --weights {world}/w.safetensors --scan {world}/lone.bin --runs 3 --uncertain 0.25"
    )
    assert main([*command.split(), "--json", str(tmp_path / "b.json")]) == 0
    (found,) = json.loads((tmp_path / "b.json").read_text())
    assert (found["points"], found["uncertain"], found["runs"]) == (300, 75, 3)
    stages = {name: spread["median"] for name, spread in found["stages_ms"].items()}
    assert all(
        spread["low"] <= spread["median"] <= spread["high"]
        for spread in found["stages_ms"].values()
    )
    mean = stages.pop("mean")
    assert 0 < mean < sum(stages.values())
    assert sum(stages.values()) == pytest.approx(found["all_ms"]["median"], rel=0.5)
    for name in ("RV", "BEV"):
        network = found["networks"][name]
        assert network["gflop_per_s"] == pytest.approx(network["gflop"] / stages[name] * 1e3)
        assert network["share_of_limit"] == pytest.approx(
            network["gflop_per_s"] / found["limit_gflop_per_s"]["float32"]
        )
    assert found["peak_memory_mib"] > 100


def test_bench_times_a_recipe_with_random_weights(
    tmp_path: Path, world: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert (
        main(
            [
                "bench",
                "--recipe",
                f"{world}/recipe.yaml",
                "--scan",
                f"{world}/lone.bin",
                "--runs",
                "1",
            ]
        )
        == 0
    )
    assert "10.0% of them uncertain" in " ".join(capsys.readouterr().out.split())
