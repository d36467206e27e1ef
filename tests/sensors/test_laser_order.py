"""The laser of each point, from its ring or from the order of the points in a file."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest

from amvnet.config.schema import RangeViewConfig
from amvnet.scan import Scan
from amvnet.sensors.expectation import Expectation
from amvnet.sensors.lasers import lasers_by_order, order_rings
from amvnet.sensors.lidars import rotation_from_degrees

from fixtures.commands import not_none

LASERS = 16
SHOTS = 200


def turns(seed: int = 0, lasers: int = LASERS) -> tuple[np.ndarray, np.ndarray]:
    """Return points laser by laser from the highest, as in KITTI's files, and their rings."""
    rng = np.random.default_rng(seed)
    azimuth = np.linspace(0.001, 2 * np.pi - 0.001, SHOTS)
    points = []
    for elevation in np.radians(np.linspace(2, -24, lasers)):
        distance = rng.uniform(3, 60, SHOTS)
        flat = distance * np.cos(elevation)
        xyz = [flat * np.cos(azimuth), flat * np.sin(azimuth), distance * np.sin(elevation)]
        points.append(np.column_stack([*xyz, rng.random(SHOTS)]))
    ring = np.repeat(np.arange(lasers - 1, -1, -1), SHOTS)
    return np.concatenate(points).astype(np.float32), ring


@pytest.mark.parametrize("seed", range(3))
def test_the_order_of_the_points_gives_their_lasers(seed: int) -> None:
    points, ring = turns(seed)
    kept = np.random.default_rng(seed).random(len(points)) < 0.8  # weak returns are missing
    assert np.array_equal(not_none(lasers_by_order(points[kept], LASERS)), ring[kept])


def test_lost_returns_have_the_laser_of_the_point_before() -> None:
    points, ring = turns()
    lost = np.random.default_rng(1).random(len(points)) < 0.1
    lost[[0, -1]] = True
    for value in (0.0, np.nan, np.inf):
        changed = points.copy()
        changed[lost, :3] = value
        found = not_none(lasers_by_order(changed, LASERS))
        assert np.array_equal(found[~lost], ring[~lost])
        assert found.min() >= 0
        assert found.max() < LASERS


def test_another_order_or_number_of_lasers_gives_none() -> None:
    points, _ = turns()
    rng = np.random.default_rng(0)
    assert lasers_by_order(points[rng.permutation(len(points))], LASERS) is None
    assert lasers_by_order(points[::-1], LASERS) is None
    assert lasers_by_order(points[np.argsort(points[:, 0])], LASERS) is None
    assert lasers_by_order(points, LASERS + 1) is None
    assert lasers_by_order(points, LASERS - 1) is None
    assert lasers_by_order(points[: 20 * LASERS], LASERS) is None
    is_seen = np.arange(len(points)) % 4 == 0  # 50 points of each laser
    assert lasers_by_order(points * is_seen[:, None], LASERS) is None
    assert lasers_by_order(np.zeros((0, 4), np.float32), LASERS) is None
    assert lasers_by_order(np.zeros((2000, 4), np.float32), LASERS) is None


def test_turns_that_do_not_keep_to_an_elevation_are_no_lasers() -> None:
    points, _ = turns()
    wild = points.copy()
    wild[:, 2] = np.random.default_rng(0).normal(0, 5, len(points))
    assert lasers_by_order(wild, LASERS) is None
    steep = points.copy()
    steep[::2, 2] += 0.2 * np.hypot(points[::2, 0], points[::2, 1])  # of two elevations each
    assert lasers_by_order(steep, LASERS) is None
    upward = points.reshape(LASERS, SHOTS, 4)[::-1].reshape(-1, 4)  # from the lowest laser
    assert lasers_by_order(upward, LASERS) is None


def test_known_rings_stay() -> None:
    points, ring = turns()
    expects = Expectation(RangeViewConfig(rows="laser", height=LASERS))
    assert expects.prepare(Scan(points, ring=ring)).ring is ring
    assert Expectation().prepare(Scan(points)).ring is None
    assert np.array_equal(not_none(expects.prepare(Scan(points)).ring), ring)


