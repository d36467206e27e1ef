"""The check of labelled scans: what it counts, and what it refuses."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from amvnet.data.check import Report, check_scans
from amvnet.data.datasets.open import open_dataset
from amvnet.data.datasets.own import open_own
from amvnet.data.plausible import following, neighbours

from fixtures.commands import new_file, refusal, refused, run_cli, succeed
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
    return new_file(folder / "own.yaml", yaml.safe_dump({**BASE, **changes}, sort_keys=False))


def write_labels(path: Path, raw: np.ndarray) -> None:
    raw.astype(np.uint32).tofile(path)


def checked(data: Path) -> Report:
    """Return the report on the scans to train on and to validate with."""
    dataset = open_own(data)
    splits = {name: dataset.records(dataset.sequences(name)) for name in ("train", "val")}
    return check_scans(dataset, splits)


each_command = pytest.mark.parametrize("command", first_of(("check", "train")))


def refusal_by(command: str, data: Path) -> str:
    """Check data, or train on them before the run has a folder; return the line of the refusal."""
    if command == "check":
        return refusal("check", data)
    recipe = write_recipe(data.parent / "recipe.yaml")
    error = refusal("train", recipe, "--data", data, "--out", data.parent / "run")
    assert not (data.parent / "run").exists()
    return error


def test_points_and_scans_are_counted_by_class(data: Path) -> None:
    report = checked(data)
    once = [np.count_nonzero(raw == RAW) for raw in (40, 3, 7, 11)]
    for split, scans in (("train", 4), ("val", 2)):
        assert report.splits[split].points.tolist() == [scans * count for count in once]
        assert report.splits[split].scans_with.tolist() == [scans, scans, scans, 0]
    assert list(report.errors()) == []
    assert list(report.warnings()) == ["train: no point of car", "val: no point of car"]


@pytest.mark.parametrize("sensor", [None, {"height": 1.2}])
def test_check_says_what_is_assumed_of_the_sensor_once(
    data: Path, sensor: dict[str, Any] | None, capsys: pytest.CaptureFixture[str]
) -> None:
    describe(data.parent, **({"sensor": sensor} if sensor else {}))
    run_cli("check", data)
    lines = [line for line in capsys.readouterr().out.splitlines() if "assumed" in line]
    assert len(lines) == 1
    assert lines[0].startswith(f"{data.parent}/a/0.npy: assumed intensity")
    assert ("sensor 1.20 m over the ground" in lines[0]) == (sensor is not None)


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
    error = refusal_by(command, data)
    assert "55 (6 points in 2 scans, such as" in error
    assert f"1000 (3 points in 1 scan, such as {data.parent / 'c/1.label'})" in error
    assert "ignored: rest" in error


@each_command
def test_labels_of_one_class_or_none_are_not_trained_on(data: Path, command: str) -> None:
    for site in ("a", "b"):
        for index in range(2):
            write_labels(data.parent / f"{site}/{index}.label", np.full(60, 40))
    assert "all ignored" in refusal_by(command, data)

    for site in ("a", "b"):
        for index in range(2):
            write_labels(data.parent / f"{site}/{index}.label", np.where(RAW == 7, 3, RAW))
    assert "only ground" in refusal_by(command, data)

    describe(data.parent, classes={"ground": [3, 7]})
    assert "two or more classes" in refusal_by(command, data)


@each_command
def test_nothing_to_validate_with_is_refused(data: Path, command: str) -> None:
    for index in range(2):
        write_labels(data.parent / f"c/{index}.label", np.full(60, 40))
    assert "validate" in refusal_by(command, data)


def test_missing_labels_are_only_counted(data: Path, capsys: pytest.CaptureFixture[str]) -> None:
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


def test_only_broken_scans_are_named(data: Path, capsys: pytest.CaptureFixture[str]) -> None:
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
    line = refusal_by("train", data)
    assert "found 2 of 6 scans that cannot" in line
    assert " more;" not in line
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
    report = check_scans(dataset, {"train": dataset.records(dataset.sequences("all"))})
    return report.splits["train"].points[1:]


def a_street(seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the points (N, 4) of a road with a wall, a roof and a car, and their ids of `BASE`."""
    rng = np.random.default_rng(seed)
    low, high = np.zeros(3), np.ones(3)
    parts = []
    for raw, count, begin, size in (
        (3, 4000, (-10, -8, -1.7), (20, 12, 0.05)),
        (7, 2500, (-10, 4, -1.7), (20, 0.1, 5)),
        (11, 700, (3, -2, -1.6), (2, 2, 1.2)),
        (7, 1500, (-10, -8, 3), (20, 6, 0.05)),
    ):
        xyz = np.array(begin) + np.array(size) * rng.uniform(low, high, (count, 3))
        parts.append(np.column_stack([xyz, rng.random(count), np.full(count, raw)]))
    rows = np.concatenate(parts)
    rows = rows[np.argsort(np.arctan2(rows[:, 1], rows[:, 0]))]  # as a LiDAR turns
    return rows[:, :4].astype(np.float32), rows[:, 4].astype(np.uint32)


Change = Callable[[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]]


def warnings_of(data: Path, change: Change, **described: Any) -> list[str]:
    """Return the warnings about changed streets that are no scan of another split."""
    for number, site in enumerate(SITES):
        for index in range(2):
            points, raw = change(*a_street(2 * number + index))
            np.save(data.parent / f"{site}/{index}.npy", points)
            write_labels(data.parent / f"{site}/{index}.label", raw)
    return list(checked(describe(data.parent, **described)).warnings())


