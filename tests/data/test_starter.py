"""A folder of scans without a description gets the beginning of one."""

from __future__ import annotations

import os
import shlex
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from amvnet.cli.options import LabelledChoice
from amvnet.data.datasets.open import open_dataset
from amvnet.data.datasets.own import open_own
from amvnet.data.datasets.starter import write_starter
from amvnet.data.labels.writers import write_scan_labels
from amvnet.data.taxonomy import SEMANTICKITTI

from fixtures.commands import files, new_file, refusal, refused, succeed
from fixtures.own_scans import SCANS, SITES, make_own_scans, own_labels, robot_scans
from fixtures.scan_writers import write_pcd


def make_flat(folder: Path, count: int, scans: str, labels: str = "") -> Path:
    """Write scans of a robot, and labels if they have a name, under names with their number."""
    for index in range(count):
        scan = robot_scans(index // SCANS % len(SITES))[index % SCANS]
        for name in filter(None, (scans, labels)):
            path = folder / name.format(index)
            path.parent.mkdir(parents=True, exist_ok=True)
            if name == labels:
                np.save(path, own_labels(scan))
            elif path.suffix == ".npy":
                np.save(path, scan.points)
            else:
                write_pcd(path, scan.points, "binary")
    return folder


def test_the_beginning_of_a_description_has_all_scans_labels_and_ids(tmp_path: Path) -> None:
    described = open_own(make_own_scans(tmp_path / "robot"))
    (tmp_path / "robot/robot.yaml").unlink()
    path, found = write_starter(tmp_path / "robot")
    assert path == tmp_path / "robot.yaml"

    started = open_own(path)
    records = started.records(started.parts()["all"])
    expected = described.records(described.parts()["all"])
    assert [record.name for record in records] == [record.name for record in expected]
    for record, other in zip(records, expected, strict=True):
        assert record.labels_path == other.labels_path
        ignored = np.array_equal(
            started.read(record).labels == 0, described.read(other).labels == 0
        )
        assert ignored
    labels = [own_labels(scan) for site in range(len(SITES)) for scan in robot_scans(site)]
    raw, counts = np.unique(np.concatenate(labels).view(np.uint16), return_counts=True)
    assert found.ids == dict(zip(raw.tolist(), counts.tolist(), strict=True))


@pytest.mark.parametrize(
    ("scans", "labels"),
    [
        ("{:04d}.pcd", "{:04d}.npy"),
        ("{:04d}.npy", "{:04d}_class.npy"),
        ("points/{:04d}.npy", "labels/{:04d}.npy"),
        ("a/b/{:04d}.pcd", "a/truth/label_{:04d}.npy"),
        ("run[1]/{:04d}.PCD", "run[1]/{:04d}.npy"),
        ("run?/{:04d}.Pcd", "truth/{:04d}.npy"),
    ],
)
def test_scans_and_labels_are_told_apart_whatever_their_names(
    tmp_path: Path, scans: str, labels: str
) -> None:
    path, found = write_starter(make_flat(tmp_path / "data", 3, scans, labels))
    assert found.scans == [tmp_path / "data" / scans.format(index) for index in range(3)]
    started = open_own(path)
    paths = sorted(str(record.labels_path) for record in started.records(started.parts()["all"]))
    assert paths == [str(tmp_path / "data" / labels.format(index)) for index in range(3)]


def test_labels_in_a_folder_beside_the_scans_are_found(tmp_path: Path) -> None:
    for below in ("", "a/"):
        data = make_flat(tmp_path / f"{below}x", 3, f"scans/{below}{{:04d}}.pcd")
        make_flat(data, 3, "points/{:04d}.npy", f"labels/{below}{{:04d}}.npy")
        new_file(data / "photos/0000.jpg", b"photo")
        path, found = write_starter(data / "scans")
        assert found.labelled == 3
        started = open_own(path)
        assert [record.labels_path for record in started.records(started.parts()["all"])] == [
            data / "labels" / below / f"{index:04d}.npy" for index in range(3)
        ]


@pytest.mark.parametrize("others", [(), (252, 259)])
def test_ids_that_usually_stand_for_no_label_are_ignored_with_their_shares(
    tmp_path: Path, others: tuple[int, ...]
) -> None:
    folder = make_flat(tmp_path / "data", 3, "{:04d}.pcd", "{:04d}.npy")
    for path in folder.glob("*.npy"):
        labels = np.load(path)
        labels[: len(labels) // 4] = 255
        labels[len(labels) - len(others) :] = others
        np.save(path, labels)
    path, found = write_starter(folder)
    text = path.read_text()
    shares = {raw: f"{count / sum(found.ids.values()):.1%}" for raw, count in found.ids.items()}
    assert (f"class_255: 255  # {shares[255]}" in text) == bool(others)
    assert (f"255: {shares[255]}" in text.partition("# ids without a class")[2]) != bool(others)
    assert f"-1: {shares[65535]}" in text
    succeed(f"check {path}")


def test_the_id_that_labels_name_as_none_is_ignored(tmp_path: Path) -> None:
    folder = make_flat(tmp_path / "data", 2, "{:04d}.npy")
    none = replace(SEMANTICKITTI, name="own", train_to_raw=(77, *SEMANTICKITTI.train_to_raw[1:]))
    for path in sorted(folder.glob("*.npy")):
        points = np.load(path)
        ids = np.arange(len(points)) % 3
        write_scan_labels(folder / f"{path.stem}_labels", "ply", points[:, :3], ids, none)
    path, _ = write_starter(folder)
    assert "ignored: [77]  # ids without a class; 77: 33.3%" in path.read_text()
    assert "class_10: 10  # 33.3%" in path.read_text()


def test_check_of_a_folder_writes_the_file_once_and_says_what_to_fill_in(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = make_flat(tmp_path / "data", 3, "{:04d}.pcd", "{:04d}.npy")
    refused(f"check {folder}", "name its classes", f"{folder}.yaml")
    assert "3 scans *.pcd" in capsys.readouterr().out

    text = Path(f"{folder}.yaml").read_text().replace("class_3", "ground")
    Path(f"{folder}.yaml").write_text(text)
    refused(f"check {folder}", "did you mean")
    assert Path(f"{folder}.yaml").read_text() == text
    succeed(f"check {folder}.yaml")


def test_scans_without_labels_get_a_file_that_says_so(tmp_path: Path) -> None:
    path, found = write_starter(make_flat(tmp_path / "data", 2, "{:04d}.pcd"))
    assert found.labels is None
    assert "no file with a label for each point" in list(found.lines())[1]
    assert not path.read_text().count("class_")
    refused(f"check {path}", "no labels in the description")


def test_a_folder_without_scans_gets_no_file(tmp_path: Path) -> None:
    new_file(tmp_path / "data/scan.pcd", "no scan")
    refused(f"check {tmp_path / 'data'}", "found none that can be read")
    assert not (tmp_path / "data.yaml").exists()


@pytest.mark.parametrize("name", ["my data", "a:b", "-dash", "[x]", "ü ✓", "a#b", "{name}", "'\""])
def test_a_folder_may_have_any_name(tmp_path: Path, name: str) -> None:
    line = refusal("check", make_flat(tmp_path / name, 3, "{:04d}.pcd", "{:04d}.npy"))
    command = shlex.split(line[line.index("amvnet check") :])
    succeed(*command[1:])


@pytest.mark.parametrize("name", ["a\nb", os.fsdecode(b"a\xff")])
def test_a_name_that_no_yaml_file_holds_is_refused(tmp_path: Path, name: str) -> None:
    refused(("check", make_flat(tmp_path / name, 3, "{:04d}.pcd")), "printable", "rename")
    assert files(tmp_path) == {f"{name}/{index:04d}.pcd" for index in range(3)}


def test_the_file_of_read_only_data_comes_into_the_current_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = make_flat(tmp_path / "shared/data", 3, "{:04d}.pcd", "{:04d}.npy")
    monkeypatch.setattr(os, "access", lambda path, mode: Path(path) != folder.parent)
    (tmp_path / "here").mkdir()
    monkeypatch.chdir(tmp_path / "here")
    refused(
        f"check {folder}", f"amvnet: wrote {tmp_path}/here/data.yaml: name its classes, then run"
    )
    assert not Path(f"{folder}.yaml").exists()
    succeed("check data.yaml")
    before = Path("data.yaml").read_bytes()
    refused(f"check {folder}", "read-only", "found", "amvnet check data.yaml")
    assert Path("data.yaml").read_bytes() == before


# ---- the split of a single sequence


@pytest.mark.parametrize(("count", "validating"), [(2, 1), (6, 1), (21, 2)])
def test_the_last_tenth_of_a_single_sequence_validates(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], count: int, validating: int
) -> None:
    path, _ = write_starter(make_flat(tmp_path / "data", count, "{:04d}.pcd", "{:04d}.npy"))
    dataset = open_dataset(str(path))
    train, val = (dataset.records(names) for names in dataset.split().choose())
    assert [record.name for record in (*train, *val)] == [f"{index:04d}" for index in range(count)]
    assert len(val) == validating
    succeed(f"check {path}")
    assert f"no split: {validating} scan" in capsys.readouterr().out

    LabelledChoice().records(dataset)
    printed = " ".join(capsys.readouterr().out.split())
    assert f"labelled scans: {validating} scan" in printed
    assert f"those that validate without a split; --split all takes all {count}" in printed
    LabelledChoice(split="all").records(dataset)
    path.write_text(f"{path.read_text()}split: {{val: ['0000']}}\n")
    LabelledChoice().records(open_dataset(str(path)))
    assert "without a split" not in capsys.readouterr().out


def test_a_split_takes_patterns_with_or_without_the_ending_and_shows_a_whole_name(
    tmp_path: Path,
) -> None:
    folder = make_flat(tmp_path / "data", 4, "clouds/{:04d}.pcd", "truth/{:04d}.npy")
    path, _ = write_starter(folder)
    text = path.read_text()
    for entry in ("clouds/000[23]", "clouds/000[23].pcd", "*/000[23]*"):
        path.write_text(f"{text}split: {{val: ['{entry}']}}\n")
        dataset = open_dataset(str(path))
        names = [record.name for record in dataset.records(dataset.sequences("val"))]
        assert names == ["clouds/0002", "clouds/0003"]
    path.write_text(f"{text}split: {{val: ['000[23]']}}\n")
    refused(f"check {path}", "matches none", "such as clouds/0000")


def test_labels_that_are_not_found_are_shown_with_their_path(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = make_flat(tmp_path / "data", 4, "clouds/{:04d}.pcd", "truth/{:04d}.npy")
    path, _ = write_starter(folder)
    (folder / "truth/0001.npy").unlink()
    succeed(f"check {path}")
    assert f"clouds/0001 (no {folder}/truth/0001.npy)" in capsys.readouterr().out
    path.write_text(path.read_text().replace("truth", "thruth"))
    refused(f"check {path}", f"no {folder}/thruth/0000.npy", "the other 3 scans")


def test_names_is_answered_with_classes(tmp_path: Path) -> None:
    path = new_file(tmp_path / "own.yaml", "names: {car: 1}\nscans: '*.npy'\n")
    refused(f"check {path}", "did you mean classes?")
