"""The contract of the command line: exit codes, one line for a mistake, complete files."""

from __future__ import annotations

import itertools
import json
import re
import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from importlib import import_module
from importlib.metadata import metadata
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from rich.console import Console

import amvnet
from amvnet.cli import tables
from amvnet.cli.main import COMMANDS, GROUPS, main
from amvnet.cli.tables import EXTRAS
from amvnet.config.recipes import recipe_names
from amvnet.inference import timing
from amvnet.inference.journal import Entry
from amvnet.inference.pipeline import Pipeline
from amvnet.sensors.lidars import KNOWN_SENSORS
from amvnet.training import run as training_run
from amvnet.training.plan import Plan
from amvnet.weights.file import built_in

from fixtures.commands import files, refusal, refused, run_cli, succeed
from fixtures.marks import with_quick
from fixtures.tiny import GOLDEN

predict_command = import_module("amvnet.cli.commands.predict")


@pytest.fixture(scope="module")
def wrong(world: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder that no test may change: recipes that are wrong, and a dataset with wrong labels."""
    root = tmp_path_factory.mktemp("wrong")
    (root / "latin1.yaml").write_bytes(b"taxonomy: \xff\xfe")
    (root / "loop.yaml").write_text(f"base: {root / 'loop.yaml'}")
    (root / "typo.yaml").write_text("base: semantickitti-compact\ntraining: {rv: {epoch: 3}}")

    shutil.copytree(world / "data", root / "mislabelled")
    labels = root / "mislabelled/sequences/08/labels/000001.label"
    labels.write_bytes(labels.read_bytes()[:-4])
    return root


def read_json(path: Path) -> Any:
    return json.loads(path.read_text())


# ---- a user's mistakes


@pytest.mark.parametrize(
    "command",
    [
        "predict {w}/none.bin --weights {w}/w.safetensors --out {out}",
        "view {w}/none.bin --weights {w}/w.safetensors --html {out}/page.html",
        "analyze {w}/none --weights {w}/w.safetensors --out {out}",
        "analyze {w}/data --sequences 05 --weights {w}/w.safetensors --out {out}",
        "bench --weights {w}/w.safetensors --scan {w}/none.bin",
    ],
)
def test_a_missing_input_is_found_before_the_networks_are_loaded(
    command: str, world: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    refusal(command.format(w=world, out=tmp_path))
    assert "computing on" not in capsys.readouterr().out


# {w} is the folder `world`, {wrong} the folder `wrong`, {out} a folder of the test.
BENCH = "bench --weights {w}/w.safetensors --scan {w}/lone.bin"
EVALUATE = "evaluate {w}/data --weights {w}/w.safetensors"
PREDICT = "predict {w}/lone.bin --weights {w}/w.safetensors --out {out}"
TRAIN = "train {w}/recipe.yaml --data {w}/data --out {out}"
TRAIN_RV = TRAIN + " --stage rv"
TRAIN_HEAD = TRAIN + " --stage head"

QUICK_MISTAKES = {
    "an argument too many": "info {w}/w.safetensors {w}/w.safetensors",
    "truncated scan": "predict {w}/truncated.bin --weights {w}/w.safetensors --out {out}",
    "weights that are no weights": "predict {w}/lone.bin --weights {w}/lone.bin --out {out}",
    "missing data": "evaluate {w}/none --weights {w}/w.safetensors",
    "no prediction of a scan": "evaluate {w}/data --predictions {w}/data --json {out}/m.json",
    "output is a file": "predict {w}/lone.bin --weights {w}/w.safetensors --out {w}/w.safetensors",
    "same name twice": PREDICT.replace("{w}/lone.bin", "{w}/lone.bin {w}/lone.bin"),
    "weights of other classes": "predict {w}/data --weights {w}/nuscenes.safetensors --out {out}",
    "init of other classes for the head": TRAIN_HEAD + " --init {w}/nuscenes.safetensors",
    "missing sequence": ("predict {w}/data --weights {w}/w.safetensors --out {out} --sequences 05"),
    "wrong label count": (
        "evaluate {wrong}/mislabelled --weights {w}/w.safetensors --json {out}/m.json"
    ),
    "training on validation data": TRAIN + " --train-sequences 00,08 --val-sequences 08",
    "head without networks": TRAIN_HEAD,
    "unknown key in a recipe": "train {wrong}/typo.yaml --data {w}/data --out {out}",
    "recipe that is no text": "train {wrong}/latin1.yaml --data {w}/data --out {out}",
    "no epochs": TRAIN_RV + " --training.rv.epochs 0",
    "unknown accelerator": TRAIN_RV + " --training.accelerator abacus",
    "figures below a file": EVALUATE + " --json {w}/lone.bin/m.json",
}
# They are found at the same places of the code.
MISTAKES = {
    **QUICK_MISTAKES,
    "no arguments": "predict",
    "no data": "train {w}/recipe.yaml --out {out}",
    "both weights and predictions": EVALUATE + " --predictions {w}/data",
    "unknown device": PREDICT + " --device abacus",
    "unknown split": EVALUATE + " --split best",
    "unknown stage": TRAIN + " --stage nose",
    "empty scan": "predict {w}/empty.bin --weights {w}/w.safetensors --out {out}",
    "scan of NaN alone": "predict {w}/nan.bin --weights {w}/w.safetensors --out {out}",
    "missing input": "predict {w}/lone.bin {w}/none.bin --weights {w}/w.safetensors --out {out}",
    "missing weights": "predict {w}/lone.bin --weights {w}/none --out {out}",
    "missing predictions": "evaluate {w}/data --predictions {w}/none",
    "run is a file": "train {w}/recipe.yaml --data {w}/data --stage rv --out {w}/w.safetensors",
    "scored weights of other classes": (
        "evaluate {w}/data --weights {w}/nuscenes.safetensors --json {out}/m.json"
    ),
    "init of other classes": TRAIN_RV + " --init {w}/nuscenes.safetensors",
    "recipe of other classes": "train nuscenes-compact --data {w}/data --out {out}",
    "missing sequence to score": EVALUATE + " --sequences 05 --json {out}/m.json",
    "missing sequence to learn": TRAIN + " --train-sequences 05 --val-sequences 08",
    "unknown recipe": "train best --data {w}/data --out {out}",
    "recipe based on itself": "train {wrong}/loop.yaml --data {w}/data --out {out}",
    "unknown key of a recipe": TRAIN + " --training.rv.colour red",
    "negative epochs": TRAIN_RV + " --training.rv.epochs=-1",
    "empty batches": TRAIN_RV + " --training.rv.batch 0",
    "no warm-up": TRAIN_RV + " --training.rv.warmup 0",
    "no accumulation": TRAIN_RV + " --training.rv.accumulate 0",
    "negative workers": TRAIN_RV + " --training.workers=-1",
    "image without columns": TRAIN_RV + " --model.range_view.width 0",
    "run below a file": (
        "train {w}/recipe.yaml --data {w}/data --stage rv --out {w}/w.safetensors/run"
    ),
    "device without numbers": PREDICT + " --device meta",
    "unknown sensor": "simulate {out} --sensor eye",
    "no head to time": "bench --weights {w}/headless.safetensors --scan {w}/lone.bin",
    "more than all points to time": BENCH + " --uncertain 2",
    "unknown engine to time": BENCH + " --engine tensorrt",
    "no scans": "simulate {out} --scans 0",
}
RUN_FILES = {"out/recipe.yaml", "out/run.yaml", "out/class_counts.npz"}  # written at once


@pytest.mark.parametrize("mistake", with_quick(MISTAKES, QUICK_MISTAKES))
def test_a_mistake_leaves_one_line(mistake: str, world: Path, wrong: Path, tmp_path: Path) -> None:
    before = files(world)
    line = refusal(MISTAKES[mistake].format(w=world, wrong=wrong, out=tmp_path / "out"))
    assert line.startswith("amvnet: ")
    assert files(world) == before
    assert files(tmp_path) <= RUN_FILES


@pytest.mark.parametrize("order", ["first", "last"])
def test_a_recipe_counts_wherever_it_stands(
    order: str, world: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    plans: list[Plan] = []

    def record(plan: Plan, *_: object) -> Path:
        plans.append(plan)
        return world / "w.safetensors"

    monkeypatch.setattr(training_run, "train", record)
    recipe = f"{world}/recipe.yaml"
    options = f"--data {world}/data --out {tmp_path}"
    succeed(f"train {recipe} {options}" if order == "first" else f"train {options} {recipe}")

    (plan,) = plans
    assert (plan.recipe.model.range_view.width, plan.recipe.training.rv.epochs) == (64, 3)


# ---- predict


def test_scores_are_probabilities_of_both_networks_as_float16(world: Path, tmp_path: Path) -> None:
    options = f"--weights {world}/w.safetensors --out {tmp_path} --scores --sequences 08"
    succeed(f"predict {world}/data {options}")

    folder = "sequences/08/predictions"
    names = (f"{folder}/000000", f"{folder}/000001")
    assert files(tmp_path) == {f"{name}.{kind}" for name in names for kind in ("label", "npz")}

    points = np.fromfile(world / "data/sequences/08/velodyne/000000.bin", np.float32)
    result = amvnet.load(str(world / "w.safetensors"))(points.reshape(-1, 4))
    with np.load(tmp_path / folder / "000000.npz", allow_pickle=False) as arrays:
        assert set(arrays.files) == {"rv", "bev"}
        for name, probabilities in (("rv", result.rv), ("bev", result.bev)):
            assert probabilities is not None
            assert arrays[name].dtype == np.float16
            assert arrays[name].shape == (500, 19)
            assert np.array_equal(arrays[name], probabilities.astype(np.float16))


# ---- evaluate


def test_evaluate_says_that_weights_without_head_have_no_amvnet(
    world: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    weights = world / "headless.safetensors"
    command = f"evaluate {world}/data --weights {weights}"
    succeed(command)
    said = f"not scored: amvnet, because {weights} has only"
    assert said in capsys.readouterr().out.replace("\n", " ")
    succeed(f"{command} --methods rv,bev")
    assert "not scored" not in capsys.readouterr().out
    refused((*command.split(), "--methods", "amvnet"), "no point_head")


@pytest.fixture(scope="module")
def scored(world: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder that `evaluate --weights --json --pictures` wrote."""
    out = tmp_path_factory.mktemp("scored")
    options = f"--weights {world}/w.safetensors --json {out}/m.json --pictures {out}/pictures"
    succeed(f"evaluate {world}/data {options}")
    return out


def test_pictures_are_drawn_and_nothing_else_is_left(scored: Path) -> None:
    assert files(scored) == {"m.json", "pictures/08_000000.png", "pictures/08_000001.png"}
    for path in (scored / "pictures").iterdir():
        assert path.read_bytes().startswith(b"\x89PNG")


@pytest.mark.parametrize("method", with_quick(["rv", "bev", "ensemble", "amvnet"], ["amvnet"]))
def test_predictions_score_as_the_weights_that_made_them(
    method: str, world: Path, scored: Path, tmp_path: Path
) -> None:
    options = f"--weights {world}/w.safetensors --method {method} --sequences 08"
    succeed(f"predict {world}/data {options} --out {tmp_path}")
    succeed(f"evaluate {world}/data --predictions {tmp_path} --json {tmp_path}/m.json")

    figures = read_json(tmp_path / "m.json")
    expected = read_json(scored / "m.json")["methods"][method]
    assert figures["uncertain_fraction"] is None
    assert figures["methods"] == {"predictions": expected}


def test_sequences_that_are_named_are_scored(world: Path, tmp_path: Path) -> None:
    options = f"--weights {world}/headless.safetensors --sequences 00,01 --json {tmp_path}/m.json"
    succeed(f"evaluate {world}/data {options}")
    figures = read_json(tmp_path / "m.json")
    assert (figures["scans"], list(figures["methods"])) == (4, ["rv", "bev", "ensemble"])


@pytest.mark.parametrize(("name", "predictions"), [("semantickitti", "."), ("nuscenes", "results")])
def test_golden_sets_score_as_the_tools_say(name: str, predictions: str, tmp_path: Path) -> None:
    data = GOLDEN / name
    out = tmp_path / "m.json"
    options = ("--predictions", data / predictions, "--json", out)
    assert run_cli("evaluate", f"{name}:{data}", *options)[0] == 0
    figures = read_json(out)["methods"]["predictions"]

    # The two tools name their figures in different ways.
    official = read_json(data / "expected.json")
    if name == "nuscenes":
        expected_miou = official["miou"]
        expected_iou = official["iou_per_class"]
    else:
        expected_miou = official["all"]["miou"]
        expected_iou = official["all"]["iou"]

    assert figures["miou"] == pytest.approx(expected_miou, abs=1e-9)
    assert set(figures["iou"]) == set(expected_iou) - {"ignore"}
    for label, value in figures["iou"].items():
        assert (value or 0) == pytest.approx(expected_iou[label] or 0, abs=1e-9)


# ---- info


def test_info_says_what_the_weights_are(world: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["info", str(world / "w.safetensors")]) == 0
    text = capsys.readouterr().out
    for words in ("19 of semantickitti", "16 x 64", "range_net", "polar_net", "point_head"):
        assert words in text
    assert "| 50.0 |" in text  # the mIoU on validation data
    assert "amvnet.load" in text


def test_the_table_of_extras_fits_into_80_columns(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tables, "_version", lambda name: tables.MISSING)
    console = Console(width=80)
    with console.capture() as capture:
        console.print(tables.extras_table())
    assert [row.split()[0] for row in capture.get().splitlines()[3:]] == list(tables.EXTRAS)


# ---- bench


def test_bench_times_every_stage(world: Path, capsys: pytest.CaptureFixture[str]) -> None:
    succeed(f"bench --weights {world}/w.safetensors --scan {world}/lone.bin --runs 1")
    text = " ".join(capsys.readouterr().out.split())
    assert "300 points" in text
    for stage in ("read", "RV", "BEV", "neighbours", "head", "fusion", "peak memory"):
        assert stage in text


def test_bench_figures_add_up(world: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """By a clock that goes on by a millisecond whenever it is read."""
    ticks = itertools.count()
    monkeypatch.setattr(timing, "time", SimpleNamespace(perf_counter=lambda: next(ticks) / 1000))
    options = f"--scan {world}/lone.bin --runs 3 --json {tmp_path}/b.json"
    succeed(f"bench --weights {world}/w.safetensors {options}")
    figures = read_json(tmp_path / "b.json")
    assert (figures["points"], figures["runs"]) == (300, 3)
    assert figures["peak_memory_mib"] > 100

    medians = {}
    for stage, times in figures["stages_ms"].items():
        assert times["low"] <= times["median"] <= times["high"]
        medians[stage] = times["median"]
    mean = medians.pop("mean")  # the step of an ensemble, which has no fusion
    total = sum(medians.values())
    # There is one gap more than timed steps, and each of both takes one tick.
    assert medians["rest"] == pytest.approx(total / 2 + 0.5)
    assert 0 < mean < total
    assert total == pytest.approx(figures["all_ms"]["median"])


def test_list_names_all_weights_recipes_and_sensors(capsys: pytest.CaptureFixture[str]) -> None:
    assert run_cli("list") == (0, "")
    text = capsys.readouterr().out
    for name in (*built_in(), *recipe_names(), *KNOWN_SENSORS):
        assert f" {name} " in text


def test_info_has_no_dictionaries(capsys: pytest.CaptureFixture[str]) -> None:
    assert run_cli("info", "sim-hdl64e") == (0, "")
    text = capsys.readouterr().out
    assert "{" not in text
    assert re.search(r"(?m)^\| rv.epochs \| \d+ \|$", text)


def test_the_help_has_each_command_in_one_group(capsys: pytest.CaptureFixture[str]) -> None:
    for arguments, code in ((["--help"], 0), ([], 2)):
        assert main(arguments) == code
        words = re.findall(r"(?m)^(\w+):$|^  (\w+) ", capsys.readouterr().out)
        assert [title for title, _ in words if title] == list(GROUPS)
        assert [command for _, command in words if command] == list(COMMANDS)
    assert len(COMMANDS) == sum(map(len, GROUPS.values()))


def test_info_lists_weights_and_every_extra_of_users(capsys: pytest.CaptureFixture[str]) -> None:
    succeed("info")
    printed = capsys.readouterr().out
    assert all(name in printed for name in (*built_in(), "torch", "lightning", "cpu"))
    assert set(EXTRAS) == set(metadata("amvnet").get_all("Provides-Extra") or ()) - {"docs", "test"}
    assert all(re.search(rf"(?m)^ {extra} .*(yes|no)", printed) for extra in EXTRAS)
    assert "pytest" not in printed


def test_a_name_without_its_last_letter_is_answered_with_the_sensor(world: Path) -> None:
    refused(f"predict {world}/lone.bin --sensor hdl64", "did you mean hdl64e?")


def test_what_to_do_next_is_said_once(
    world: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    command = f"predict {world}/lone.bin --weights {world}/w.safetensors --out {tmp_path}/out"
    succeed(command)
    assert "look at them: " in capsys.readouterr().out
    succeed(f"{command} --overwrite")
    assert "look at them: " not in capsys.readouterr().out


def test_unlabelled_points_are_explained(
    world: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    points = np.fromfile(world / "lone.bin", np.float32).reshape(-1, 4)
    points[:9, :3] = 0
    points.tofile(tmp_path / "lost.bin")
    weights = f"--weights {world}/w.safetensors --out {tmp_path}"
    succeed(f"predict {tmp_path}/lost.bin {weights}/a")
    printed = capsys.readouterr().out
    assert re.search(r"unlabelled +│ +9 ", printed)
    assert "unlabelled points are lost returns" in printed
    succeed(f"predict {world}/lone.bin {weights}/b")
    assert "lost returns" not in capsys.readouterr().out


def test_progress_of_a_drive_counts_the_scans_that_are_segmented(
    world: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    scans = 9
    calls: list[tuple[int, int]] = []
    written: list[int] = []

    @contextmanager
    def progress(_title: str) -> Iterator[Callable[[int, int], None]]:
        yield lambda done, total: calls.append((done, total))

    def write(*arguments: Any) -> Entry:
        written.append(len(calls))
        return original(*arguments)

    original = Pipeline.write
    monkeypatch.setattr(Pipeline, "write", write)
    monkeypatch.setattr(predict_command, "progress", progress)
    np.save(tmp_path / "poses.npy", np.tile(np.eye(4), (scans, 1, 1)))
    (tmp_path / "drive").mkdir()
    for index in range(scans):
        shutil.copy(world / "lone.bin", tmp_path / f"drive/{index}.bin")
    succeed(
        f"predict {tmp_path}/drive --weights {world}/w.safetensors --out {tmp_path}/out --drive "
        f"--poses {tmp_path}/poses.npy"
    )
    assert calls == [(done, scans) for done in range(scans + 1)]
    assert min(written) > 2  # the first scan waits for others, which are counted
