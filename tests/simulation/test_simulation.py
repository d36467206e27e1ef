"""Simulated scans: what must hold whatever the street looks like."""

import hashlib
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from amvnet.errors import InputError
from amvnet.simulation import SENSORS, Drive, drive_street, simulate
from amvnet.simulation.layouts import semantickitti_ids

RAW_IDS = {
    10,
    11,
    13,
    15,
    18,
    20,
    30,
    31,
    32,
    40,
    44,
    48,
    49,
    50,
    51,
    52,
    60,
    70,
    71,
    72,
    80,
    81,
    99,
}
MOVING_IDS = {252, 253, 254, 255, 257, 258, 259}
HDL64E = SENSORS["hdl64e"]


def digests(folder: Path) -> dict[str, str]:
    files = sorted(path for path in folder.rglob("*") if path.is_file())
    return {
        str(path.relative_to(folder)): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in files
    }


@pytest.fixture(scope="module")
def street(tmp_path_factory):
    pytest.importorskip("embreex")
    return simulate(
        tmp_path_factory.mktemp("street"), sequences=2, scans=2, seed=3, first_sequence=4
    )


@pytest.fixture(scope="module")
def scans():
    """Two scans of each of four streets."""
    pytest.importorskip("embreex")
    return [
        scan for seed in range(4) for scan in drive_street(HDL64E, 2, np.random.SeedSequence(seed))
    ]


def test_same_seed_same_bytes(street, tmp_path):
    again = simulate(tmp_path, sequences=2, scans=2, seed=3, first_sequence=4)
    assert digests(again) == digests(street)


def test_a_sequence_does_not_depend_on_the_others(street, tmp_path):
    alone = simulate(tmp_path, scans=2, seed=3, first_sequence=5)
    assert digests(alone / "sequences" / "05") == digests(street / "sequences" / "05")


def test_another_seed_is_another_street(street, tmp_path):
    other = simulate(tmp_path, scans=2, seed=8, first_sequence=4)
    here, there = digests(street / "sequences" / "04"), digests(other / "sequences" / "04")
    assert here.keys() == there.keys()
    assert all(here[name] != there[name] for name in here if name.endswith((".bin", ".label")))


def test_layout_is_that_of_semantickitti(street):
    assert sorted(path.name for path in (street / "sequences").iterdir()) == ["04", "05"]
    for folder in (street / "sequences").iterdir():
        assert sorted(path.name for path in folder.iterdir()) == [
            "calib.txt",
            "labels",
            "poses.txt",
            "times.txt",
            "velodyne",
        ]
        for name in ("000000", "000001"):
            scan, label = folder / "velodyne" / f"{name}.bin", folder / "labels" / f"{name}.label"
            assert scan.stat().st_size % 16 == 0
            assert scan.stat().st_size == 4 * label.stat().st_size
        assert np.loadtxt(folder / "poses.txt").shape == (2, 12)
        assert np.loadtxt(folder / "times.txt").shape == (2,)


def test_progress_counts_every_scan(tmp_path):
    pytest.importorskip("embreex")
    calls = []
    simulate(
        tmp_path, sequences=2, scans=1, progress=lambda done, total: calls.append((done, total))
    )
    assert calls == [(1, 2), (2, 2)]


def test_values_are_in_range(scans):
    for scan in scans:
        assert scan.points.dtype == np.float32
        assert scan.labels.dtype == np.uint32
        assert len(scan.points) == len(scan.labels)
        assert 70_000 < len(scan.points) < 64 * HDL64E.azimuth_steps
        assert np.isfinite(scan.points).all()
        assert scan.points[:, 3].min() >= 0
        assert scan.points[:, 3].max() <= 1
        distance = np.linalg.norm(scan.points[:, :3], axis=1)
        moved = (
            Drive().speed[1] * HDL64E.turn / 2
        )  # by so much at most, from where the scan is corrected to
        assert distance.min() > HDL64E.min_range - 0.1 - moved
        assert distance.max() < HDL64E.max_range + 0.1 + moved


