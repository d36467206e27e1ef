"""What a refused --resume says."""

from __future__ import annotations

from functools import partial
from pathlib import Path

import pytest
import yaml

from amvnet.config.schema import Recipe
from amvnet.data.datasets.own import open_own
from amvnet.data.datasets.training_data import Source, TrainingData
from amvnet.training.plan import Plan
from amvnet.training.run_folder import LAST, MAX_CHANGES, RunFolder, StageFolder, describe_changes
from amvnet.weights.file import DONE, RECORD, RUN_WEIGHTS, SETTINGS, load, save, unfinished_stages

from fixtures.commands import fails, refused, succeed
from fixtures.datasets import make_semantickitti
from fixtures.tiny import fresh_weights, without

EARLIER = {
    "model": {"range_net": {"widths": [8, 16], "gru": True}},
    "training": {"rv": {"lr": 0.003, "batch": 2}, "seed": 0},
    "scans": {"train": "0123456789abcdef", "val": "fedcba9876543210"},
}


def test_changes_have_both_values_but_no_digests() -> None:
    settings = {
        "model": {"range_net": {"widths": [8, 32], "gru": True}},
        "training": {"rv": {"lr": 0.001, "batch": 2, "ema": 0.9}, "seed": 0},
        "scans": {"train": "ffffffffffffffff", "val": "fedcba9876543210"},
    }
    assert describe_changes(EARLIER, settings) == [
        "model.range_net.widths [8, 32] instead of [8, 16]",
        "training.rv.lr 0.001 instead of 0.003",
        "training.rv.ema 0.9 instead of None",
        "other scans to train on",
    ]


def test_settings_tell_classes_apart_by_names_order_and_ids(tmp_path: Path) -> None:
    found: set[str] = set()
    (tmp_path / "a.bin").write_bytes(bytes(160))
    for classes in ({"a": 1, "b": 2}, {"b": 2, "a": 1}, {"a": 2, "b": 1}, {"a": 1, "c": 2}):
        path = tmp_path / f"{len(found)}.yaml"
        path.write_text(yaml.safe_dump({"classes": classes, "scans": "*.bin"}, sort_keys=False))
        data = TrainingData([Source(open_own(path), [])])
        found.add(Plan(Recipe(), data, tmp_path / "run").settings("rv", fresh_weights())["classes"])
    assert len(found) == 4

    # The ids of further datasets count, too.
    first, second = (
        Source(dataset, dataset.records(dataset.sequences("all")))
        for dataset in (open_own(tmp_path / f"{number}.yaml") for number in (0, 2))
    )
    for other in (first, second):
        plan = Plan(Recipe(), TrainingData([first, other]), tmp_path / "run")
        found.add(plan.settings("rv", fresh_weights())["classes"])
    assert len(found) == 6


def test_no_run_begins_in_the_folder_of_a_dataset(tmp_path: Path) -> None:
    (tmp_path / "a.bin").write_bytes(bytes(160))
    (tmp_path / "own.yaml").write_text(yaml.safe_dump({"classes": {"a": 1}, "scans": "*.bin"}))
    own = open_own(tmp_path / "own.yaml")
    make_semantickitti(tmp_path / "kitti")
    for folder in (tmp_path, tmp_path / "x/..", tmp_path / "kitti"):
        fails(partial(RunFolder(folder).check_place, [own.root], []), folder, "a dataset")
    RunFolder(tmp_path / "run").check_place([own.root], [])


def test_a_refused_resume_says_which_values_differ(tmp_path: Path) -> None:
    folder = StageFolder(tmp_path)
    folder.check_begun(EARLIER)
    (tmp_path / LAST).write_bytes(b"")
    (tmp_path / SETTINGS).write_text(yaml.safe_dump(EARLIER))
    settings = {**EARLIER, "training": {"rv": {"lr": 0.001, "batch": 2}, "seed": 0}}
    fails(lambda: folder.check_begun(settings), "training.rv.lr 0.001 instead of 0.003")

    # Without the earlier settings, everything differs.
    for text in ("", "a: [", "- 1"):
        (tmp_path / SETTINGS).write_text(text)
        fails(lambda: folder.check_begun(EARLIER), "model.range_net.widths")
    (tmp_path / SETTINGS).unlink()
    many = {**EARLIER, "model": {str(index): index for index in range(2 * MAX_CHANGES)}}
    fails(lambda: folder.check_begun(many), "and ", " more")


def test_weights_of_a_run_that_was_stopped_say_so(
    world: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run = tmp_path / "run"
    (run / "rv").mkdir(parents=True)
    (run / "rv" / SETTINGS).touch()
    (run / RECORD).touch()
    command = f"evaluate {world}/data --split all --weights {run}"
    refused(command, "not finished a stage", "--resume")

    (run / "rv" / DONE).touch()
    (run / "bev").mkdir()
    (run / "bev" / SETTINGS).touch()
    assert unfinished_stages(run) == ["bev"]
    save(without(load(world / "w.safetensors"), "polar_net", "point_head"), run / RUN_WEIGHTS)
    succeed(command)
    assert f"{run} is a run that has not finished bev" in capsys.readouterr().out
    (run / "bev" / DONE).touch()
    succeed(f"{command} --split train")
    assert "not finished" not in capsys.readouterr().out


def test_a_head_without_networks_says_what_is_missing_where(world: Path, tmp_path: Path) -> None:
    run = tmp_path / "run"
    half = tmp_path / "half.safetensors"
    save(without(load(world / "w.safetensors"), "polar_net", "point_head"), half)
    command = f"train {world}/recipe.yaml --data {world}/data --out {run} --stage head"
    refused(command, f"found no range_net in {run}; train it first, or give --init")
    found = f"found no polar_net in {run}, "
    refused(f"{command} --init {half}", f"{found}and --init has only range_net; train it first")
    other = world / "nuscenes.safetensors"
    refused(f"{command} --init {other}", f"in {run}, and that of --init has other classes; train")

    (run / "bev").mkdir()
    (run / "bev" / LAST).touch()
    unfinished = f"{found}whose stage bev is not finished; finish it with --stage bev --resume"
    refused(f"{command} --init {half}", unfinished)


def test_weights_without_a_head_label_by_the_ensemble_and_say_so(
    world: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    command = f"predict {world}/lone.bin --weights {world}/headless.safetensors --out {tmp_path}"
    succeed(f"{command}/a")
    assert "the method is ensemble, not amvnet" in capsys.readouterr().out
    succeed(f"{command}/b --method ensemble")
    assert (tmp_path / "a/lone.label").read_bytes() == (tmp_path / "b/lone.label").read_bytes()
