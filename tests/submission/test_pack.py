"""Archives for the servers: what is written keeps to the rules re-told plainly, streams, and is the same every time."""

from __future__ import annotations

import json
import shutil
import zipfile
from pathlib import Path

import numpy as np
import pytest

from amvnet.data.datasets.open import open_dataset
from amvnet.data.taxonomy import NUSCENES, SEMANTICKITTI
from amvnet.submission import pack as submission
from amvnet.submission.rules import TEST_SCANS, rules_for
from amvnet.weights.file import save

from fixtures.datasets import make_nuscenes
from fixtures.submissions import TEST, Case, measured, write_files
from fixtures.worlds import (
    GOLDEN,
    commands_of,
    fails,
    files,
    fresh_weights,
    run_cli,
    street,
    write_scan,
)

# ---- good archives


def test_what_is_written_keeps_to_the_official_rules(case: Case, tmp_path: Path) -> None:
    out = tmp_path / "deep" / "s.zip"
    assert run_cli("submit", case.spec, "--predictions", case.predictions, "--out", out) == (0, "")
    assert case.official(out, case.data) == []
    with zipfile.ZipFile(out) as archive:
        assert archive.testzip() is None
        packed = {name: archive.read(name) for name in archive.namelist()}
    assert {k: v for k, v in packed.items() if k[-1] != "/" and k[-5:] != ".json"} == {
        k: v for k, v in case.good.items() if k[-1] != "/" and k[-5:] != ".json"
    }
    assert run_cli("submit", case.spec, "--check", out) == (0, "")
    assert files(tmp_path) == {"deep/s.zip"}


def test_archives_of_other_tools_are_taken(case: Case, tmp_path: Path) -> None:
    shutil.make_archive(str(tmp_path / "shutil"), "zip", case.predictions)
    case.pack(tmp_path / "stored.zip", method=zipfile.ZIP_STORED)
    case.pack(tmp_path / "backwards.zip", dict(reversed(case.good.items())))
    for path in tmp_path.glob("*.zip"):
        assert case.official(path, case.data) == []
        assert run_cli("submit", case.spec, "--check", path) == (0, "")


def test_the_same_predictions_give_the_same_bytes(case: Case, tmp_path: Path) -> None:
    copy = tmp_path / "copy"
    write_files(copy, dict(reversed(case.good.items())))
    (copy / "notes.txt").write_text("stays out")
    for folder, name in ((case.predictions, "a.zip"), (copy, "b.zip")):
        assert (
            run_cli("submit", case.spec, "--predictions", folder, "--out", tmp_path / name)[0] == 0
        )
    assert (tmp_path / "a.zip").read_bytes() == (tmp_path / "b.zip").read_bytes()
    with zipfile.ZipFile(tmp_path / "a.zip") as archive:
        assert {entry.date_time for entry in archive.infolist()} == {
            (1980, 1, 1, 0, 0, 0)
        }  # tomorrow's bytes, too


def test_a_description_goes_along(cases: dict[str, Case], tmp_path: Path) -> None:
    case = cases["semantickitti"]
    described = {
        **case.good,
        "description.txt": b"method name: none",
        "sequences/11/predictions/000000.npz": b"scores",
    }
    write_files(tmp_path / "p", described)
    out = tmp_path / "s.zip"
    assert run_cli("submit", case.spec, "--predictions", tmp_path / "p", "--out", out)[0] == 0
    assert run_cli("submit", case.spec, "--check", out)[0] == 0
    with zipfile.ZipFile(out) as archive:
        assert set(archive.namelist()) == {*case.good, "description.txt"}


def test_the_flags_say_what_the_method_was_given(cases: dict[str, Case], tmp_path: Path) -> None:
    case, out = cases["nuscenes"], tmp_path / "s.zip"
    for options, true in (
        ((), {"use_lidar"}),
        (("--use-camera", "--no-use-lidar", "--use-map"), {"use_camera", "use_map"}),
    ):
        assert (
            run_cli("submit", case.spec, "--predictions", case.predictions, "--out", out, *options)[
                0
            ]
            == 0
        )
        assert case.official(out, case.data) == []
        with zipfile.ZipFile(out) as archive:
            meta = json.loads(archive.read("test/submission.json"))["meta"]
        assert {key for key, value in meta.items() if value} == true