@pytest.mark.parametrize("axes", [(0, 1, 2), (0, 2, 1), (2, 1, 0)], ids=["z up", "y up", "x up"])
@pytest.mark.parametrize("sign", [1, -1], ids=["", "down"])
def test_labels_that_fit_pass_in_any_frame(data: Path, axes: tuple[int, ...], sign: int) -> None:
    def turn(points: np.ndarray, raw: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return np.column_stack([sign * points[:, axes], points[:, 3]]), raw

    assert warnings_of(data, turn) == []


@pytest.mark.parametrize(
    "order",
    [
        lambda points: np.argsort(points[:, 0]),
        lambda points: np.argsort(points[:, 2]),
        lambda points: np.argsort(np.hypot(points[:, 0], points[:, 1])),
        lambda points: np.random.default_rng(0).permutation(len(points)),
    ],
    ids=["by x", "by z", "by distance", "at random"],
)
def test_clouds_that_are_sorted_without_their_labels_are_reported(
    data: Path, order: Callable[[np.ndarray], np.ndarray]
) -> None:
    text = "\n".join(warnings_of(data, lambda points, raw: (points[order(points)], raw)))
    assert "train: labels do not follow the geometry in 4 of 4 scans, such as a/0;" in text
    assert "val: labels do not follow the geometry in 2 of 2 scans, such as c/0;" in text


def test_scans_with_labels_in_another_order_are_warned_of_and_not_counted(
    data: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    warnings_of(data, lambda points, raw: (points, raw))
    succeed("check", data)
    before = capsys.readouterr().out
    assert "scans can be trained on or scored" in before
    assert "warning:" not in before
    warnings_of(data, lambda points, raw: (points[np.argsort(points[:, 0])], raw))
    succeed("check", data)
    after = capsys.readouterr().out
    assert "\nwarning: train: labels do not follow the geometry in 4 of 4 scans" in after
    assert "can be trained on" not in after


def test_ground_high_above_other_points_is_reported(data: Path) -> None:
    swapped = {3: 7, 7: 3, 11: 11}

    def swap(points: np.ndarray, raw: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return points, np.array([swapped[number] for number in raw])

    train, val = warnings_of(data, swap)
    assert "more than 1 m above others at the same place: ground (" in train
    assert "more than 1 m above others at the same place: ground (" in val
    # Nothing is known of the height of other classes.
    assert warnings_of(data, swap, classes={"a": 3, "b": 7, "c": 11}) == []


def test_a_class_that_is_spread_like_random_points_is_reported(data: Path) -> None:
    def sprinkle(points: np.ndarray, raw: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        chosen = np.random.default_rng(len(points)).random(len(raw)) < 0.025
        return points, np.where(chosen, 8, raw)

    line, *_ = warnings_of(data, sprinkle, classes={"ground": 3, "wall": 7, "bush": 8, "car": 11})
    assert line.startswith("train: points spread like random ones: bush;")


def test_neighbours_count_beyond_chance_and_only_with_labels() -> None:
    """Random labels do not follow the geometry, however frequent one of them is."""
    rng = np.random.default_rng(0)
    places = rng.permutation(20_000)
    xyz = np.column_stack([places, places, places]).repeat(4, axis=0).astype(np.float64)
    labels = rng.choice(4, len(xyz), p=[0.3, 0.6, 0.05, 0.05])
    counts = neighbours(xyz, labels, 3)
    assert (counts[:, 0] == 0).all()
    np.testing.assert_allclose(following(counts)[1:], 0, atol=0.1)

    equal = np.where(labels > 0, labels[::4].repeat(4), 0)
    np.testing.assert_allclose(following(neighbours(xyz, equal, 3))[1:], 1)


def test_shares_that_no_street_has_are_reported(data: Path) -> None:
    classes = {"road": 11, "motorcyclist": 3, "wall": 7}
    lines = warnings_of(data, lambda points, raw: (points, raw), classes=classes)
    assert [line.split(";")[0] for line in lines if "street" in line] == [
        f"{split}: more points than on any street are motorcyclist (46%)"
        for split in ("train", "val")
    ]


def test_scans_that_also_validate_are_reported_by_their_points(data: Path) -> None:
    np.save(data.parent / "c/1.npy", np.load(data.parent / "b/0.npy"))
    (line,) = (line for line in checked(data).warnings() if "same points" in line)
    assert line.startswith("val: 1 scan with the same points as in train, such as c/1 and b/0;")


def test_lost_returns_are_not_counted_as_labelled(data: Path) -> None:
    points = some_points(seed=0)
    points[:10, 0] = np.nan
    points[10:15, :3] = 0
    before = counts_of(data)
    np.save(data.parent / "a/0.npy", points)
    lost = np.array([np.count_nonzero(RAW[:15] == raw) for raw in (3, 7, 11)])
    np.testing.assert_array_equal(before - counts_of(data), lost)


@pytest.mark.parametrize("height", [float("nan"), -1.0])
def test_an_impossible_sensor_is_refused(data: Path, height: float) -> None:
    describe(data.parent, sensor={"height": height})
    refused(("check", data), "sensor: height: expected metres from 0 to 100")


def test_labels_of_a_refused_scan_are_told(data: Path, capsys: pytest.CaptureFixture[str]) -> None:
    describe(data.parent, scans="a/0.npy")
    refused(("check", data), "two sequences")
    assert f"{np.count_nonzero(RAW == 3)}" in capsys.readouterr().out

    write_labels(data.parent / "a/0.label", np.full(60, 55))
    refused(("check", data), "55 (60 points in 1 scan")
