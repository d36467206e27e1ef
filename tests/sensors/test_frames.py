"""Scans in any usual frame reach the networks as the same scan in the sensor's own frame does."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from amvnet.data.formats.cloud import Cloud
from amvnet.data.recordings import Recording
from amvnet.scan import Scan
from amvnet.sensors.frame import Frame, find_frame, median_frame
from amvnet.sensors.ground import find_ground
from amvnet.sensors.lidars import AXES, UNKNOWN_SENSOR, Sensor, rotation_from_degrees
from amvnet.sensors.normalise import Normaliser

from fixtures.commands import fails, not_none
from fixtures.examples import first_of
from fixtures.sensors import LASERS, between_bent_walls, place
from fixtures.tiny import fresh_weights, trained_for

UP = ["z-down", "z-forward", "y-up"]
WEIGHTS = trained_for(fresh_weights(), "hdl64e")


def scan_xyz(height: float = 1.73, seed: int = 0) -> np.ndarray:
    points, _ = place(LASERS["os1-64"], height, seed=seed)
    return points[:, :3].astype(np.float64)


def in_axes(xyz: np.ndarray, axes: str) -> np.ndarray:
    return xyz @ np.array(AXES[axes], float)


def tilted(xyz: np.ndarray, pitch: float, roll: float) -> np.ndarray:
    return xyz @ rotation_from_degrees(0, pitch, roll).T


def normalise(xyz: np.ndarray, sensor: Sensor = UNKNOWN_SENSOR) -> tuple[Scan, str]:
    lines: list[str] = []
    intensity = np.linspace(0, 0.6, len(xyz))
    recording = Normaliser(WEIGHTS.expects, sensor, lines.append)(Recording("a"))
    scan = recording.to_scan(Cloud(xyz, intensity, name="a"))
    return scan, lines[0]


def assert_alike(scan: Scan, expected: Scan, atol: float) -> None:
    np.testing.assert_allclose(scan.points, expected.points, atol=atol)
    assert np.abs(not_none(scan.row) - not_none(expected.row)).max() <= 1


@pytest.mark.parametrize("axes", UP)
@pytest.mark.parametrize("unit", [1, 1000])
def test_axes_and_millimetres_are_recognised_and_said(axes: str, unit: float) -> None:
    xyz = scan_xyz()
    expected, usual = normalise(xyz)
    scan, line = normalise(unit * in_axes(xyz, axes))
    assert_alike(scan, expected, atol=1e-4)
    assert f"--axes {axes}" in line
    assert ("--unit mm" in line) == (unit == 1000)
    assert "--" not in usual


@pytest.mark.parametrize("tilt", [(8, 0), (-8, 0), (0, 8), (0, -8), (6, -12)])
@pytest.mark.parametrize("axes", first_of(["z-forward", "x-forward"]))
def test_a_tilted_scan_is_levelled(tilt: tuple[float, float], axes: str) -> None:
    xyz = scan_xyz()
    scan, line = normalise(in_axes(tilted(xyz, *tilt), axes))
    ground = not_none(find_ground(scan.points[:, :3].astype(np.float64)))
    assert ground.tilt < 0.3
    assert ground.height == pytest.approx(1.73, abs=0.1)
    np.testing.assert_allclose(scan.points[:, 2], xyz[:, 2], atol=0.15)
    assert "--rotate 0," in line


@pytest.mark.parametrize("rise", first_of([1.5, 1.73, 3.4]))
@pytest.mark.parametrize("options", [{}, {"height": 1.73}, {"offset": (0, 0, -1.73)}])
def test_an_origin_on_or_below_the_ground_is_mended(rise: float, options: dict[str, Any]) -> None:
    xyz = scan_xyz()
    expected, _ = normalise(xyz)
    scan, _ = normalise(xyz + np.array([0, 0, rise]), Sensor(**options))
    assert_alike(scan, expected, atol=0.16)  # a difference in height of 0.15 m is left alone


def test_the_origin_of_a_sensor_that_is_said_to_be_low_is_not_on_the_ground() -> None:
    frame = Frame(height=0.25)
    assert frame.is_on_ground(Sensor())
    assert frame.is_on_ground(Sensor(height=1.0))
    assert not frame.is_on_ground(Sensor(height=0.2))
    assert frame.rises(Sensor(height=0.2), usual_height=1.7) == (0, 0.2 - 1.7)


@pytest.mark.parametrize("height", [0.35, 0.55])
@pytest.mark.parametrize("name", LASERS)
def test_lasers_tell_a_low_sensor_from_the_foot_of_a_vehicle(name: str, height: float) -> None:
    low = find_frame(between_bent_walls(LASERS[name], height)[:, :3], Sensor())
    assert not low.is_on_ground(Sensor())

    seen = between_bent_walls(LASERS[name], 1.73)[:, :3]
    xyz = seen + np.array([0, 0, 1.73 - height])
    foot = find_frame(xyz, Sensor())
    assert foot.height == pytest.approx(height, abs=0.05)
    assert foot.is_on_ground(Sensor())
    assert not foot.is_on_ground(Sensor(height=height))
    assert median_frame([low, foot, foot]).is_on_ground(Sensor())

    expected, _ = normalise(seen)
    scan, line = normalise(xyz)
    np.testing.assert_allclose(scan.points, expected.points, atol=0.16)
    assert "the origin is not the sensor" in line
    assert "--offset 0,0,-Z if" in line
    assert "--offset" not in normalise(xyz, Sensor(offset=(0, 0, -1)))[1]
    assert "over the ground" not in line
    assert "sensor 1.41 m over the ground, the ground at" in normalise(xyz, Sensor(height=1.41))[1]


@pytest.mark.parametrize("z", [-1.73, 0, 1.73])
def test_no_offset_hurts(z: float) -> None:
    xyz = scan_xyz()
    expected, _ = normalise(xyz)
    scan, _ = normalise(xyz + np.array([1, 0, 1.73]), Sensor(offset=(-1, 0, z)))
    assert_alike(scan, expected, atol=0.05)


def test_an_offset_is_in_the_axes_of_the_file_if_these_are_guessed() -> None:
    xyz = scan_xyz()
    expected, _ = normalise(xyz)
    moved = in_axes(xyz, "z-forward") + np.array([0.4, -1.2, 0.3])
    for sensor in (Sensor(offset=(-0.4, 1.2, -0.3)), Sensor(unit="m", offset=(-0.4, 1.2, -0.3))):
        assert_alike(normalise(moved, sensor)[0], expected, atol=0.05)


def test_what_the_user_describes_is_not_guessed() -> None:
    xyz = tilted(scan_xyz(), 8, 0)
    scan, _ = normalise(xyz, Sensor(rotate=(0, 0, 0), height=1.73))
    np.testing.assert_allclose(scan.points[:, :3], xyz, atol=1e-5)

    down = in_axes(scan_xyz(), "z-down")
    scan, _ = normalise(down, Sensor(axes="x-forward", height=1.73))
    np.testing.assert_allclose(scan.points[:, :3], down, atol=1e-5)


@pytest.mark.parametrize(("unit", "factor"), [("cm", 100), ("ft", 1 / 0.3048)])
def test_other_units_are_refused_with_the_option_that_mends_it(unit: str, factor: float) -> None:
    xyz = scan_xyz()
    fails(lambda: normalise(factor * xyz), "a:", "--unit", unit)
    expected, _ = normalise(xyz)
    assert_alike(normalise(factor * xyz, Sensor(unit=unit))[0], expected, atol=1e-4)


def test_map_coordinates_are_not_taken_for_millimetres() -> None:
    assert find_frame(scan_xyz() + np.array([4500, 300, 0]), Sensor()).unit == "m"


def test_the_height_is_that_over_the_ground_under_the_car() -> None:
    """Most of the ground may lie lower than the road, as beside a dam."""
    rng = np.random.default_rng(0)
    x, y = rng.uniform(-25, 25, (2, 20_000))
    z = np.where(np.abs(y) < 5, -1.73, -2.1) + rng.normal(0, 0.02, len(x))
    assert find_frame(np.column_stack([x, y, z]), Sensor()).height == pytest.approx(1.73, abs=0.1)


def test_a_bank_of_which_little_is_seen_moves_no_scan() -> None:
    rng = np.random.default_rng(0)
    x, y = rng.uniform(-25, 25, (2, 20_000))
    bushes = rng.uniform(0.2, 2, len(x)) * (rng.random(len(x)) < 0.85)
    _, line = normalise(np.column_stack([x, y, 0.2 * y - 2.5 + bushes]))
    assert "no ground" in line
    assert "moved" not in line


def test_the_walls_of_a_corridor_are_not_taken_for_the_ground() -> None:
    rng = np.random.default_rng(0)
    x = rng.uniform(-20, 20, 20_000)
    y = np.where(rng.random(20_000) < 0.5, 1.2, -1.2) + rng.normal(0, 0.01, 20_000)
    frame = find_frame(np.column_stack([x, y, rng.uniform(-0.2, 2, 20_000)]), Sensor())
    assert (frame.axes, frame.pitch, frame.roll) == ("x-forward", 0, 0)


def test_a_raised_road_is_not_upside_down() -> None:
    """More of the near points are below the road than above it; far away, all are above."""
    rng = np.random.default_rng(0)
    x, y = rng.uniform(-20, 20, (2, 40_000))
    road = np.column_stack([x, y, -1.7 - 0.25 * np.maximum(np.abs(y) - 8, 0)])
    trees = rng.uniform((25, -60, -1), (70, 60, 6), (50_000, 3))
    frame = find_frame(np.concatenate([road, trees]), Sensor())
    assert (frame.axes, frame.height) == ("x-forward", pytest.approx(1.7, abs=0.05))


@pytest.mark.parametrize("tilt", first_of([(8, 0), (0, 8)]))
def test_scans_that_sway_are_levelled_one_by_one(tilt: tuple[float, float]) -> None:
    recording = Normaliser(WEIGHTS.expects)(Recording("a"))
    pitch, roll = tilt
    for seed, side in enumerate((1, -1, 1, -1, 1, -1, 1)):
        xyz = scan_xyz(seed=seed)
        cloud = Cloud(
            tilted(xyz, side * pitch, side * roll), np.linspace(0, 0.6, len(xyz)), name="a"
        )
        np.testing.assert_allclose(recording.to_scan(cloud).points[:, 2], xyz[:, 2], atol=0.2)