@pytest.mark.parametrize(("name", "folder"), [("semantickitti", "."), ("nuscenes", "results")])
def test_the_golden_validation_sets_can_be_packed(name: str, folder: str, tmp_path: Path) -> None:
    spec, out = f"{name}:{GOLDEN / name}", tmp_path / "s.zip"
    options = ("--split", "val", "--out", out)
    assert run_cli("submit", spec, "--predictions", GOLDEN / name / folder, *options) == (0, "")
    assert run_cli("submit", spec, "--split", "val", "--check", out) == (0, "")


# ---- writing


def test_memory_does_not_grow_with_the_scans(tmp_path: Path) -> None:
    points, peaks = np.ones((60_000, 4)), []
    for scans in (2, 12):
        root, name = tmp_path / str(scans), "sequences/08/predictions/{:06d}.label"
        for scan in range(scans):
            write_scan(root, "08", f"{scan:06d}", points, None)
        raw = (
            np.random.default_rng(0)
            .choice(SEMANTICKITTI.train_to_raw, len(points))
            .astype(np.uint32)
        )
        write_files(root, {name.format(scan): raw.tobytes() for scan in range(scans)})
        rules = rules_for(open_dataset(str(root)), "val")
        peaks.append([
            measured(lambda root=root, rules=rules: submission.write(rules, root, root / "s.zip"))[1],
            measured(lambda root=root, rules=rules: submission.check(rules, root / "s.zip"))[1],
        ])  # fmt: skip
    assert np.abs(np.subtract(*peaks)).max() < raw.nbytes / 4
    assert np.max(peaks) < 12 * raw.nbytes


def test_a_fault_leaves_what_was_there(case: Case, tmp_path: Path) -> None:
    folder, out = tmp_path / "p", tmp_path / "s.zip"
    write_files(folder, case.good)
    out.write_bytes(b"of yesterday")
    last = max(name for name in case.good if name.endswith((".label", ".bin")))
    for content in (b"\xff" * len(case.good[last]), case.good[last][:-1], None):
        (folder / last).unlink() if content is None else (folder / last).write_bytes(content)
        code, error = run_cli("submit", case.spec, "--predictions", folder, "--out", out)
        assert (code, error.count("\n")) == (2, 1)
        assert last in error
        assert out.read_bytes() == b"of yesterday"
        assert [path.name for path in tmp_path.iterdir() if path.is_file()] == ["s.zip"]


MISTAKES = {
    "neither": "",
    "predictions alone": "--predictions {p}",
    "both": "--predictions {p} --out {out} --check {out}",
    "no folder": "--predictions {p}/none --out {out}",
    "another ending": "--predictions {p} --out {out}.tar",
    "another ending to check": "--check {p}",
    "nothing to check": "--check {out}",
    "flag of a check": "--check {out} --use-map",
    "split that is not there": "--predictions {p} --out {out} --split train",
    "sequence that is not there": "--predictions {p} --out {out} --sequences 77",
    "no sequence": "--predictions {p} --out {out} --sequences ,",
}


@pytest.mark.parametrize("mistake", MISTAKES)
def test_a_mistake_is_one_line(mistake: str, case: Case, tmp_path: Path) -> None:
    options = MISTAKES[mistake].format(p=case.predictions, out=tmp_path / "s.zip").split()
    code, error = run_cli("submit", case.spec, *options)
    assert (code, error.count("\n")) == (2, 1), error
    assert all(word in error for word in ("expected", "found", "; "))
    assert not files(tmp_path)


def test_flags_are_for_nuscenes(cases: dict[str, Case], tmp_path: Path) -> None:
    case = cases["semantickitti"]
    options = ("--predictions", case.predictions, "--out", tmp_path / "s.zip")
    for flag in ("--use-external", "--no-use-lidar"):
        code, error = run_cli("submit", case.spec, *options, flag)
        assert (code, "nuScenes" in error) == (2, True)


