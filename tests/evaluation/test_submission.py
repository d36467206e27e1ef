"""Archives for the servers keep to the official rules and have the same bytes every time."""

from __future__ import annotations

import json
import shutil
import zipfile
from pathlib import Path

import numpy as np
import pytest

from amvnet.data.datasets.open import open_dataset
from amvnet.data.taxonomy import NUSCENES, SEMANTICKITTI
from amvnet.evaluation.submission import rules_for, write_archive
from amvnet.weights.file import save

from fixtures.commands import fails, files, refused, run_cli
from fixtures.datasets import make_nuscenes
from fixtures.pages import DocsPage
from fixtures.submissions import TEST, Case, Entries, measured, read_entries, write_files
from fixtures.tiny import GOLDEN, fresh_weights, street, write_scan

# --- good archives ---


def submit(spec: str, *options: object) -> tuple[int, str]:
    return run_cli("submit", spec, *options)


def without_sources(entries: Entries) -> Entries:
    return {name: content for name, content in entries.items() if not name.endswith(("/", ".json"))}


def test_a_packed_archive_keeps_to_the_official_rules(case: Case, tmp_path: Path) -> None:
    out = tmp_path / "deep" / "s.zip"
    assert submit(case.spec, "--predictions", case.predictions, "--out", out) == (0, "")

    assert files(tmp_path) == {"deep/s.zip"}
    assert case.official(out, case.data) == []
    assert without_sources(read_entries(out)) == without_sources(case.good)


def test_the_same_predictions_give_the_same_bytes(case: Case, tmp_path: Path) -> None:
    copy = tmp_path / "copy"
    write_files(copy, dict(reversed(case.good.items())))
    (copy / "notes.txt").write_text("not packed")

    first = tmp_path / "a.zip"
    second = tmp_path / "b.zip"
    submit(case.spec, "--predictions", case.predictions, "--out", first)
    submit(case.spec, "--predictions", copy, "--out", second)
    assert first.read_bytes() == second.read_bytes()

    # The bytes do not depend on the day, either.
    with zipfile.ZipFile(first) as archive:
        for entry in archive.infolist():
            assert entry.date_time == (1980, 1, 1, 0, 0, 0)


def test_scores_are_not_packed(cases: dict[str, Case], tmp_path: Path) -> None:
    case = cases["semantickitti"]
    folder = tmp_path / "p"
    out = tmp_path / "s.zip"
    write_files(folder, case.good)
    (folder / "sequences/11/predictions/000000.npz").write_bytes(b"scores")

    assert submit(case.spec, "--predictions", folder, "--out", out) == (0, "")
    with zipfile.ZipFile(out) as archive:
        assert set(archive.namelist()) == {*case.good}


@pytest.mark.parametrize(
    ("options", "sources"),
    [((), {"use_lidar"}), (("--use-external",), {"use_lidar", "use_external"})],
)
def test_the_flags_declare_what_the_method_uses(
    options: tuple[str, ...], sources: set[str], cases: dict[str, Case], tmp_path: Path
) -> None:
    case = cases["nuscenes"]
    out = tmp_path / "s.zip"
    assert submit(case.spec, "--predictions", case.predictions, "--out", out, *options) == (0, "")

    assert case.official(out, case.data) == []
    flags = json.loads(read_entries(out)["test/submission.json"])["meta"]
    assert {key for key, flag in flags.items() if flag} == sources


@pytest.mark.parametrize(("name", "folder"), [("semantickitti", "."), ("nuscenes", "results")])
def test_the_golden_validation_sets_can_be_packed(name: str, folder: str, tmp_path: Path) -> None:
    predictions = GOLDEN / name / folder
    options = ("--split", "val", "--predictions", predictions, "--out", tmp_path / "s.zip")
    assert submit(f"{name}:{GOLDEN / name}", *options) == (0, "")


# --- writing ---


def peak_memory(root: Path, scans: int, points: int) -> int:
    """Return the peak memory in bytes of packing a set of random predictions."""
    raw = np.random.default_rng(0).choice(SEMANTICKITTI.train_to_raw, points).astype(np.uint32)
    for scan in range(scans):
        write_scan(root, "08", f"{scan:06d}", np.ones((points, 4)), None)
        write_files(root, {f"sequences/08/predictions/{scan:06d}.label": raw.tobytes()})

    rules = rules_for(open_dataset(str(root)), "val")
    _, peak = measured(lambda: write_archive(rules, root, root / "s.zip"))
    return peak


def test_memory_does_not_grow_with_the_scans(tmp_path: Path) -> None:
    points = 60_000
    scan_bytes = 4 * points
    few = peak_memory(tmp_path / "few", 2, points)
    many = peak_memory(tmp_path / "many", 12, points)

    assert abs(few - many) < scan_bytes / 4
    assert max(few, many) < 12 * scan_bytes


