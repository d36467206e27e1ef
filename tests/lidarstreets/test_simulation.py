"""Simulated scans: properties that hold for every street."""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from lidarstreets import LIDAR_MODELS, Drive, SimulatedScan, SimulationError, drive_street, simulate
from lidarstreets.sensing.sensors import LidarModel, draw_device
from lidarstreets.streets.kinds import STREET_KINDS

from fixtures.commands import contents
from fixtures.examples import first_of
from fixtures.tiny import make_simulation_quick

# Raw ids of SemanticKITTI.
THING_IDS = {10, 11, 13, 15, 18, 20, 30, 31, 32}
OUTLIER_ID = 1
STUFF_IDS = {40, 44, 48, 49, 50, 51, 52, 60, 70, 71, 72, 80, 81, 99}
MOVING_IDS = {252, 253, 254, 255, 257, 258, 259}
CAR_IDS = [10, 252]
ROAD_IDS = [40, 60]
HDL64E = LIDAR_MODELS["hdl64e"]


def exact_device(sensor: LidarModel) -> LidarModel:
    """Return a type of LiDAR whose devices are all alike."""
    return replace(
        sensor,
        height_spread=0.0,
        mounting_spread=0.0,
        elevation_spread=0.0,
        laser_spread=0.0,
        response_spread=0.0,
    )


@pytest.fixture(scope="module")
def street(tmp_path_factory: pytest.TempPathFactory) -> Path:
    pytest.importorskip("embreex")
    folder = tmp_path_factory.mktemp("street")
    return simulate(folder, sequences=2, scans=2, seed=3, first_sequence=4)


SEEDS = (5, 0, 1, 2, 3)


@pytest.fixture(scope="module", params=first_of((1, len(SEEDS))), ids="{} streets".format)
def scans(request: pytest.FixtureRequest) -> list[SimulatedScan]:
    pytest.importorskip("embreex")
    scans: list[SimulatedScan] = []
    for seed in SEEDS[: request.param]:
        scans += drive_street(HDL64E, 2, np.random.SeedSequence(seed))
    return scans


def test_a_seed_gives_the_same_scan_again(scans: list[SimulatedScan]) -> None:
    again = next(drive_street(HDL64E, 2, np.random.SeedSequence(SEEDS[0])))
    for name in ("points", "labels", "ring", "pose"):
        assert np.array_equal(getattr(scans[0], name), getattr(again, name))


@pytest.mark.full
def test_a_sequence_does_not_depend_on_the_others(street: Path, tmp_path: Path) -> None:
    alone = simulate(tmp_path, scans=2, seed=3, first_sequence=5)
    assert contents(alone / "sequences" / "05") == contents(street / "sequences" / "05")


def test_layout_is_that_of_semantickitti(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("embreex")
    make_simulation_quick(monkeypatch)
    street = simulate(tmp_path, sequences=2, scans=2, first_sequence=4)
    folders = sorted((street / "sequences").iterdir())
    assert [folder.name for folder in folders] == ["04", "05"]
    for folder in folders:
        names = sorted(path.name for path in folder.iterdir())
        assert names == ["calib.txt", "labels", "poses.txt", "times.txt", "velodyne"]
        for scan in ("000000", "000001"):
            points_size = (folder / "velodyne" / f"{scan}.bin").stat().st_size
            labels_size = (folder / "labels" / f"{scan}.label").stat().st_size
            assert points_size % 16 == 0
            assert points_size == 4 * labels_size
        assert np.loadtxt(folder / "poses.txt").shape == (2, 12)
        assert np.loadtxt(folder / "times.txt").shape == (2,)


def test_values_are_in_range(scans: list[SimulatedScan]) -> None:
    # The points are corrected to the middle of the rotation, so the sensor was at most half a
    # rotation's way from there.
    fastest = Drive().speed[1] * 1.2 * max(kind.speed for kind in STREET_KINDS.values())
    moved = fastest * HDL64E.rotation_period / 2
    for scan in scans:
        assert scan.points.dtype == np.float32
        assert scan.labels.dtype == np.uint32
        assert len(scan.points) == len(scan.labels)
        assert 40_000 < len(scan.points) < 64 * HDL64E.azimuth_steps
        assert np.isfinite(scan.points).all()
        assert scan.points[:, 3].min() >= 0
        assert scan.points[:, 3].max() <= 1

        distance = np.linalg.norm(scan.points[:, :3], axis=1)
        assert distance.min() > HDL64E.min_range - 0.1 - moved
        assert distance.max() < HDL64E.max_range + 0.1 + moved


@pytest.mark.full
@pytest.mark.parametrize("seed", range(2))
@pytest.mark.parametrize("name", LIDAR_MODELS)
def test_without_motion_points_lie_on_their_beams_within_the_ranges(name: str, seed: int) -> None:
    """A rotation that takes no time leaves nothing to correct."""
    pytest.importorskip("embreex")
    sensor = exact_device(replace(LIDAR_MODELS[name], rotation_period=0.0, range_error=0.0))
    beams = np.array(sensor.elevations)[::-1]
    heights = np.interp(beams, *np.transpose(sensor.origins))
    for scan in drive_street(sensor, 1, np.random.SeedSequence(seed)):
        # Lost returns have no label and no place on a beam. The roof of the car is nearer than the
        # range of the sensor begins.
        is_return = (scan.labels > 0) & (np.linalg.norm(scan.points[:, :3], axis=1) > 2.5)
        is_return |= (scan.labels > 0) & (not sensor.roof)
        assert is_return.all() or sensor.keeps_lost_returns
        points = scan.points[is_return].astype(float)
        ring = scan.ring[is_return]

        along_ray = points[:, :3] - np.array([0, 0, 1]) * heights[ring, None]
        distance = np.linalg.norm(along_ray, axis=1)
        elevation = np.degrees(np.arcsin(along_ray[:, 2] / distance))
        assert distance.min() > sensor.min_range - 0.1
        assert distance.max() < sensor.max_range + 0.1
        assert np.abs(elevation - beams[ring]).max() < 0.01

        azimuth = np.degrees(np.arctan2(points[:, 1], points[:, 0])) % 360
        ring_step = np.diff(ring.astype(int))
        assert (ring_step <= 0).all()
        assert (np.diff(azimuth)[ring_step == 0] > 0).all()


def test_raw_ids_are_official_and_many(scans: list[SimulatedScan]) -> None:
    labels = np.concatenate([scan.semantickitti_ids() for scan in scans])
    ids = set(np.unique(labels & 0xFFFF).tolist())
    assert ids <= THING_IDS | STUFF_IDS | MOVING_IDS | {OUTLIER_ID}
    assert ids & MOVING_IDS
    assert ids >= {10, 40, 48, 50, 51, 70, 71, 72, 80, 81}


def test_only_things_have_instances_and_each_has_one_class(scans: list[SimulatedScan]) -> None:
    for scan in scans:
        labels = scan.semantickitti_ids()
        instance = labels >> 16
        assert np.array_equal(instance > 0, np.isin(labels & 0xFFFF, list(THING_IDS | MOVING_IDS)))
        pairs = np.unique(labels[instance > 0])
        assert len(np.unique(pairs >> 16)) == len(pairs)


def test_a_car_is_as_small_as_a_car(scans: list[SimulatedScan]) -> None:
    for scan in scans:
        is_car = np.isin(scan.labels & 0xFFFF, CAR_IDS)
        for label in np.unique(scan.labels[is_car]):
            xyz = scan.points[scan.labels == label, :3]
            # Without the few returns that mix with what is behind.
            low, high = np.quantile(xyz, (0.04, 0.96), axis=0)
            extent = high - low
            assert np.linalg.norm(extent[:2]) < 7.0
            assert extent[2] < 3.0


def test_road_points_lie_on_the_road(scans: list[SimulatedScan]) -> None:
    for scan in scans:
        near = np.linalg.norm(scan.points[:, :2], axis=1) < 10
        is_road = np.isin(scan.labels & 0xFFFF, ROAD_IDS)
        height = scan.points[near & is_road, 2] + HDL64E.height
        assert len(height) > 300
        assert abs(np.median(height)) < 0.4
        assert np.quantile(np.abs(height), 0.99) < 1.0


def test_the_sensor_drives_on(scans: list[SimulatedScan]) -> None:
    for first, second in zip(scans[::2], scans[1::2], strict=True):
        rotation = second.pose[:3, :3]
        assert np.allclose(first.pose, np.eye(4))
        assert np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-9)
        assert np.linalg.norm(second.pose[:3, 3]) == pytest.approx(Drive().spacing, rel=0.15)
        assert second.time > first.time


