"""Every LiDAR that is known can be simulated, and so can LiDARs that no maker sells."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import cache
from itertools import islice
from pathlib import Path

import numpy as np
import pytest

from amvnet.data.datasets.simulated import SimulatedStreets
from amvnet.sensors.expectation import Expectation
from amvnet.sensors.ground import find_ground
from amvnet.sensors.lasers import laser_density, rows_by_density
from amvnet.sensors.lidars import ANY, KNOWN_SENSORS, make_sensor, simulated_lidar
from amvnet.sensors.normalise import Normaliser, normalised
from lidarstreets import LIDAR_MODELS, SimulatedScan, SimulationError, simulate
from lidarstreets.sensing.any_sensor import LASERS, MAX_SHOTS, draw_sensor
from lidarstreets.sensing.sensors import LidarModel, draw_device

from fixtures.commands import fails, new_file, not_none
from fixtures.tiny import make_simulation_quick

pytest.importorskip("embreex")
from lidarstreets import drive
from lidarstreets.course import Drive
from lidarstreets.drive import drive_street
from lidarstreets.sensing.returns import draw_lasers

EVEN = ("vlp16", "os1-64", "xt32", "rs16")
DENSE = ("vlp32c", "pandar64", "pandar128", "vls128", "rs32", "rs128", "ot128")


@cache
def scans_of_every_lidar() -> dict[str, tuple[LidarModel, SimulatedScan]]:
    """Return a device of every known LiDAR, and its scan of one street, which is built once.

    The devices stand still while they rotate: motion moves near points against their rays.
    """
    rng = np.random.default_rng(7)
    models = [replace(model, rotation_period=0.0) for model in LIDAR_MODELS.values()]
    devices = [draw_device(model, rng) for model in models]
    streets = drive._drive_one_street(
        iter([(device, draw_lasers(device, rng)) for device in devices]),
        len(devices),
        np.random.default_rng(3),
        Drive(spacing=0.5),
    )
    return {
        name: (device, scan)
        for name, device, scan in zip(LIDAR_MODELS, devices, streets, strict=True)
    }


@pytest.mark.parametrize("name", KNOWN_SENSORS)
def test_a_simulated_scan_has_the_lasers_and_the_height_of_its_sensor(name: str) -> None:
    device, scan = scans_of_every_lidar()[name]
    is_return = (scan.labels > 0) & (np.linalg.norm(scan.points[:, :3], axis=1) > 1.5)
    points = scan.points[is_return]
    ring = scan.ring[is_return]
    distance = np.hypot(points[:, 0], points[:, 1])
    height = np.interp(device.elevations, *np.transpose(device.origins))[::-1]
    elevation = np.degrees(np.arctan2(points[:, 2] - height[ring], distance))

    # The lowest lasers of a wide field of view see the vehicle alone, the highest ones the sky.
    seen = np.flatnonzero(np.bincount(ring, minlength=len(device.elevations)) > 50)
    assert len(seen) > len(device.elevations) / 2
    for laser in seen:
        assert abs(np.median(elevation[ring == laser]) - device.elevations[::-1][laser]) < 0.6

    ground = not_none(find_ground(points[:, :3].astype(np.float64)))
    assert ground.height == pytest.approx(device.height, abs=0.12)
    assert device.height == pytest.approx(LIDAR_MODELS[name].height, abs=0.3)


@pytest.mark.parametrize("name", [*EVEN, *DENSE])
def test_rows_by_density_order_the_lasers_without_knowing_them(name: str) -> None:
    device, scan = scans_of_every_lidar()[name]
    lasers = len(device.elevations)
    points = scan.points[scan.labels > 0]
    ring = scan.ring[scan.labels > 0]
    rows = rows_by_density(points, laser_density(points), 64)
    assert (rows.min(), rows.max()) == (0, 63)

    seen = [laser for laser in range(lasers) if np.count_nonzero(ring == laser) > 50]
    middle = np.array([np.median(rows[ring == laser]) for laser in seen])
    exact = 63 - (np.array(seen) + 0.5) / lasers * 64
    assert (np.diff(middle) <= 0).all()
    assert np.abs(middle - exact).mean() < 3.0
    if name in DENSE:  # rows of equal angles would lie farther away
        elevations = np.array(device.elevations)[::-1][seen]
        top, bottom = device.ends
        equal = (top - elevations) / (top - bottom) * 63
        assert np.abs(middle - exact).mean() < 0.5 * np.abs(equal - exact).mean()


def test_drawn_sensors_are_possible_and_of_all_kinds() -> None:
    rng = np.random.default_rng(0)
    sensors = [draw_sensor(rng) for _ in range(300)]
    assert {len(sensor.elevations) for sensor in sensors} == set(LASERS)
    heights = [sensor.height for sensor in sensors]
    assert min(heights) < 0.4
    assert max(heights) > 2.4
    for sensor in sensors:
        elevations = np.array(sensor.elevations)
        assert (np.diff(elevations) < 0).all()
        assert -45 <= elevations[-1] < -9
        assert 2 <= elevations[0] <= 45
        assert len(elevations) * sensor.azimuth_steps <= MAX_SHOTS
        assert sensor.region == ""


def test_each_scan_of_any_sensor_has_another_one_and_the_seed_decides_it() -> None:
    drawn = list(islice(drive._devices(ANY, np.random.default_rng(4)), 6))
    assert len({device.elevations for device, _ in drawn}) == 6
    again = list(islice(drive._devices(ANY, np.random.default_rng(4)), 6))
    assert [device for device, _ in again] == [device for device, _ in drawn]
    same = list(islice(drive._devices("os1-64", np.random.default_rng(4)), 3))
    assert same[0][0] == same[1][0] == same[2][0]


@pytest.mark.full
def test_streets_of_any_sensor_are_normalised_for_networks(tmp_path: Path) -> None:
    expected = Expectation.of_sensor(ANY)
    dataset = normalised(SimulatedStreets(tmp_path, ANY), Normaliser(expected))
    records = dataset.records(["12"])
    seed = np.random.SeedSequence((64, 12))
    for record, simulated in zip(records, drive_street(ANY, 6, seed), strict=True):
        scan = dataset.read(record)
        assert not_none(scan.row).max() <= expected.view.height - 1
        assert len(scan) == len(simulated.points)
        ground = not_none(find_ground(scan.points[scan.valid, :3].astype(np.float64)))
        assert ground.height == pytest.approx(1.73, abs=0.3)


@pytest.fixture
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    make_simulation_quick(monkeypatch)


def test_a_sensor_of_a_yaml_file_is_simulated(tmp_path: Path, quick: None) -> None:
    path = new_file(tmp_path / "robot.yaml", "beams: 20\nfov_up: 10\nfov_down: -28\nheight: 0.6\n")
    lidar = simulated_lidar(make_sensor(str(path)))
    np.testing.assert_allclose(lidar.elevations, np.linspace(10, -28, 20))
    assert (lidar.name, lidar.height) == ("robot", 0.6)
    assert simulated_lidar(make_sensor(str(path), height=1.0)) == replace(lidar, height=1.0)

    simulate(tmp_path / "out", sensor=lidar, scans=1)
    simulate(tmp_path / "out", sensor=lidar, scans=1)
    with pytest.raises(SimulationError, match=r"'height': 1\.0.*'height': 0\.6") as error:
        simulate(tmp_path / "out", sensor=replace(lidar, height=1.0), scans=1)
    assert "elevations" not in str(error.value)  # they are equal


def test_a_known_sensor_is_simulated_at_another_height() -> None:
    lidar = simulated_lidar(make_sensor("pandar64", height=2.2))
    assert (lidar.height, lidar.height_spread) == (2.2, 0)
    assert lidar.elevations == LIDAR_MODELS["pandar64"].elevations
    assert simulated_lidar(make_sensor("hdl64e")) is LIDAR_MODELS["hdl64e"]


@pytest.mark.parametrize(
    ("attributes", "words"),
    [
        ({"beams": 16}, ["beams, fov_up, fov_down, height", "no fov_up and no fov_down"]),
        ({"beams": 300, "fov_up": 2, "fov_down": -2, "height": 1}, ["at most 256", "300"]),
    ],
)
def test_an_impossible_sensor_is_refused(attributes: dict[str, float], words: list[str]) -> None:
    call: Callable[[], object] = lambda: simulated_lidar(make_sensor(attributes))  # noqa: E731
    fails(call, *words)
