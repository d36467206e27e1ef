"""Weights are taught by the consensus of an unlabelled drive."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import amvnet
from amvnet.data.datasets.open import open_dataset
from amvnet.drives.consensus import Consensus, DriveScan
from amvnet.inference.drive import TURN, find_poses
from amvnet.inference.listing import find_inputs
from amvnet.training import adapt
from amvnet.training import adapt as adapting
from amvnet.training.adapt import LEAST_PROBABILITY, Figures, recipe_for, teach
from amvnet.weights.file import load, save

from fixtures.commands import new_file, not_none, refused, run_cli, succeed
from fixtures.drives import drive_poses, drive_scans, write_drive
from fixtures.tiny import fresh_weights

SCANS = 4
TEACHER = "teacher/00"


@pytest.fixture(scope="module")
def world(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("world")
    write_drive(root / "data", scans=SCANS)
    shutil.rmtree(root / "data/sequences/00/labels")
    for path in (root / "data/sequences/00/velodyne").iterdir():
        points = np.fromfile(path, np.float32).reshape(-1, 4)
        points[::9, :3] = 0  # lost returns
        points.tofile(path)
    save(fresh_weights(), root / "w.safetensors")
    with pytest.MonkeyPatch.context() as patch:
        # Tiny networks are never sure; any of their labels may teach.
        patch.setattr(adapting, "LEAST_PROBABILITY", 0.07)
        patch.setattr(Figures, "is_better_than", lambda self, other: True)
        succeed(command(root, root / "run"))
    return root


def command(world: Path, out: Path, *options: object) -> str:
    words = " ".join(map(str, options))
    shared = f"--weights {world}/w.safetensors --out {out} --streets 0 --epochs 1"
    return f"adapt {world}/data {shared} {words}"


def test_both_networks_learn_and_the_head_stays(world: Path) -> None:
    before = load(world / "w.safetensors")
    after = load(world / "run")
    assert after.parts == before.parts
    assert after.digest("range_net") != before.digest("range_net")
    assert after.digest("polar_net") != before.digest("polar_net")
    assert after.digest("point_head") == before.digest("point_head")


def test_points_teach_of_which_the_consensus_is_sure(world: Path) -> None:
    segmenter = amvnet.load(world / "w.safetensors")
    dataset = open_dataset(str(world / "data"))
    records = dataset.records(["00"])
    results = [
        segmenter(dataset.read(record), yaw=index * TURN) for index, record in enumerate(records)
    ]
    scans = []
    for index, (result, pose) in enumerate(zip(results, drive_poses(SCANS), strict=True)):
        xyz = result.require_origin().scan.points[:, :3]
        scans.append(DriveScan(index, xyz, result.scores, pose))

    agreeing = 0
    for index, scores in Consensus().stream(scans):
        labels = np.where(results[index].labels > 0, scores.argmax(axis=1) + 1, 0)
        agreeing += int(np.count_nonzero((labels == results[index].labels) & (labels > 0)))
        taught = np.load(world / f"run/{TEACHER}/{index:06d}.npy")
        teaches = (scores.max(axis=1) > 0.07) & (labels > 0)
        np.testing.assert_array_equal(taught, np.where(teaches, labels, 0))
        assert set(teaches.tolist()) == {True, False}
    figures = json.loads((world / "run" / TEACHER).parent.joinpath(adapt.FIGURES).read_text())
    valid = sum(np.count_nonzero(result.labels) for result in results)
    uncertain = sum(np.count_nonzero(result.uncertain) for result in results)
    assert figures["uncertain"] == pytest.approx(uncertain / valid)
    assert figures["consistency"] == pytest.approx(agreeing / valid)
    both = 0
    for result in results:
        is_same = not_none(result.rv).argmax(axis=1) == not_none(result.bev).argmax(axis=1)
        both += int(np.count_nonzero(is_same & (result.labels > 0)))
    assert figures["agreement"] == pytest.approx(both / valid)
    assert LEAST_PROBABILITY == 0.6


def test_drives_whose_names_are_alike_teach_by_labels_of_their_own(
    world: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(adapting, "LEAST_PROBABILITY", 0.07)
    for index, folder in enumerate(("x/y", "x_y")):
        Path(folder).mkdir(parents=True)
        for number, (points, _) in enumerate(drive_scans(2, seed=index)):
            points.tofile(f"{folder}/{number}.bin")
    for index, root in enumerate(("A", "B")):
        write_drive(Path(root), scans=2, seed=index)
    segmenter = amvnet.load(world / "w.safetensors")
    for inputs in (["x/y", "x_y"], ["A", "B"]):
        scans, _ = find_inputs(inputs).scans(taxonomy=segmenter.taxonomy)
        labels_of = Path(f"{inputs[0]}.labels")
        teach(scans, None, segmenter, labels_of)
        taught = adapt.TaughtScans(scans, labels_of, segmenter.weights)
        assert len(taught.parts()["train"]) == 2
        for name, drive in zip(taught.parts()["train"], (scans[:2], scans[2:]), strict=True):
            for record, scan in zip(taught.records([name]), drive, strict=True):
                labels = segmenter(scan.load()).labels
                read = taught.read(record)
                np.testing.assert_array_equal(read.points, scan.load().points)
                assert read.labels is not None
                is_taught = read.labels > 0
                assert is_taught.any()
                np.testing.assert_array_equal(read.labels[is_taught], labels[is_taught])


def test_two_datasets_with_a_sequence_of_one_name_are_two_drives(tmp_path: Path) -> None:
    for index, root in enumerate(("A", "B")):
        write_drive(tmp_path / root, scans=3, seed=index)
    poses = tmp_path / "B/sequences/00/poses.txt"
    np.savetxt(poses, np.loadtxt(poses) + np.eye(12)[3])  # it began a metre farther right
    lines: list[str] = []
    scans, _ = find_inputs([f"{tmp_path}/A", f"{tmp_path}/B"]).scans()
    drives = find_poses(scans, report=lines.append)
    assert [line.partition(",")[0] for line in lines] == [
        "00: a drive of 3 scans",
        "00 (2): a drive of 3 scans",
    ]
    for number, root in enumerate(("A", "B")):
        dataset = open_dataset(f"{tmp_path}/{root}")
        expected = dataset.poses(dataset.records(["00"]))
        found = [drives.poses[scan] for scan in scans[3 * number : 3 * number + 3]]
        np.testing.assert_array_equal(found, expected)


@pytest.mark.full
def test_a_finished_run_is_resumed_and_another_one_refused(
    world: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    out = shutil.copytree(world / "run", tmp_path / "run")
    refused(command(world, out), "--resume")
    shutil.copytree(out / "teacher", tmp_path / "begun/teacher")  # stopped before the training
    refused(command(world, tmp_path / "begun"), "--resume")

    monkeypatch.setattr(Figures, "is_better_than", lambda self, other: True)
    succeed(command(world, out, "--resume", "--seed", 0))  # the default seed
    assert load(out).digests() == load(world / "run").digests()
    assert "both networks agree on" in capsys.readouterr().out

    save(fresh_weights(seed=1), tmp_path / "other.safetensors")
    words = f"--weights {tmp_path}/other.safetensors --out {out} --streets 0 --epochs 1 --resume"
    refused(f"adapt {world}/data {words}", "weights of the earlier run")


def test_labels_that_are_all_unsure_teach_nothing(world: Path, tmp_path: Path) -> None:
    """Fresh networks are never sure of a point."""
    refused(command(world, tmp_path / "run"), "probability over 0.6")
    assert not list(tmp_path.iterdir())


def test_a_folder_of_something_else_stays_as_it_was(world: Path, tmp_path: Path) -> None:
    labels = new_file(tmp_path / "teacher/00/000000.npy", "mine")
    refused(command(world, tmp_path), "another run or teacher")
    assert labels.read_text() == "mine"
    assert len(list(tmp_path.rglob("*"))) == 3


@pytest.mark.full
def test_weights_that_are_no_surer_stay_as_they_were(
    world: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    out = shutil.copytree(world / "run", tmp_path / "run")
    monkeypatch.setattr(Figures, "is_better_than", lambda self, other: False)
    succeed(command(world, out, "--resume", "--seed", 0))  # the default seed
    assert load(out).digests() == load(world / "w.safetensors").digests()
    assert "the weights stay as they were" in capsys.readouterr().out


@pytest.mark.full
def test_labelled_scans_decide_which_weights_stay(
    world: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write_drive(tmp_path / "labelled", scans=1)
    shutil.copytree(world / "run", tmp_path / "run")
    val = f"--resume --val {tmp_path}/labelled"
    scores: list[float] = []
    for weights in (world / "w.safetensors", tmp_path / "run"):
        words = f"{tmp_path}/labelled --weights {weights} --split all --methods amvnet --json"
        succeed(f"evaluate {words} {tmp_path}/{len(scores)}.json")
        figures = json.loads((tmp_path / f"{len(scores)}.json").read_text())
        scores.append(figures["methods"]["amvnet"]["miou"])

    succeed(command(world, tmp_path / "run", val))
    printed = f"mIoU of the labelled scans: {scores[0]:.1%} before, {scores[1]:.1%} after"
    assert printed in capsys.readouterr().out
    kept = world / ("run" if scores[1] > scores[0] else "w.safetensors")
    assert load(tmp_path / "run").digests() == load(kept).digests()


def test_the_figures_of_labels_tell_which_are_surer() -> None:
    before = Figures(uncertain=0.2, agreement=0.8, consistency=0.9)
    assert Figures(0.1, 0.9, 0.8).is_better_than(before)
    assert not Figures(0.1, 0.7, 0.9).is_better_than(before)
    assert not Figures(0.3, 0.9, 0.9).is_better_than(before)
    assert not Figures(0.2, 0.9, 0.9).is_better_than(before)
    assert not Figures(0.1, 0.8, 0.9).is_better_than(before)


def test_the_recipe_has_the_values_of_the_options(world: Path) -> None:
    training = recipe_for(load(world / "w.safetensors"), epochs=3, streets=0.0, seed=7).training
    assert (training.rv.epochs, training.bev.epochs) == (3, 3)
    assert (training.others, training.seed) == (0.0, 7)


def test_adapted_weights_expect_the_scans_of_the_weights_that_taught(world: Path) -> None:
    """They label the drive as it was normalised for the training."""
    assert load(world / "run").expects == load(world / "w.safetensors").expects


def test_streets_need_a_sensor_that_can_be_simulated(world: Path, tmp_path: Path) -> None:
    refused(command(world, tmp_path / "run").replace("--streets 0", "--streets 0.5"), "--streets 0")
    assert not (tmp_path / "run").exists()


def test_weights_need_both_networks_and_a_head(world: Path, tmp_path: Path) -> None:
    weights = load(world / "w.safetensors")
    tensors = {name: t for name, t in weights.tensors.items() if not name.startswith("range_net")}
    path = save(replace(weights, tensors=tensors), tmp_path / "w.safetensors")
    line = command(world, tmp_path / "run").replace(f"{world}/w.safetensors", str(path))
    refused(line, "found no range_net; train that part")


@pytest.mark.full
def test_loose_scans_teach_by_their_own_labels(
    world: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(adapting, "LEAST_PROBABILITY", 0.07)
    scan = world / "data/sequences/00/velodyne/000000.bin"
    words = f"--weights {world}/w.safetensors --streets 0 --epochs 1"
    refused(f"adapt {scan} {words} --out {tmp_path}/a", "single scan")
    loose = f"adapt {scan} {words} --loose --out {tmp_path}/b"
    refused(f"{loose} --poses {scan}", "--loose")
    refused(f"{loose} --val-sequences 00", "expected --val,")
    code, _ = run_cli(*loose.split())
    assert code == 0