def test_a_fault_leaves_the_old_archive(case: Case, tmp_path: Path) -> None:
    folder = tmp_path / "p"
    out = tmp_path / "s.zip"
    write_files(folder, case.good)
    of_yesterday = b"PK\3\4" + bytes(26) + b"sequences/PK"
    out.write_bytes(of_yesterday)

    prediction = folder / case.last
    content = prediction.read_bytes()
    for fault in (b"\xff" * len(content), content[:-1], None):
        if fault is None:
            prediction.unlink()
        else:
            prediction.write_bytes(fault)

        options = ("--predictions", folder, "--out", out, "--overwrite")
        refused(("submit", case.spec, *options), case.last)
        assert out.read_bytes() == of_yesterday
        assert sorted(tmp_path.iterdir()) == [folder, out]


MISTAKES = {
    "neither": "",
    "only predictions": "--predictions {p}",
    "no folder": "--predictions {p}/none --out {out}",
    "another ending": "--predictions {p} --out {out}.tar",
    "split that is not there": "--predictions {p} --out {out} --split train",
    "sequence that is not there": "--predictions {p} --out {out} --sequences 77",
    "no sequence": "--predictions {p} --out {out} --sequences ,",
}


@pytest.mark.parametrize("mistake", MISTAKES)
def test_a_mistake_is_one_line(mistake: str, case: Case, tmp_path: Path) -> None:
    options = MISTAKES[mistake].format(p=case.predictions, out=tmp_path / "s.zip").split()
    refused(("submit", case.spec, *options), "expected", "found", "; ")
    assert not files(tmp_path)


def test_flags_are_for_nuscenes(cases: dict[str, Case], tmp_path: Path) -> None:
    case = cases["semantickitti"]
    options = ("--predictions", case.predictions, "--out", tmp_path / "s.zip", "--use-external")
    refused(("submit", case.spec, *options), "nuScenes")


def test_the_scenes_of_an_archive_are_of_one_split(tmp_path: Path) -> None:
    # A scene of mini_val and one of mini_train.
    dataset = open_dataset(make_nuscenes(tmp_path).spec)
    fails(lambda: rules_for(dataset, "test"), "test", "--split")
    fails(lambda: rules_for(dataset, "val", ["scene-0061", "scene-0103"]), "mini_train, mini_val")

    for split in ("train", "val"):
        for name in rules_for(dataset, split).points:
            assert name.startswith(f"lidarseg/mini_{split}/")


def test_scans_of_the_test_split_must_be_on_disk(tmp_path: Path) -> None:
    dataset = make_nuscenes(tmp_path / "nuscenes")
    for path in tmp_path.glob("nuscenes/samples/LIDAR_TOP/*"):
        path.unlink()
    fails(lambda: rules_for(open_dataset(dataset.spec), "val"), "complete the dataset")

    for sequence in TEST[:-1]:
        write_scan(tmp_path / "kitti", sequence, "000000", np.ones((5, 4)), None)
    fails(lambda: rules_for(open_dataset(f"{tmp_path}/kitti"), "test"), TEST[-1])


def test_an_archive_of_fewer_scans_than_the_benchmark_has_is_noted(
    cases: dict[str, Case], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    case = cases["semantickitti"]
    options = ("--predictions", case.predictions, "--out", tmp_path / "s.zip")
    assert submit(case.spec, *options) == (0, "")
    assert "20351" in capsys.readouterr().out


def test_from_scans_without_labels_to_an_archive(tmp_path: Path) -> None:
    data = tmp_path / "data"
    for seed, sequence in enumerate(("11", "12")):
        points, _ = street(seed)
        write_scan(data, sequence, "000000", points, None)
    weights = save(fresh_weights(), tmp_path / "w.safetensors")

    spec = f"semantickitti:{data}"
    trial = (spec, "--sequences", "11,12")
    predictions = tmp_path / "predictions"
    out = tmp_path / "s.zip"
    options = ("--weights", weights, "--out", predictions, "--scores")
    assert run_cli("predict", *trial, *options) == (0, "")
    assert submit(*trial, "--predictions", predictions, "--out", out) == (0, "")

    first, second = without_sources(read_entries(out)).items()
    assert first[0] == "sequences/11/predictions/000000.label"
    assert second[0] == "sequences/12/predictions/000000.label"
    assert len(first[1]) == len(second[1]) == 500 * 4

    # Of the whole test split, nine sequences are missing.
    refused(("submit", spec, "--predictions", predictions, "--out", out))


# --- the page of the documentation ---


@pytest.mark.full
def test_every_command_of_the_page_runs(
    cases: dict[str, Case], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    for name in ("semantickitti", "nuscenes"):
        shutil.copytree(cases[name].data, tmp_path / "data" / name)
    for sequence in ("08", *TEST):
        points, raw = street(int(sequence))
        write_scan(tmp_path / "data/semantickitti", sequence, "000000", points, raw)
    save(fresh_weights(), tmp_path / "runs/kitti/weights.safetensors")
    save(fresh_weights(NUSCENES), tmp_path / "runs/nuscenes/weights.safetensors")

    commands = DocsPage("docs/submission.md").commands
    assert len(commands) >= 6
    for command in commands:
        program, *arguments = [word.replace("/data/", f"{tmp_path}/data/") for word in command]
        assert program == "amvnet"
        if "val" in arguments:
            # The page assumes that the validation split has been predicted.
            options = ("--sequences", "08", "--weights", "runs/kitti", "--out", "predictions")
            assert run_cli("predict", arguments[1], *options, "--resume") == (0, "")

        assert run_cli(*arguments) == (0, ""), command
