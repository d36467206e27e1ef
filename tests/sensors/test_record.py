"""The sensor that weights carry: measured in training, used before the table of known sensors."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from amvnet.data.datasets.semantickitti import SemanticKitti
from amvnet.inference.reading import normaliser_for
from amvnet.scan import Scan
from amvnet.sensors.lidars import KNOWN_HEIGHTS, KNOWN_SENSORS
from amvnet.sensors.record import SENSOR_KEY, measure_sensor, trained_sensor
from amvnet.training.sensor_record import sensor_record
from amvnet.weights.file import Weights, load, save

from fixtures.commands import run_cli
from fixtures.scan_writers import write_bag1
from fixtures.tiny import fresh_weights, street, write_scan

SCANS = 3


def raised_street(seed: int, height: float) -> tuple[np.ndarray, np.ndarray]:
    """Return a street as seen from some height over the ground."""
    points, raw = street(seed, 8000)
    points[:, 2] -= height - 1.7
    points[:, 3] = np.clip(points[:, 3], 0, 1)
    return points, raw


def trained_at(height: float, root: Path) -> Weights:
    """Return weights that carry what training measures of scans at some height."""
    for scan in range(SCANS):
        write_scan(root, "08", f"{scan:06d}", *raised_street(scan, height))
    data = SemanticKitti(root)
    record = sensor_record(data, data.records(["08"]))
    weights = fresh_weights()
    training = {part: {**values, **record} for part, values in weights.training.items()}
    return replace(weights, sensor="hdl64e", training=training)


@pytest.mark.full
@pytest.mark.parametrize(
    "height",
    [0.8, pytest.param(1.73, marks=pytest.mark.full), pytest.param(2.6, marks=pytest.mark.full)],
)
def test_datasets_folders_files_and_bags_get_the_same_labels(height: float, tmp_path: Path) -> None:
    weights = trained_at(height, tmp_path / "data")
    save(weights, tmp_path / "w.safetensors")
    scans = sorted((tmp_path / "data/sequences/08/velodyne").glob("*.bin"))
    clouds = [np.fromfile(path, np.float32).reshape(-1, 4) for path in scans]
    write_bag1(tmp_path / "drive.bag", {"/points": clouds})

    for inputs, out in (
        ([tmp_path / "data"], "dataset"),
        ([scans[0].parent], "folder"),
        ([scans[0]], "first"),
        ([scans[1]], "second"),
        ([tmp_path / "drive.bag"], "bag"),
    ):
        code, error = run_cli(
            *("predict", *inputs, "--weights", tmp_path / "w.safetensors", "--out", tmp_path / out)
        )
        assert code == 0, error

    for index, path in enumerate(scans):
        expected = np.fromfile(
            tmp_path / f"dataset/sequences/08/predictions/{path.stem}.label", np.uint32
        )
        assert len(np.unique(expected)) > 1
        others = [f"folder/{path.stem}.label", f"bag/drive/{index:06d}.label"]
        if index < 2:
            others.append(f"{('first', 'second')[index]}/{path.stem}.label")
        for name in others:
            found = np.fromfile(tmp_path / name, np.uint32)
            np.testing.assert_array_equal(found, expected, err_msg=name)


def test_training_measures_height_lasers_and_field_of_view() -> None:
    # Eight lasers on a wide plane, of which two look up at a wall.
    azimuth = np.linspace(-np.pi, np.pi, 720, endpoint=False)
    elevation = np.radians([-24, -20, -16, -12, -8, -5, 2, 6])
    e, a = np.meshgrid(elevation, azimuth, indexing="ij")
    distance = np.where(e < 0, 1.2 / np.sin(np.abs(e)), 15.0)
    x = distance * np.cos(e) * np.cos(a)
    y = distance * np.cos(e) * np.sin(a)
    points = np.stack([x, y, distance * np.sin(e), np.zeros_like(x)], axis=-1)
    scan = Scan(points.reshape(-1, 4).astype(np.float32))

    record = measure_sensor([scan, scan])
    assert "beams" not in record
    assert record["height"] == pytest.approx(1.2, abs=0.05)
    assert record["fov_up"] == pytest.approx(6, abs=0.1)
    assert record["fov_down"] == pytest.approx(-24, abs=0.1)

    ring = np.repeat(np.arange(8), len(azimuth))
    with_ring = measure_sensor([replace(scan, ring=ring)])
    assert with_ring["beams"] == 8
    assert (with_ring["fov_up"], with_ring["fov_down"]) == (6, -24)

    # Lost returns of most shots of the highest laser lie next to the sensor, as in nuScenes.
    lost = points.reshape(-1, 4).astype(np.float32)
    lost[-600:, :3] = (0.3, 0.1, -0.05)
    with_lost = measure_sensor([Scan(lost, ring=ring)])
    assert (with_lost["fov_up"], with_lost["fov_down"]) == (6, -24)
    assert measure_sensor([]) == {}


@pytest.mark.parametrize("name", ["hdl64e", "hdl32e", "homemade"])
def test_weights_without_a_record_have_the_sensor_of_the_table(name: str) -> None:
    sensor = trained_sensor({"range_net": {"seed": 0}}, name)
    assert sensor.height == KNOWN_HEIGHTS.get(name)
    assert sensor.beams == (KNOWN_SENSORS[name].beams if name in KNOWN_SENSORS else None)


def test_a_record_that_fits_the_sheet_keeps_the_lasers_of_the_sheet() -> None:
    """Lasers at two heights cannot be counted by their elevations."""
    fits = {"fov_up": 2.9, "fov_down": -23.9, "height": 1.75}
    other = {"fov_up": 15.0, "fov_down": -25.0, "height": 1.75}
    assert trained_sensor({"range_net": {SENSOR_KEY: fits}}, "hdl64e").beams == 64
    assert trained_sensor({"range_net": {SENSOR_KEY: other}}, "hdl64e").beams is None


@pytest.mark.parametrize(
    "record",
    [
        [],
        {"height": "high"},
        {"height": -4},
        {"height": float("nan")},
        {"height": True},
        {"beams": float("inf")},
        {"beams": 10**400},
        {"beams": 1e400, "fov_up": 1e9},
        {"fov_up": -30, "fov_down": 30},
    ],
)
def test_an_impossible_record_in_a_file_of_a_stranger_counts_for_nothing(record: Any) -> None:
    assert trained_sensor({"range_net": {SENSOR_KEY: record}}, "hdl64e") == trained_sensor(
        {}, "hdl64e"
    )


def test_a_weights_file_keeps_the_record(tmp_path: Path) -> None:
    weights = trained_at(2.6, tmp_path / "data")
    loaded = load(save(weights, tmp_path / "w.safetensors"))
    assert trained_sensor(loaded.training, loaded.sensor).height == pytest.approx(2.6, abs=0.05)
    lines: list[str] = []
    normaliser = normaliser_for(loaded, report=lines.append)
    assert normaliser.target()["height"] == trained_sensor(loaded.training, "").height