@pytest.mark.parametrize("tilt", [0.0, 15.0])
@pytest.mark.parametrize("seed", range(3))
def test_rings_in_any_order_become_the_lasers(seed: int, tilt: float) -> None:
    points, laser = turns(seed)
    points[:, :3] = points[:, :3] @ rotation_from_degrees(0, tilt, tilt / 2).T
    other = np.random.default_rng(seed).permutation(LASERS)
    unknown = np.arange(len(points)) % 10 == 0
    names = {"highest": LASERS - 1 - laser, "order": other[laser], "another": laser ^ 1}
    for word, ring in names.items():
        scan, fault = order_rings(Scan(points, ring=np.where(unknown, -1, ring)))
        np.testing.assert_array_equal(scan.ring, np.where(unknown, -1, laser))
        assert word in fault

    scan, _ = order_rings(Scan(points, ring=3 * other[laser]))
    np.testing.assert_array_equal(scan.ring, 3 * laser)

    for ring in (laser, np.where(unknown, -1, laser), laser // 2, 3 * laser):
        scan = Scan(points, ring=ring)
        assert order_rings(scan) == (scan, "")


@pytest.mark.parametrize("near", [0, 7, LASERS - 1])
def test_a_laser_that_sees_only_the_car_has_its_place(near: int) -> None:
    points, laser = turns()
    is_near = laser == near
    points[is_near, :3] *= 0.9 / np.hypot(*points[is_near, :2].T)[:, None]
    points[np.flatnonzero(is_near)[:3], :2] = 0  # on the axis, where no elevation shows
    other = np.random.default_rng(0).permutation(LASERS)
    for ring in (laser, LASERS - 1 - laser, other[laser]):
        scan, _ = order_rings(Scan(points, ring=ring))
        np.testing.assert_array_equal(scan.ring, laser)

    points[is_near, :2] = 0
    for ring in (LASERS - 1 - laser, other[laser]):
        scan, _ = order_rings(Scan(points, ring=ring))
        assert sorted(set(not_none(scan.ring).tolist())) == list(range(LASERS))


def test_the_lowest_laser_is_the_last_ring_although_the_highest_see_nothing() -> None:
    points, laser = turns()
    seen = laser < LASERS - 3
    scan, _ = order_rings(Scan(points[seen], ring=LASERS - 1 - laser[seen]))
    np.testing.assert_array_equal(scan.ring, laser[seen])


def test_rings_that_do_not_follow_the_elevations_are_left_out() -> None:
    points, laser = turns()
    rng = np.random.default_rng(0)
    for ring in (
        np.arange(len(points)) % LASERS,
        rng.integers(0, LASERS, len(points)),
        np.where(rng.random(len(points)) < 0.5, laser, rng.integers(0, LASERS, len(points))),
    ):
        scan, fault = order_rings(Scan(points, ring=ring))
        assert scan.ring is None
        assert "not used" in fault


@pytest.mark.parametrize("count", [0, 1, 2, 15])
def test_a_few_points_keep_their_rings(count: int) -> None:
    points, laser = turns()
    scan = Scan(points[:count], ring=laser[:count])
    assert order_rings(scan) == (scan, "")


def test_a_ring_of_a_few_points_does_not_change_the_order() -> None:
    points, laser = turns()
    laser[-5:] = LASERS  # of the lowest laser
    scan = Scan(points, ring=laser)
    assert order_rings(scan) == (scan, "")


@pytest.mark.skipif("AMVNET_REAL_DATA" not in os.environ, reason="needs real scans")
def test_the_lasers_of_every_real_kitti_scan_are_found() -> None:
    paths = sorted(Path(os.environ["AMVNET_REAL_DATA"]).glob("semantickitti/**/velodyne/*.bin"))
    assert paths
    for path in paths:
        assert lasers_by_order(np.fromfile(path, np.float32).reshape(-1, 4), 64) is not None, path