def test_the_scenes_of_an_archive_are_of_one_split(tmp_path: Path) -> None:
    dataset = open_dataset(
        make_nuscenes(tmp_path).spec
    )  # a scene of mini_val and one of mini_train
    fails(lambda: rules_for(dataset, "test"), "test", "--split")
    fails(lambda: rules_for(dataset, "val", ["scene-0061", "scene-0103"]), "mini_train, mini_val")
    for split in ("train", "val"):
        assert {name.split("/")[1] for name in rules_for(dataset, split).points} == {
            f"mini_{split}"
        }


def test_scans_that_are_not_on_disk_are_wanted_all_the_same(tmp_path: Path) -> None:
    dataset = open_dataset(make_nuscenes(tmp_path).spec)
    whole = rules_for(dataset, "val")
    for path in tmp_path.glob("samples/LIDAR_TOP/*"):
        path.unlink()
    rules = rules_for(dataset, "val")
    assert set(rules.required) == set(whole.required)
    assert set(rules.points.values()) == {None}


# ---- test sequences, of which not all are on disk


def test_sequences_that_are_not_on_disk_must_be_predicted_all_the_same(tmp_path: Path) -> None:
    for sequence in TEST[:-1]:
        write_scan(tmp_path, sequence, "000000", np.ones((5, 4)), None)
    rules = rules_for(open_dataset(str(tmp_path)), "test")
    assert len(rules.required) == 10 + TEST_SCANS["21"]
    assert rules.official == len(rules.points) == 20351
    good = {name: np.full(5, 40, "<u4").tobytes() for name in rules.required}
    fails(
        lambda: submission.write(rules, tmp_path, tmp_path / "s.zip"),
        f"{len(good)} scans",
        f"{len(good) - 1} more",
    )
    write_files(tmp_path, good)
    found = submission.write(rules, tmp_path, tmp_path / "s.zip")
    assert (found.predictions, found.unmatched) == (len(good), TEST_SCANS["21"])
    assert len(found.notes) == 2
    assert submission.check(rules, tmp_path / "s.zip") == found


def test_from_scans_without_labels_to_an_archive(tmp_path: Path) -> None:
    data, predictions, out = tmp_path / "data", tmp_path / "predictions", tmp_path / "s.zip"
    for place, sequence in enumerate(("11", "12")):
        write_scan(data, sequence, "000000", street(place)[0], None)
    save(fresh_weights(), tmp_path / "w.safetensors")
    spec, named = f"semantickitti:{data}", ("--sequences", "11,12")
    weights = ("--weights", tmp_path / "w.safetensors")
    assert run_cli("predict", spec, *named, *weights, "--out", predictions, "--scores") == (0, "")
    assert run_cli("submit", spec, *named, "--predictions", predictions, "--out", out) == (0, "")
    assert run_cli("submit", spec, *named, "--check", out) == (0, "")
    assert (
        run_cli("submit", spec, "--predictions", predictions, "--out", out)[0] == 2
    )  # nine sequences are missing
    with zipfile.ZipFile(out) as archive:
        packed = [name for name in archive.namelist() if not name.endswith("/")]
        assert packed == [f"sequences/{s}/predictions/000000.label" for s in ("11", "12")]
        assert all(archive.getinfo(name).file_size == 500 * 4 for name in packed)


# ---- the page of the docs


def test_every_command_of_the_page_runs(
    cases: dict[str, Case], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    for name in ("semantickitti", "nuscenes"):
        shutil.copytree(cases[name].data, tmp_path / "data" / name)
    for sequence in ("08", *TEST):
        write_scan(tmp_path / "data/semantickitti", sequence, "000000", *street(int(sequence)))
    save(fresh_weights(), tmp_path / "runs/kitti/weights.safetensors")
    save(fresh_weights(NUSCENES), tmp_path / "runs/nuscenes/weights.safetensors")
    commands = commands_of("docs/submission.md")
    assert len(commands) >= 8
    for command in commands:
        words = [word.replace("/data/", f"{tmp_path}/data/") for word in command]
        if "val" in words:
            run_cli(
                "predict",
                words[2],
                "--sequences",
                "08",
                "--weights",
                "runs/kitti",
                "--out",
                "predictions",
            )
        assert words[0] == "amvnet"
        assert run_cli(*words[1:]) == (0, ""), command
