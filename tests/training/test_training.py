"""Training through the command line: what it leaves behind, that it learns, repeats, resumes and keeps scans apart."""

from __future__ import annotations

import csv
import json
import shlex
import shutil
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import yaml
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from amvnet.training import run as runner
from amvnet.training.callbacks import KeepWeights
from amvnet.weights.file import PARTS, Weights, load

from fixtures.worlds import GOLDEN, files, label_map, make_streets, run_cli, write_recipe

STILL = ("--training.augment.yaw", 0, "--training.augment.scale", 0, "--training.augment.flip", 0)
SURE = ("--model.polar_net.dropblock", 0)  # a compiled network draws other numbers
FOLDERS = {"rv": "range_net", "bev": "polar_net", "head": "point_head"}


def train(world: Path, out: Path, *options: object) -> Weights:
    """The weights of a run that must succeed."""
    code, error = run_cli(
        "train", world / "recipe.yaml", "--data", world / "data", "--out", out, *options
    )
    assert code == 0, error
    return load(out / "weights.safetensors")


def differing(a: Weights, b: Weights) -> set[str]:
    """The parts that are not bitwise equal."""
    assert set(a.tensors) == set(b.tensors)
    return {
        name.split(".")[0]
        for name in a.tensors
        if not torch.equal(a.tensors[name], b.tensors[name])
    }


def column(run: Path, stage: str, name: str) -> list[float]:
    with (run / stage / "metrics.csv").open() as file:
        return [float(row[name]) for row in csv.DictReader(file) if row.get(name)]