def test_devices_of_a_type_differ_a_little() -> None:
    devices = [draw_device(HDL64E, np.random.default_rng(seed)) for seed in range(20)]
    for device in devices:
        assert abs(device.height - HDL64E.height) <= 0.15
        assert abs(device.pitch) <= 1.5
        assert abs(device.roll) <= 1.5
        assert np.abs(np.array(device.elevations) - np.array(HDL64E.elevations)).max() < 0.7
        assert (np.diff(device.elevations) <= 0).all()
    assert len({device.height for device in devices}) == 20
    assert draw_device(exact_device(HDL64E), np.random.default_rng(0)) == exact_device(HDL64E)


@pytest.mark.full
def test_a_long_sequence_continues_in_another_street() -> None:
    pytest.importorskip("embreex")
    drive = Drive(scans_per_street=1)
    scans = drive_street(HDL64E, 2, np.random.SeedSequence(1), drive)
    assert np.allclose([scan.pose[0, 3] for scan in scans], [0, drive.spacing])


@pytest.mark.parametrize(
    "wrong", [{"sensor": "hdl65"}, {"scans": 0}, {"sequences": 0}, {"seed": -1}]
)
def test_wrong_input_is_one_line_of_what_is_expected(wrong: dict[str, Any], tmp_path: Path) -> None:
    with pytest.raises(SimulationError, match=r"^[^\n]*expected [^\n]*found [^\n]*$"):
        simulate(tmp_path, **wrong)
    assert not list(tmp_path.iterdir())


def test_missing_embreex_names_the_extra(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setitem(sys.modules, "embreex", None)
    with pytest.raises(SimulationError, match=r'pip install "amvnet\[simulate\]"'):
        simulate(tmp_path)


@pytest.mark.full
def test_a_dense_drive_has_scans_of_one_street_a_metre_apart(tmp_path: Path) -> None:
    """It is another sequence than the one with the usual spacing, which does not replace it."""
    pytest.importorskip("embreex")
    simulate(tmp_path, scans=4, spacing=1.0)
    poses = np.loadtxt(tmp_path / "sequences/00/poses.txt").reshape(-1, 3, 4)
    steps = np.linalg.norm(np.diff(poses[:, :, 3], axis=0), axis=1)
    np.testing.assert_allclose(steps, 1, atol=0.3)
    with pytest.raises(SimulationError, match="found"):
        simulate(tmp_path, scans=4)


@pytest.mark.parametrize("spacing", [0.0, 0.05, 51.0, float("nan")])
def test_an_impossible_spacing_is_one_line(tmp_path: Path, spacing: float) -> None:
    with pytest.raises(SimulationError, match=r"spacing of 0\.1 to 50\.0 m"):
        simulate(tmp_path, scans=1, spacing=spacing)
