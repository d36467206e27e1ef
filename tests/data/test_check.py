"""The check of labelled scans: what it counts, and what it refuses."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from amvnet.data.check import check_scans
from amvnet.data.datasets.open import open_dataset
from amvnet.data.datasets.own import open_own

from fixtures.commands import run_cli
from fixtures.datasets import MAKERS
from fixtures.examples import first_of
from fixtures.scan_writers import some_points
from fixtures.tiny import make_streets, write_recipe

SITES = ("a", "b", "c")  # c validates
RAW = np.random.default_rng(1).choice([3, 7, 40], 60)
BASE: dict[str, Any] = {
    "classes": {"ground": 3, "plant": [7, 8], "car": 11},
    "ignored": [40],
    "scans": "*/*.npy",
    "labels": ".label",
}


@pytest.fixture
def data(tmp_path: Path) -> Path:
    """Two scans at each site; return the file that describes them."""
    for number, site in enumerate(SITES):
        (tmp_path / site).mkdir()
        for index in range(2):
            np.save(tmp_path / f"{site}/{index}.npy", some_points(seed=2 * number + index))
            write_labels(tmp_path / f"{site}/{index}.label", RAW)
    return describe(tmp_path)


def describe(folder: Path, **changes: Any) -> Path:
    path = folder / "own.yaml"
    path.write_text(yaml.safe_dump({**BASE, **changes}, sort_keys=False))
    return path


def write_labels(path: Path, raw: np.ndarray) -> None:
    raw.astype(np.uint32).tofile(path)


each_command = pytest.mark.parametrize("command", first_of(("check", "train")))


def refusal(command: str, data: Path) -> str:
    """Check data that must be refused, or start a training with them; return the message."""
    if command == "train":
        return train(data)
    code, error = run_cli("check", data)
    assert code == 2
    return error


def train(data: Path) -> str:
    """Start a training that must be refused before it makes its folder; return its line."""
    recipe = write_recipe(data.parent / "recipe.yaml")
    code, error = run_cli("train", recipe, "--data", data, "--out", data.parent / "run")
    assert code == 2
    assert error.count("\n") == 1
    assert not (data.parent / "run").exists()
    return error


def test_points_and_scans_are_counted_by_class(data: Path) -> None:
    dataset = open_own(data)
    splits = {split: dataset.records(dataset.sequences(split)) for split in ("train", "val")}
    report = check_scans(dataset, splits)
    once = [np.count_nonzero(raw == RAW) for raw in (40, 3, 7, 11)]
    for split, scans in (("train", 4), ("val", 2)):
        assert report.splits[split].points.tolist() == [scans * count for count in once]
        assert report.splits[split].scans_with.tolist() == [scans, scans, scans, 0]
    assert list(report.errors()) == []
    assert list(report.warnings()) == ["train: no point of car", "val: no point of car"]


@pytest.mark.parametrize("name", MAKERS)
def test_the_counts_of_a_benchmark_are_those_of_its_scans(name: str, tmp_path: Path) -> None:
    dataset = open_dataset(MAKERS[name](tmp_path / "set").spec)
    records = dataset.having_labels(dataset.records(dataset.sequences("all")))
    report = check_scans(dataset, {"train": records})
    labels = [dataset.read(record).labels for record in records]
    expected = np.bincount(
        np.concatenate([*labels, []]).astype(int), minlength=dataset.taxonomy.size + 1
    )
    np.testing.assert_array_equal(report.splits["train"].points, expected)
    np.testing.assert_array_equal(report.count_points(records), expected)


@each_command
def test_every_unknown_id_is_found_before_a_training(data: Path, command: str) -> None:
    raw = RAW.copy()
    raw[:5], raw[5:8] = 55, 1000
    write_labels(data.parent / "c/1.label", raw)  # of a scan to validate with
    write_labels(data.parent / "a/0.label", np.where(np.arange(60) == 0, 55, RAW))
    error = refusal(command, data)
    assert "55 (6 points in 2 scans, such as" in error
    assert f"1000 (3 points in 1 scan, such as {data.parent / 'c/1.label'})" in error
    assert "ignored: rest" in error


@each_command
def test_labels_without_a_class_or_of_one_class_are_not_trained_on(
    data: Path, command: str
) -> None:
    for site in ("a", "b"):
        for index in range(2):
            write_labels(data.parent / f"{site}/{index}.label", np.full(60, 40))
    assert "all ignored" in refusal(command, data)

    for site in ("a", "b"):
        for index in range(2):
            write_labels(data.parent / f"{site}/{index}.label", np.where(RAW == 7, 3, RAW))
    assert "only ground" in refusal(command, data)

    describe(data.parent, classes={"ground": [3, 7]})
    assert "two or more classes" in refusal(command, data)


@each_command
def test_nothing_to_validate_with_is_refused(data: Path, command: str) -> None:
    for index in range(2):
        write_labels(data.parent / f"c/{index}.label", np.full(60, 40))
    assert "validate" in refusal(command, data)


def test_missing_label_files_are_skipped_and_counted(
    data: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (data.parent / "b/1.label").unlink()
    assert run_cli("check", data)[0] == 0
    text = capsys.readouterr().out
    assert "train: skipped for lack of labels: 1 of 4 scans, such as b/1" in text
    assert text.count("skipped") == 1
    assert "5 scans can be" in text

    # In every layout.
    streets = make_streets(data.parent / "streets")
    (streets / "sequences/01/labels/000001.label").unlink()
    assert run_cli("check", streets)[0] == 0
    assert "1 of 4 scans, such as 01/000001" in capsys.readouterr().out


def test_broken_scans_are_named_and_the_others_are_checked(
    data: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (data.parent / "a/1.npy").write_bytes(b"no array")
    np.save(data.parent / "c/0.npy", np.full((60, 4), np.nan))
    code, error = run_cli("check", data)
    assert code == 3
    assert "a/1.npy" in error
    assert "found 2 broken scans" in error
    assert "4 scans" not in error
    assert str(3 * np.count_nonzero(RAW == 3)) in capsys.readouterr().out


@pytest.mark.full
def test_no_training_starts_with_broken_scans(data: Path) -> None:
    (data.parent / "a/1.npy").write_bytes(b"no array")
    np.save(data.parent / "c/0.npy", np.full((60, 4), np.nan))
    line = train(data)
    assert "found 2 of 6 scans that cannot" in line
    assert "a/1.npy" in line


def test_one_broken_scan_is_one(data: Path) -> None:
    (data.parent / "a/1.npy").write_bytes(b"no array")
    code, error = run_cli("check", data)
    assert code == 3
    assert "found 1 broken scan; correct it or leave it out" in error


def test_labels_that_change_are_read_again(data: Path) -> None:
    """Even if the size and the time of their file stay the same."""
    before = counts_of(data)
    path = data.parent / "a/0.label"
    status = path.stat()
    write_labels(path, np.full(60, 11))
    os.utime(path, ns=(status.st_atime_ns, status.st_mtime_ns))
    assert path.stat().st_size == status.st_size
    assert counts_of(data)[2] == before[2] + 60


def counts_of(data: Path) -> np.ndarray:
    """Return the (K,) points of each class in all splits, as `check` finds them."""
    dataset = open_dataset(str(data))
    records = dataset.records(dataset.sequences("all"))
    report = check_scans(dataset, {"train": records})
    return report.splits["train"].points[1:]