@pytest.mark.parametrize("name", SENSORS)
def test_without_motion_every_point_lies_on_its_beam_within_the_sensors_ranges(name):
    """Whole streets, fired from one place each, so that nothing is left to correct."""
    pytest.importorskip("embreex")
    sensor = replace(SENSORS[name], turn=0.0)
    beams = np.array(sensor.elevations)[::-1]
    for seed in range(4):
        for scan in drive_street(sensor, 2, np.random.SeedSequence(seed)):
            hit = scan.labels > 0 if sensor.keeps_lost else np.full(len(scan.labels), True)
            points, ring = scan.points[hit].astype(float), scan.ring[hit]
            distance = np.linalg.norm(points[:, :3], axis=1)
            assert distance.min() > sensor.min_range - 0.1
            assert distance.max() < sensor.max_range + 0.1
            assert np.abs(np.degrees(np.arcsin(points[:, 2] / distance)) - beams[ring]).max() < 0.01
            azimuth = np.degrees(np.arctan2(points[:, 1], points[:, 0])) % 360
            step = np.diff(ring.astype(int))
            assert (step <= 0).all()
            assert (np.diff(azimuth)[step == 0] > 0).all()


def test_raw_ids_are_official_and_many(scans):
    raw = semantickitti_ids(np.concatenate([scan.labels for scan in scans]))
    seen = set(np.unique(raw & 0xFFFF).tolist())
    assert seen <= RAW_IDS | MOVING_IDS
    assert seen & MOVING_IDS
    assert {10, 40, 48, 50, 51, 70, 71, 72, 80, 81} <= seen


def test_only_things_have_instances_and_each_has_one_class(scans):
    things = {10, 11, 13, 15, 18, 20, 30, 31, 32} | MOVING_IDS
    for scan in scans:
        label, instance = semantickitti_ids(scan.labels) & 0xFFFF, scan.labels >> 16
        assert np.array_equal(instance > 0, np.isin(label, list(things)))
        pairs = np.unique(scan.labels[instance > 0])
        assert len(np.unique(pairs >> 16)) == len(pairs)


def test_a_car_is_as_small_as_a_car(scans):
    for scan in scans:
        for one in np.unique(scan.labels[np.isin(scan.labels & 0xFFFF, [10, 252])]):
            # Without the few returns that mix with what is behind.
            extent = np.ptp(
                np.quantile(scan.points[scan.labels == one, :3], (0.04, 0.96), axis=0), axis=0
            )
            assert np.linalg.norm(extent[:2]) < 6.5
            assert extent[2] < 2.5


def test_road_points_lie_on_the_road(scans):
    for scan in scans:
        near = np.linalg.norm(scan.points[:, :2], axis=1) < 10
        height = scan.points[near & np.isin(scan.labels & 0xFFFF, [40, 60]), 2]
        assert len(height) > 1000
        assert abs(np.median(height) + HDL64E.height) < 0.2
        assert np.abs(height + HDL64E.height).max() < 1.0


def test_the_sensor_drives_on(scans):
    for first, second in zip(scans[::2], scans[1::2], strict=True):
        assert np.allclose(first.pose, np.eye(4))
        assert np.allclose(second.pose[:3, :3] @ second.pose[:3, :3].T, np.eye(3), atol=1e-9)
        assert np.linalg.norm(second.pose[:3, 3]) == pytest.approx(Drive().spacing, rel=0.15)
        assert second.time > first.time


def test_a_long_sequence_goes_on_in_another_street():
    pytest.importorskip("embreex")
    drive = Drive(scans_per_street=1)
    places = [scan.pose[0, 3] for scan in drive_street(HDL64E, 3, np.random.SeedSequence(1), drive)]
    assert np.allclose(places, [0, drive.spacing, 2 * drive.spacing])


@pytest.mark.parametrize(
    "wrong", [{"sensor": "hdl65"}, {"scans": 0}, {"sequences": 0}, {"seed": -1}]
)
def test_wrong_input_is_one_line_that_says_what_was_expected(wrong, tmp_path):
    with pytest.raises(InputError, match=r"^[^\n]*expected [^\n]*found [^\n]*$"):
        simulate(tmp_path, **wrong)
    assert not list(tmp_path.iterdir())


def test_missing_embreex_names_the_extra(monkeypatch, tmp_path):
    monkeypatch.setitem(sys.modules, "embreex", None)
    with pytest.raises(InputError, match=r'pip install "amvnet\[simulate\]"'):
        simulate(tmp_path)
