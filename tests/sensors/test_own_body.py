"""The points of the car's own body get no label, and networks do not see them."""

from __future__ import annotations

import os
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import amvnet
from amvnet.data.datasets.nuscenes import NuScenes
from amvnet.data.formats.cloud import Cloud
from amvnet.data.recordings import Recording
from amvnet.inference.journal import read_journals
from amvnet.scan import Scan
from amvnet.sensors.expectation import Expectation
from amvnet.sensors.lidars import Sensor, make_sensor
from amvnet.sensors.normalise import Normaliser
from amvnet.sensors.own_body import mark_own, own_points
from amvnet.weights.file import save

from fixtures.commands import fails, not_none, succeed
from fixtures.sensors import LASERS, is_on_nuscenes_car, on_nuscenes_car, place
from fixtures.tiny import fresh_weights

BOX = (-1.0, -2.0, -0.5, 14.0, 5.0, 0.6)


def own_of(points: np.ndarray, **sensor: Any) -> np.ndarray:
    """Return the points of the own body in a scan without rings, as a file holds it."""
    cloud = Cloud(points[:, :3], points[:, 3])
    own = Normaliser(Expectation(), make_sensor(**sensor))(Recording("drive")).to_scan(cloud).own
    return np.zeros(len(points), bool) if own is None else own


@pytest.mark.parametrize(
    "how", [{}, {"axes": "y-forward"}, {"sensor": "hdl32e"}, {"rotate": "0,9,0"}]
)
def test_the_body_of_nuscenes_car_is_known_in_the_axes_of_its_files(how: dict[str, str]) -> None:
    points, _ = on_nuscenes_car()
    own = own_of(points, **how)
    assert own.tolist() == list(map(is_on_nuscenes_car, points))
    assert 0.15 < own.mean() < 0.25


def test_the_body_is_known_in_every_unit() -> None:
    points, _ = on_nuscenes_car()
    scaled = points.astype(np.float64) * [100, 100, 100, 1]
    assert own_of(scaled, unit="cm").sum() == own_of(points).sum() > 0


@pytest.mark.parametrize(("share", "sensor"), [(0.1, "hdl32e"), (0.2, "os1-64"), (0.2, "vlp16")])
def test_near_points_are_the_bodys_if_many_and_of_its_lasers(share: float, sensor: str) -> None:
    points, laser = on_nuscenes_car(share, sensor)
    points[::8, :3] = 0  # lost returns are of no body
    assert own_points(points, laser, Sensor()) is None
    assert not own_of(points).any()


def test_lost_returns_hide_no_body_and_twice_as_many_rings_show_another_sensor() -> None:
    points, laser = on_nuscenes_car()
    expected = not_none(own_points(points, laser, Sensor()))
    lost = np.arange(len(points)) % 50 == 0
    points[lost, :3] = np.nan
    for ring in (laser, None):
        np.testing.assert_array_equal(own_points(points, ring, Sensor()), expected & ~lost)
    assert own_points(points, 2 * laser + np.arange(len(points)) // 32 % 2, Sensor()) is None


def test_near_points_alone_show_no_body() -> None:
    """They may be a box that a robot looks at."""
    points, laser = on_nuscenes_car()
    near = np.hypot(points[:, 0], points[:, 1]) < 1
    assert near.sum() > 100
    assert own_points(points[near], laser[near], Sensor()) is None


def test_the_body_that_a_scan_states_stays() -> None:
    points, laser = on_nuscenes_car()
    scan = Scan(points, ring=laser, own=np.zeros(len(points), bool))
    assert mark_own(scan, Sensor()) is scan


def test_a_stated_body_counts_for_any_sensor() -> None:
    points, laser = place(LASERS["vlp16"], 0.9)
    own = not_none(own_points(points, laser, Sensor(own_body=BOX)))
    expected = [-1 <= x <= 14 and -2 <= y <= 5 and -0.5 <= z <= 0.6 for x, y, z, _ in points]
    assert own.tolist() == expected
    assert 0 < own.sum() < len(own)
    assert own_of(points, own_body="-1,-2,-0.5,14,5,0.6").tolist() == expected
    assert not own_of(points, own_body=BOX, keep_own=True).any()


@pytest.mark.parametrize("box", [(1, 2, 3), (0, 0, 0, 1, 1, 0), (0, 0, 0, 1, 1, np.nan), "here"])
def test_an_impossible_body_is_refused(box: object) -> None:
    fails(lambda: make_sensor(own_body=box), "own_body", "the lowest x,y,z and the highest x,y,z")


def test_the_networks_do_not_see_the_body() -> None:
    points, laser = on_nuscenes_car()
    table = np.column_stack([points, laser])
    own = np.array(list(map(is_on_nuscenes_car, points)))
    segmenter = amvnet.load(fresh_weights())
    result = segmenter(table)
    assert not result.labels[own].any()
    assert not result.uncertain[own].any()
    others = segmenter(table[~own])
    np.testing.assert_array_equal(result.labels[~own], others.labels)
    assert result.doubt == others.doubt
    assert len(result.points) == len(points)


def test_predict_counts_own_points(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    points, laser = on_nuscenes_car()
    path = tmp_path / "scan.npy"
    np.save(path, np.column_stack([points, laser]))
    weights = save(fresh_weights(), tmp_path / "tiny.safetensors")
    succeed(f"predict {path} --weights {weights} --out {tmp_path / 'out'}")
    count = sum(map(is_on_nuscenes_car, points))
    share = 100 * count / len(points)
    (row,) = [line for line in capsys.readouterr().out.splitlines() if "own car" in line]
    assert row.split("│")[1:] == [f" {count:,} ".rjust(8), f" {share:.1f} "]

    (entry,) = read_journals(tmp_path / "out").entries.values()
    assert (entry.own, entry.points) == (count, len(points) - count)
    assert sum(entry.counts) == entry.points

    succeed(f"predict {path} --weights {weights} --out {tmp_path / 'all'} --keep-own")
    assert "own car" not in capsys.readouterr().out
    (entry,) = read_journals(tmp_path / "all").entries.values()
    assert (entry.own, entry.points) == (0, len(points))


@pytest.mark.skipif("AMVNET_REAL_DATA" not in os.environ, reason="needs real scans")
def test_nearly_all_points_that_nuscenes_calls_its_car_are_found_and_hardly_others() -> None:
    dataset = NuScenes(Path(os.environ["AMVNET_REAL_DATA"]) / "lidarseg")
    names = {row["index"]: row["name"] for row in dataset._table("category")}
    of_body = Counter[str]()
    of_others = Counter[str]()
    for record in dataset.records(dataset.sequences("all"))[::10]:
        scan = dataset.read(record)
        own = not_none(own_points(scan.points, scan.ring, Sensor()))
        raw = dataset.raw_labels(record, len(scan))
        of_body.update(names[index] for index in raw[own].tolist())
        of_others.update(names[index] for index in raw[~own].tolist())

    assert of_others["vehicle.ego"] < 0.0001 * of_body["vehicle.ego"]
    # One of the four scenes calls its own car a car.
    labelled = of_body["vehicle.ego"] + of_body["vehicle.car"]
    assert of_body.total() - labelled < 0.0001 * labelled
