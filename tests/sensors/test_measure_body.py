"""The body of the car is what stays in its place in scans of a drive, and only that."""

from __future__ import annotations

import os
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from amvnet.data.datasets.nuscenes import NuScenes
from amvnet.data.formats.cloud import Cloud
from amvnet.errors import InputError
from amvnet.sensors.lidars import KNOWN_BODIES, Sensor, make_sensor
from amvnet.sensors.own_body import Body, find_body, is_inside, measure_body

from fixtures.commands import not_none, succeed

BODY = (-2.0, -0.8, -1.0, 1.0, 0.8, -0.5)  # in the axes of the package
HEIGHT = 1.7


def drive(
    scans: int = 10, step: float = 3.0, body: Any = BODY, wall: float | None = None
) -> list[np.ndarray]:
    """Return the points of scans that follow each other by so many metres.

    Args:
        body: the box of the car's own body.
        wall: how far to the left a wall goes along the way, metres.
    """
    rng = np.random.default_rng(3)
    size = [scans * step + 60, 60, 0]
    ground = rng.random((20_000, 3)) * size - [30, 30, HEIGHT]
    posts = rng.random((1_500, 3)) * size - [30, 30, 0]
    around = np.repeat(posts, 10, axis=0) + rng.random((15_000, 3)) * [0.2, 0.2, 3] - [0, 0, HEIGHT]
    world = np.concatenate([ground, around])
    if wall is not None:
        along = rng.random((20_000, 3)) * [size[0], 0.05, 1.5] - [30, 0, 1]
        world = np.concatenate([world, np.add(along, (0, wall, 0))])

    points = []
    for index in range(scans):
        scan = world - [index * step, 0, 0]
        if body is not None:
            low, high = np.array(body[:3]), np.array(body[3:])
            own = low + rng.random((3_000, 3)) * (high - low)
            scan = np.concatenate([scan[~is_inside(scan, body)], own])
        points.append(scan.astype(np.float32))
    return points


def found(scans: list[np.ndarray], **sensor: Any) -> Body | None:
    return measure_body([partial(Cloud, xyz) for xyz in scans], make_sensor(**sensor))


def test_the_box_of_the_body_is_measured_and_its_share_of_the_points() -> None:
    scans = drive()
    body = not_none(found(scans))
    np.testing.assert_allclose(body.box, BODY, atol=0.11)
    assert body.share == pytest.approx(is_inside(np.concatenate(scans), body.box).mean())
    assert np.array(body.box).tolist() == np.round(body.box, 1).tolist()
    assert make_sensor(own_body=list(body.box)).own_body == body.box


@pytest.mark.parametrize(
    ("change", "sensor"),
    [
        (lambda xyz: xyz * 1000, {}),
        (lambda xyz: np.stack([-xyz[:, 1], xyz[:, 0], xyz[:, 2]], axis=1), {}),
        (lambda xyz: np.stack([xyz[:, 0], -xyz[:, 1], -xyz[:, 2]], axis=1), {}),
        (lambda xyz: np.add(xyz, (1, 0, HEIGHT)), {"offset": (-1, 0, -HEIGHT)}),
    ],
)
def test_the_box_is_in_metres_and_the_files_axes(change: Any, sensor: dict[str, Any]) -> None:
    body = not_none(found([change(xyz) for xyz in drive()], **sensor))
    unit = 1000 if change(np.eye(3))[0, 0] == 1000 else 1
    corners = change(np.array([BODY[:3], BODY[3:]])) / unit
    np.testing.assert_allclose(body.box[:3], corners.min(axis=0), atol=0.11)
    np.testing.assert_allclose(body.box[3:], corners.max(axis=0), atol=0.11)


@pytest.mark.parametrize(
    "scans",
    [
        drive(body=None),
        drive(body=None, wall=1.5),
        drive(step=0),
        drive(step=0, body=None),
        drive(scans=4),
        [],
    ],
    ids=["no body", "a wall along the way", "standing", "standing alone", "few scans", "no scan"],
)
def test_nothing_is_said_of_scans_that_show_no_body(scans: list[np.ndarray]) -> None:
    assert found(scans) is None


def test_a_wall_along_the_way_is_not_of_the_body() -> None:
    np.testing.assert_allclose(not_none(found(drive(wall=1.5))).box, BODY, atol=0.11)


@pytest.mark.parametrize("sensor", [{"own_body": BODY}, {"keep_own": True}])
def test_a_body_that_is_stated_or_kept_is_not_measured(sensor: dict[str, Any]) -> None:
    assert found(drive(), **sensor) is None


def test_broken_scans_are_left_out() -> None:
    def fail() -> Cloud:
        raise InputError("broken")

    reads = [partial(Cloud, xyz) for xyz in drive()]
    assert measure_body([*reads[:3], fail, *reads[4:]], Sensor()) is not None


def test_check_says_what_to_state_once(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for index, xyz in enumerate(drive()):
        columns = dict(zip("xyz", xyz.T, strict=True))
        np.savez(tmp_path / f"{index}.npz", **columns, label=xyz[:, 2] > -1)
    description = tmp_path / "mine.yaml"
    text = (
        'classes: {low: 0, high: 1}\nscans: "*.npz"\nlabels: {field: label}\n'
        'split: {train: "[0-7]", val: "[89]"}\n'
    )
    description.write_text(text)
    succeed(f"check {description}")
    (line,) = [line for line in capsys.readouterr().out.splitlines() if "own_body" in line]
    assert "8% of the points move with the sensor" in line

    stated = line[line.index("own_body") :]
    description.write_text(f"{text}sensor: {{{stated}}}\n")
    succeed(f"check {description}")
    assert "own_body" not in capsys.readouterr().out


@pytest.mark.skipif("AMVNET_REAL_DATA" not in os.environ, reason="needs real scans")
def test_the_known_body_of_nuscenes_car_is_measured_in_each_scene() -> None:
    dataset = NuScenes(Path(os.environ["AMVNET_REAL_DATA"]) / "lidarseg")
    for scene in dataset.sequences("all"):
        records = dataset.records([scene])[::4]
        clouds = [Cloud(dataset.read(record, labels=False).points[:, :3]) for record in records]
        body = not_none(find_body(clouds, Sensor()))
        points = np.concatenate([cloud.xyz for cloud in clouds])
        known = is_inside(points, KNOWN_BODIES["hdl32e"])
        measured = is_inside(points, body.box)
        assert (known & measured).sum() > 0.998 * known.sum()
        assert (measured & ~known).sum() < 0.0002 * known.sum()


@pytest.mark.skipif("AMVNET_REAL_DATA" not in os.environ, reason="needs real scans")
def test_no_body_is_measured_in_scans_of_kitti() -> None:
    root = Path(os.environ["AMVNET_REAL_DATA"]) / "semantickitti"
    for sequence in sorted(root.glob("sequences/*")):
        paths = sorted(sequence.glob("velodyne/*.bin"))
        clouds = [Cloud(np.fromfile(path, np.float32).reshape(-1, 4)[:, :3]) for path in paths]
        assert find_body(clouds, Sensor()) is None