@pytest.fixture(scope="module")
def world(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("world")
    make_streets(root / "data")
    write_recipe(root / "recipe.yaml")
    return root


@pytest.fixture(scope="module")
def run(world: Path) -> Path:
    """One uninterrupted training of all stages."""
    train(world, world / "run")
    return world / "run"


def test_a_run_ends_with_all_three_parts(run: Path) -> None:
    assert load(run / "weights.safetensors").parts == PARTS


@pytest.mark.parametrize("stage", FOLDERS)
def test_a_stage_keeps_its_best_and_last_weights_and_its_curves(run: Path, stage: str) -> None:
    kept = files(run / stage)
    assert {"best.safetensors", "last.safetensors", "metrics.csv"} <= kept
    assert any(name.startswith("events.out.tfevents") for name in kept)
    assert len(column(run, stage, "val/miou")) == (2 if stage == "head" else 3)


@pytest.mark.parametrize("stage", FOLDERS)
def test_the_best_weights_are_those_of_the_highest_validation_miou(run: Path, stage: str) -> None:
    values = column(run, stage, "val/miou")
    reached = load(run / stage / "best.safetensors").metrics[FOLDERS[stage]]
    assert reached["epoch"] == int(np.argmax(values))
    assert reached["val/miou"] == pytest.approx(max(values), abs=1e-6)


def test_class_counts_kept_beside_the_run_are_those_of_the_training_scans(
    world: Path, run: Path
) -> None:
    with np.load(run / "class_counts.npz") as kept:
        counts = kept["counts"]
        assert kept["scans"].tolist() == ["00/000000", "00/000001", "01/000000", "01/000001"]
    raw = [
        np.fromfile(p, np.uint32)
        for s in ("00", "01")
        for p in world.glob(f"data/sequences/{s}/labels/*.label")
    ]
    classes = {
        0: 10,
        8: 40,
        10: 48,
        12: 50,
    }  # score column -> raw id: car, road, sidewalk, building
    for c, count in enumerate(counts):
        assert count == np.count_nonzero(np.concatenate(raw) == classes.get(c, -1))


def test_the_weights_say_how_they_came_about(run: Path) -> None:
    weights = load(run / "weights.safetensors")
    for part in PARTS:
        said = weights.training[part]
        assert (said["sequences"], said["validated_on"], said["seed"]) == (["00", "01"], ["08"], 0)
    assert weights.training["range_net"]["rv"]["epochs"] == 3
    assert weights.model.range_view.width == 64


def test_a_run_leaves_no_temporary_files(run: Path) -> None:
    assert not [name for name in files(run) if ".part" in name]


def test_values_on_the_command_line_override_the_recipe(world: Path, tmp_path: Path) -> None:
    options = (
        "--stage",
        "rv",
        "--training.rv.epochs",
        1,
        "--model.range_net.decoder",
        24,
        "--training.seed",
        7,
    )
    weights = train(world, tmp_path / "run", *options)
    said = weights.training["range_net"]
    assert (said["rv"]["epochs"], said["seed"], said["rv"]["lr"]) == (1, 7, 0.02)
    assert weights.model.range_net.decoder == 24
    assert weights.parts == ("range_net",)
    assert (
        yaml.safe_load((tmp_path / "run/recipe.yaml").read_text())["training"]["rv"]["epochs"] == 1
    )


@pytest.mark.parametrize("stage", ["rv", "bev"])
def test_a_network_learns_a_tiny_data_set_by_heart(world: Path, tmp_path: Path, stage: str) -> None:
    train(world, tmp_path / "run", "--stage", stage, f"--training.{stage}.epochs", 20, *STILL)
    losses = column(tmp_path / "run", stage, "train/loss")
    assert losses[-1] < 0.5 * losses[0]
    assert max(column(tmp_path / "run", stage, "val/acc")) > 0.6


def test_the_same_seed_gives_the_same_weights(world: Path, run: Path, tmp_path: Path) -> None:
    assert not differing(train(world, tmp_path / "again"), load(run))


def test_another_seed_gives_other_weights(world: Path, run: Path, tmp_path: Path) -> None:
    assert differing(train(world, tmp_path / "other", "--training.seed", 1), load(run)) == set(
        PARTS
    )


def train_interrupted(stage: str, epoch: int, world: Path, out: Path, *options: object) -> None:
    """A run that stops after the validation of an epoch of a stage, before its weights are kept."""
    keep = KeepWeights.on_train_epoch_end

    def stop(self: KeepWeights, trainer: Any, module: Any) -> None:
        if self.last.parent.name == stage and trainer.current_epoch == epoch:
            raise RuntimeError("the power is gone")
        keep(self, trainer, module)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(KeepWeights, "on_train_epoch_end", stop)
        with pytest.raises(RuntimeError, match="power"):
            train(world, out, *options)


@pytest.mark.parametrize(("stage", "epoch"), [("rv", 0), ("rv", 2), ("bev", 1), ("head", 1)])
def test_an_interrupted_run_resumes_to_the_same_weights(
    world: Path, run: Path, tmp_path: Path, stage: str, epoch: int
) -> None:
    train_interrupted(stage, epoch, world, tmp_path / "run")
    resumed = train(world, tmp_path / "run", "--resume")
    assert not differing(resumed, load(run))
    for kept in ("best", "last"):
        path = f"{stage}/{kept}.safetensors"
        assert not differing(load(tmp_path / "run" / path), load(run / path))


def test_processes_that_read_beside_the_training_change_nothing_resumed_or_not(
    world: Path, run: Path, tmp_path: Path
) -> None:
    options = ("--stage", "rv", "--training.workers", 1)
    train_interrupted("rv", 2, world, tmp_path / "run", *options)
    before, all_along = (load(folder / "rv/last.safetensors") for folder in (tmp_path / "run", run))
    assert before.metrics["range_net"]["val/acc"] == pytest.approx(
        column(run, "rv", "val/acc")[1], abs=1e-6
    )
    train(world, tmp_path / "run", *options, "--resume")
    assert not differing(load(tmp_path / "run/rv/last.safetensors"), all_along)


def test_a_resumed_run_keeps_the_curves_of_its_earlier_epochs(world: Path, tmp_path: Path) -> None:
    train_interrupted("rv", 2, world, tmp_path / "run", "--stage", "rv")
    train(world, tmp_path / "run", "--stage", "rv", "--resume")
    assert set(column(tmp_path / "run", "rv", "epoch")) == {0.0, 1.0, 2.0}


def test_a_refused_run_leaves_the_recipe_of_the_run_that_is_there(world: Path, run: Path) -> None:
    before = (run / "recipe.yaml").read_bytes()
    code, _ = run_cli(
        "train", world / "recipe.yaml", "--data", world / "data", "--out", run, "--training.seed", 9
    )
    assert code == 2
    assert (run / "recipe.yaml").read_bytes() == before


@pytest.mark.parametrize(
    "other",
    [("--training.rv.epochs", 5), ("--model.range_net.decoder", 24), ("--training.seed", 4)],
)
def test_a_run_is_not_resumed_with_other_values(
    world: Path, run: Path, other: tuple[str, object]
) -> None:
    before = {
        name: (run / name).read_bytes()
        for name in ("recipe.yaml", "run.yaml", "weights.safetensors")
    }
    arguments = ("--data", world / "data", "--out", run, "--resume", *other)
    code, error = run_cli("train", world / "recipe.yaml", *arguments)
    assert (code, error.count("\n")) == (2, 1)
    assert "stage.yaml" in error
    assert {name: (run / name).read_bytes() for name in before} == before


def test_a_broken_checkpoint_is_named(world: Path, tmp_path: Path) -> None:
    train_interrupted("rv", 2, world, tmp_path, "--stage", "rv")
    checkpoint = tmp_path / "rv/last.ckpt"
    checkpoint.write_bytes(checkpoint.read_bytes()[:1000])
    arguments = ("--data", world / "data", "--out", tmp_path, "--stage", "rv", "--resume")
    code, error = run_cli("train", world / "recipe.yaml", *arguments)
    assert (code, error.count("\n")) == (2, 1)
    assert "last.ckpt" in error


def test_broken_class_counts_are_counted_anew(world: Path, run: Path, tmp_path: Path) -> None:
    (tmp_path / "class_counts.npz").write_bytes((run / "class_counts.npz").read_bytes()[:100])
    train(world, tmp_path, "--stage", "rv", "--training.rv.epochs", 1)
    with (
        np.load(tmp_path / "class_counts.npz") as found,
        np.load(run / "class_counts.npz") as expected,
    ):
        assert np.array_equal(found["counts"], expected["counts"])


def test_a_broken_label_file_is_one_line_from_a_reading_process_too(
    world: Path, tmp_path: Path
) -> None:
    shutil.copytree(world / "data", tmp_path / "data")
    label = tmp_path / "data/sequences/00/labels/000001.label"
    np.full(500, 10, np.uint32)[:499].tofile(label)
    options = ("--stage", "rv", "--training.rv.class_weights", "false", "--training.workers", 1)
    code, error = run_cli(
        "train",
        world / "recipe.yaml",
        "--data",
        tmp_path / "data",
        "--out",
        tmp_path / "run",
        *options,
    )
    assert (code, error.count("\n")) == (2, 1), error
    assert "499" in error


def test_the_points_of_the_head_are_removed_when_it_is_trained(run: Path) -> None:
    assert not {name for name in files(run / "head") if name.startswith(("train/", "val/"))}


def test_resuming_a_finished_run_changes_nothing(world: Path, run: Path, tmp_path: Path) -> None:
    before = train(world, tmp_path / "run")
    assert not differing(train(world, tmp_path / "run", "--resume"), before)


def test_an_existing_run_is_not_overwritten_without_resume(world: Path, run: Path) -> None:
    before = (run / "weights.safetensors").read_bytes(), (run / "rv/last.safetensors").read_bytes()
    code, error = run_cli("train", world / "recipe.yaml", "--data", world / "data", "--out", run)
    assert (code, error.count("\n")) == (2, 1)
    assert "--resume" in error
    assert before == (
        (run / "weights.safetensors").read_bytes(),
        (run / "rv/last.safetensors").read_bytes(),
    )


def test_the_head_stage_leaves_the_networks_bitwise_unchanged(
    world: Path, run: Path, tmp_path: Path
) -> None:
    before = load(run)
    after = train(world, tmp_path / "head", "--stage", "head", "--init", run, "--training.seed", 5)
    assert differing(before, after) == {"point_head"}


def test_a_stage_takes_the_other_parts_from_init(world: Path, run: Path, tmp_path: Path) -> None:
    after = train(world, tmp_path / "rv", "--stage", "rv", "--init", run, "--training.rv.epochs", 1)
    assert differing(load(run), after) == {"range_net"}
    assert after.training["range_net"]["rv"]["epochs"] == 1
    assert after.training["polar_net"] == load(run).training["polar_net"]


def test_stages_one_by_one_equal_all_at_once(world: Path, run: Path, tmp_path: Path) -> None:
    for stage in FOLDERS:
        weights = train(world, tmp_path / "run", "--stage", stage)
    assert not differing(weights, load(run))


def test_folds_score_no_sequence_that_they_learnt_from(
    world: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    gathered = []
    gather = runner.gather_points

    def spy(sources: Any, **rest: Any) -> Any:
        gathered.append(sources)
        return gather(sources, **rest)

    monkeypatch.setattr(runner, "gather_points", spy)
    weights = train(world, tmp_path / "run", "--training.head.folds", 2, "--training.rv.epochs", 1)
    scored = []
    for source in gathered[0]:
        for part in ("range_net", "polar_net"):
            assert not set(source.weights.training[part]["sequences"]) & {
                one.sequence for one in source.records
            }
        scored += [record.name for record in source.records]
    assert sorted(scored) == ["00/000000", "00/000001", "01/000000", "01/000001"]
    assert weights.training["point_head"]["head"]["folds"] == 2
    assert weights.training["range_net"]["sequences"] == ["00", "01"]


def test_nuscenes_trains_predicts_and_is_scored(tmp_path: Path) -> None:
    recipe = write_recipe(tmp_path / "recipe.yaml", "nuscenes-compact")
    data, out, run = GOLDEN / "nuscenes", tmp_path / "out", tmp_path / "run"
    scenes = ("--train-sequences", "scene-0103", "--val-sequences", "scene-0916")
    assert run_cli("train", recipe, "--data", data, "--out", run, *scenes)[0] == 0
    assert load(run).model.range_view.rows == "ring"
    assert (
        run_cli("predict", data, "--weights", run, "--out", out, "--sequences", "scene-0916")[0]
        == 0
    )
    labels = [
        np.fromfile(path, np.uint8)
        for path in sorted((out / "lidarseg/mini_val").glob("*_lidarseg.bin"))
    ]
    assert sorted(map(len, labels)) == [2622, 2683]
    assert all(1 <= ids.min() <= ids.max() <= 16 for ids in labels)
    assert run_cli("evaluate", data, "--predictions", out, "--sequences", "scene-0916")[0] == 0
    assert run_cli("evaluate", data, "--weights", run, "--sequences", "scene-0916")[0] == 0


def test_a_label_map_of_ones_own_is_learnt(world: Path, tmp_path: Path) -> None:
    classes = label_map()
    classes["learning_ignore"][19] = True  # one class less than the benchmark
    (tmp_path / "mine.yaml").write_text(yaml.safe_dump(classes))
    options = ("--stage", "rv", "--taxonomy", tmp_path / "mine.yaml", "--training.rv.epochs", 1)
    taxonomy = train(world, tmp_path / "run", *options).taxonomy
    assert (taxonomy.name, taxonomy.size) == ("mine", 18)
    predicted = tmp_path / "predicted"
    weights = ("--weights", tmp_path / "run", "--method", "rv")
    assert run_cli(
        "predict", world / "data", *weights, "--out", predicted, "--sequences", "08"
    ) == (
        0,
        "",
    )
    assert run_cli("evaluate", world / "data", "--weights", tmp_path / "run")[0] == 0


def test_where_the_networks_agree_everywhere_the_head_learns_from_all_points(
    world: Path, tmp_path: Path
) -> None:
    weights = train(world, tmp_path / "run", "--model.assertion.threshold=-1")
    assert weights.parts == PARTS
    assert max(column(tmp_path / "run", "head", "val/acc")) > 0.5


def test_the_head_learns_where_the_loss_is_high(world: Path, run: Path, tmp_path: Path) -> None:
    options = (
        "--stage",
        "head",
        "--init",
        run,
        "--model.assertion.name",
        "loss",
        "--model.assertion.threshold",
        0.5,
    )
    weights = train(world, tmp_path / "run", *options)
    assert weights.model.assertion.name == "loss"
    assert differing(load(run), weights) == {"point_head"}


@pytest.mark.parametrize("stage", ["rv", "bev"])
def test_a_loss_that_is_not_finite_stops_with_the_names_of_the_scans(
    world: Path, tmp_path: Path, stage: str
) -> None:
    options = (
        "--stage",
        stage,
        f"--training.{stage}.lr",
        "1e38",
        f"--training.{stage}.clip",
        "1e38",
    )
    code, error = run_cli(
        "train",
        world / "recipe.yaml",
        "--data",
        world / "data",
        "--out",
        tmp_path / "run",
        *options,
    )
    assert code == 2
    assert error.count("\n") == 1
    assert "finite" in error
    assert "00/0" in error or "01/0" in error
    assert not (tmp_path / "run" / "weights.safetensors").exists()


def test_a_run_says_how_to_repeat_it(world: Path, run: Path, tmp_path: Path) -> None:
    """The command in the run's folder gives the same weights to the last bit."""
    said = yaml.safe_load((run / "run.yaml").read_text())["all"]
    assert said["versions"]["torch"] == torch.__version__
    assert said["train"] == ["00", "01"]
    assert said["val"] == ["08"]
    command = shlex.split(said["repeat"])
    assert command[0] == "amvnet"
    command[command.index("--out") + 1] = str(tmp_path / "again")
    assert run_cli(*command[1:]) == (0, "")
    assert not differing(load(tmp_path / "again"), load(run))


def test_a_run_of_several_calls_says_how_to_repeat_each(world: Path, tmp_path: Path) -> None:
    """The stages may be trained on different sequences; their commands in order give the same weights."""
    out = tmp_path / "run"
    train(world, out, "--stage", "rv", "--train-sequences", "00", "--val-sequences", "08")
    train(world, out, "--stage", "bev", "--train-sequences", "01", "--val-sequences", "08")
    expected = train(
        world, out, "--stage", "head", "--train-sequences", "00,01", "--val-sequences", "08"
    )
    calls = yaml.safe_load((out / "run.yaml").read_text())
    assert list(calls) == ["rv", "bev", "head"]
    for call in calls.values():
        command = shlex.split(call["repeat"])
        assert command[-1] == f"{out}-again"
        assert run_cli(*command[1:]) == (0, "")
    assert not differing(load(f"{out}-again"), expected)


@pytest.mark.parametrize("stage", FOLDERS)
def test_a_killed_run_resumes_to_the_same_weights(
    world: Path, run: Path, tmp_path: Path, stage: str
) -> None:
    """SIGKILL in the middle of an epoch, after one that was finished."""
    out = tmp_path / "run"
    if stage == "head":
        for earlier in ("rv", "bev"):
            shutil.copytree(run / earlier, out / earlier)
    arguments = [world / "recipe.yaml", "--data", world / "data", "--out", out, "--stage", stage]
    command = [sys.executable, "-m", "amvnet", "train", *map(str, arguments)]
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    while not (out / stage / "last.ckpt").exists() and process.poll() is None:
        time.sleep(0.002)
    process.kill()
    process.wait()
    done = (out / stage / "done").exists()
    again = subprocess.run([*command, "--resume"], capture_output=True, text=True, check=False)
    assert again.returncode == 0, again.stderr
    assert not done, "the run was over before it was killed"
    found, expected = load(out / stage / "last.safetensors"), load(run / stage / "last.safetensors")
    assert not differing(found, expected)


@pytest.mark.parametrize("room", [1_000, 40_000])
def test_a_full_disk_stops_with_a_line_and_the_last_good_state(
    world: Path, tmp_path: Path, room: int
) -> None:
    """No file may grow beyond some bytes, which is what a full disk looks like to a program."""
    out = tmp_path / "run"
    arguments = [world / "recipe.yaml", "--data", world / "data", "--out", out, "--stage", "rv"]
    command = [sys.executable, "-m", "amvnet", "train", *map(str, arguments)]
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    while not (out / "rv" / "last.ckpt").exists() and process.poll() is None:
        time.sleep(0.002)
    process.kill()
    process.wait()
    before = load(out / "rv" / "last.safetensors")
    full = subprocess.run(
        ["bash", "-c", f'ulimit -f {room // 1024 + 1}; exec "$@"', "-", *command, "--resume"],
        capture_output=True,
        text=True,
        check=False,
    )
    assert full.returncode in (1, 2), full.stderr
    assert len(full.stderr.splitlines()) == 1, full.stderr
    assert not differing(load(out / "rv" / "last.safetensors"), before)
    assert not [name for name in files(out) if ".part" in name]
    assert subprocess.run([*command, "--resume"], capture_output=True, check=False).returncode == 0


def test_in_a_shell_a_run_that_cannot_end_says_so_in_one_line(world: Path, tmp_path: Path) -> None:
    """The libraries' own notes stay out of stderr, and what is trained is not lost."""
    shutil.copytree(world / "data", tmp_path / "data")
    arguments = [world / "recipe.yaml", "--data", tmp_path / "data", "--out", tmp_path / "run"]
    command = [sys.executable, "-m", "amvnet", "train", *map(str, arguments)]
    subprocess.run([*command, "--stage", "rv"], capture_output=True, check=True)
    (tmp_path / "data/sequences/08/labels/000001.label").write_bytes(
        b"1234"
    )  # is met after an epoch of training
    done = subprocess.run([*command, "--stage", "bev"], capture_output=True, text=True, check=False)
    assert done.returncode == 2
    assert "000001.label" in done.stderr
    assert len(done.stderr.splitlines()) == 1, done.stderr
    assert load(tmp_path / "run").parts == ("range_net",)


@pytest.mark.parametrize(("baseline", "stage"), [("polarnet", "bev"), ("no-rnn", "rv")])
def test_a_baseline_is_trained_and_scored_by_its_name(
    world: Path, tmp_path: Path, baseline: str, stage: str
) -> None:
    recipe = write_recipe(tmp_path / "recipe.yaml", f"semantickitti-{baseline}-compact")
    data, run = world / "data", tmp_path / "run"
    assert run_cli("train", recipe, "--data", data, "--out", run) == (0, "")
    weights = load(run)
    assert weights.parts == (FOLDERS[stage],)
    assert not [name for name in weights.tensors if "gru" in name]
    assert run_cli("evaluate", data, "--weights", run, "--json", tmp_path / "m.json") == (0, "")
    assert list(json.loads((tmp_path / "m.json").read_text())["methods"]) == [stage]


def test_the_scans_of_validation_can_be_learnt_too(world: Path, tmp_path: Path) -> None:
    """For an entry to a benchmark: nothing is validated, the last weights are kept, and the run can be repeated."""
    weights = train(world, tmp_path / "run", "--with-val")
    for part, stage in zip(PARTS, FOLDERS, strict=True):
        assert weights.training[part]["sequences"] == ["00", "01", "08"]
        assert weights.training[part]["validated_on"] == []
        best, last = (
            load(tmp_path / "run" / stage / f"{kept}.safetensors") for kept in ("best", "last")
        )
        assert not differing(best, last)
        assert len(column(tmp_path / "run", stage, "epoch")) == (2 if stage == "head" else 3)
        assert not column(tmp_path / "run", stage, "val/miou")
    command = shlex.split(
        yaml.safe_load((tmp_path / "run" / "run.yaml").read_text())["all"]["repeat"]
    )
    assert run_cli(*command[1:]) == (0, "")
    assert not differing(load(f"{tmp_path}/run-again"), weights)


def test_a_dry_run_says_what_a_training_would_cost_and_leaves_nothing(
    world: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    batches = ("--training.rv.batch", 6, "--training.bev.accumulate", 2)  # of four scans
    train_arguments = ("--data", world / "data", "--out", tmp_path / "run", *batches)
    assert run_cli("train", world / "recipe.yaml", *train_arguments, "--dry-run") == (0, "")
    said = [line for line in capsys.readouterr().out.splitlines() if "would take" in line]
    assert [line.split(":")[0] for line in said] == ["rv", "bev"]
    assert ["step of 6 scans" in said[0], "step of 2 scans" in said[1]] == [True, True]
    assert all("3 epochs of 4 scans" in line and "GiB" in line for line in said)
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize("stage", FOLDERS)
def test_a_stage_can_be_followed_in_tensorboard(run: Path, stage: str) -> None:
    events = EventAccumulator(str(run / stage), size_guidance={"images": 0})
    events.Reload()
    scalars = set(events.Tags()["scalars"])
    assert {"train/loss", "val/miou", "iou/road"} <= scalars
    assert any(name.startswith("lr-") for name in scalars)
    assert {"points/s" if stage == "head" else "scans/s"} <= scalars
    pictures = events.Tags()["images"]
    assert sorted(pictures) == ["08/000000", "08/000001"]
    drawn = [events.Images(name) for name in pictures]
    assert [len(images) for images in drawn] == [2 if stage == "head" else 3] * 2
    assert drawn[0][0].encoded_image_string.startswith(b"\x89PNG")
    assert drawn[0][0].encoded_image_string != drawn[1][0].encoded_image_string


def test_the_share_of_uncertain_points_is_that_of_the_networks(
    world: Path, run: Path, tmp_path: Path
) -> None:
    assert run_cli("evaluate", world / "data", "--weights", run, "--json", tmp_path / "m.json") == (
        0,
        "",
    )
    scored = json.loads((tmp_path / "m.json").read_text())["uncertain_fraction"]
    labelled = column(run, "head", "val/uncertain")[
        0
    ]  # the other counts unlabelled points, too: two in a hundred
    assert labelled == pytest.approx(scored, abs=0.02)


@pytest.mark.skipif(shutil.which("g++") is None, reason="torch.compile needs a compiler on a CPU")
@pytest.mark.parametrize("stage", ["rv", "bev"])
@pytest.mark.slow
def test_a_compiled_training_is_the_same_within_rounding(
    world: Path, run: Path, tmp_path: Path, stage: str
) -> None:
    """Of one step, as later ones amplify what rounding there is."""
    one = ("--stage", stage, f"--training.{stage}.epochs", 1, f"--training.{stage}.batch", 4, *SURE)
    plain = train(world, tmp_path / "plain", *one)
    train(world, tmp_path / "compiled", *one, "--training.compile", "true")
    losses = [column(tmp_path / name, stage, "train/loss")[0] for name in ("plain", "compiled")]
    assert losses[0] == pytest.approx(losses[1], rel=1e-3)
    assert plain.parts == load(tmp_path / "compiled").parts


def test_networks_of_few_channels_train_without_a_crash() -> None:
    """Torch 2.13 corrupts the heap in the backward pass of a 1x1 convolution with stride (1, 2) of < 16 channels."""
    code = """
import torch
from amvnet.models.layers import ResidualBlock
block = ResidualBlock(8, 8, (1, 2))
for _ in range(100):
    image = torch.randn(2, 32, 64, 8).permute(0, 3, 1, 2).requires_grad_()
    block(image).sum().backward()
"""
    assert (
        subprocess.run([sys.executable, "-c", code], capture_output=True, check=False).returncode
        == 0
    )
