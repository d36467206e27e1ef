"""What weights expect of a scan: measured in training, kept in the file, checked when read."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from amvnet.config.schema import RangeViewConfig, Recipe
from amvnet.data.datasets.semantickitti import SemanticKitti
from amvnet.data.datasets.training_data import Source, TrainingData
from amvnet.scan import Scan
from amvnet.sensors.expectation import Expectation, trained_sensor
from amvnet.sensors.intensity import SIMULATED_QUANTILES, TrainedIntensity
from amvnet.sensors.lasers import SensorGeometry, measure_sensor
from amvnet.sensors.lidars import KNOWN_HEIGHTS, KNOWN_SENSORS, Sensor
from amvnet.sensors.normalise import Normaliser
from amvnet.training.expectation import expectation_of
from amvnet.weights.file import Weights, load, save

from fixtures.commands import fails, succeed
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
    scans = TrainingData([Source(data, data.records(["08"]))])
    weights = fresh_weights()
    recipe = Recipe(model=weights.model, sensor="hdl64e")
    expects = expectation_of(scans, weights, recipe, ("rv", "bev"))
    return replace(weights, sensor="hdl64e", expects=expects)


@pytest.mark.full
@pytest.mark.parametrize("height", [0.8, 1.73, 2.6])
def test_datasets_folders_files_and_bags_get_the_same_labels(height: float, tmp_path: Path) -> None:
    save(trained_at(height, tmp_path / "data"), tmp_path / "w.safetensors")
    scans = sorted((tmp_path / "data/sequences/08/velodyne").glob("*.bin"))
    clouds = [np.fromfile(path, np.float32).reshape(-1, 4) for path in scans]
    write_bag1(tmp_path / "drive.bag", {"/points": clouds})

    inputs = {"dataset": tmp_path / "data", "folder": scans[0].parent}
    inputs |= {"first": scans[0], "second": scans[1], "bag": tmp_path / "drive.bag"}
    for out, path in inputs.items():
        succeed(f"predict {path} --weights {tmp_path}/w.safetensors --out {tmp_path}/{out}")

    for index, path in enumerate(scans):
        written = tmp_path / f"dataset/sequences/08/predictions/{path.stem}.label"
        expected = np.fromfile(written, np.uint32)
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

    measured = measure_sensor([scan, scan])
    assert measured.beams is None
    assert measured.height == pytest.approx(1.2, abs=0.05)
    assert measured.fov_up == pytest.approx(6, abs=0.1)
    assert measured.fov_down == pytest.approx(-24, abs=0.1)

    ring = np.repeat(np.arange(8), len(azimuth))
    with_ring = measure_sensor([replace(scan, ring=ring)])
    assert with_ring.beams == 8
    assert (with_ring.fov_up, with_ring.fov_down) == (6, -24)

    # Lost returns of most shots of the highest laser lie next to the sensor, as in nuScenes.
    lost = points.reshape(-1, 4).astype(np.float32)
    lost[-600:, :3] = (0.3, 0.1, -0.05)
    with_lost = measure_sensor([Scan(lost, ring=ring)])
    assert (with_lost.fov_up, with_lost.fov_down) == (6, -24)
    assert measure_sensor([]) == SensorGeometry()


@pytest.mark.parametrize("name", ["hdl64e", "hdl32e", "homemade"])
def test_weights_without_a_measure_expect_the_sensor_of_the_table(name: str) -> None:
    sensor = Expectation.of_sensor(name).sensor
    assert sensor.height == KNOWN_HEIGHTS.get(name)
    assert sensor.beams == (KNOWN_SENSORS[name].beams if name in KNOWN_SENSORS else None)
    assert sensor.name == (name if name in KNOWN_SENSORS else "")


def test_a_measure_that_fits_the_sheet_keeps_the_lasers_of_the_sheet() -> None:
    """Lasers at two heights cannot be counted by their elevations."""
    fits = trained_sensor("hdl64e", SensorGeometry(None, 2.9, -23.9, 1.75))
    assert (fits.name, fits.beams, fits.height) == ("hdl64e", 64, 1.75)
    other = trained_sensor("hdl64e", SensorGeometry(None, 15.0, -25.0, 1.75))
    assert (other.name, other.beams, other.height) == ("", None, 1.75)


@pytest.mark.parametrize(
    "measured", [SensorGeometry(height=-0.4), SensorGeometry(None, fov_up=-30.0, fov_down=30.0)]
)
def test_scans_that_show_no_possible_sensor_count_for_nothing(measured: SensorGeometry) -> None:
    assert trained_sensor("hdl64e", measured) == Expectation.of_sensor("hdl64e").sensor


WHOLE = Expectation(
    sensor=Sensor("hdl64e", 64, 2.4, -23.7, 1.76),
    intensity=TrainedIntensity(SIMULATED_QUANTILES["hdl64e"], is_optional=True, is_matched=True),
    as_is=True,
)


@pytest.mark.parametrize("expects", [WHOLE, Expectation(), replace(WHOLE, as_is=False)])
def test_an_expectation_survives_json(expects: Expectation) -> None:
    assert Expectation.from_dict(json.loads(json.dumps(expects.to_dict())), expects.view) == expects


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("sensor", None),
        ("sensor", []),
        ("sensor", {"name": 3}),
        ("sensor", {"name": "two\nlines"}),
        ("sensor", {"height": "high"}),
        ("sensor", {"height": -4}),
        ("sensor", {"height": float("nan")}),
        ("sensor", {"beams": float("inf")}),
        ("sensor", {"beams": 10**400}),
        ("sensor", {"fov_up": -30, "fov_down": 30}),
        ("sensor", {"lasers": 64}),
        ("intensity", 3),
        ("intensity", {}),
        ("intensity", {"quantiles": 1, "is_optional": True, "is_matched": True}),
        ("as_is", 1),
        ("as_is", None),
    ],
)
def test_what_no_networks_expect_is_refused_in_one_line(key: str, value: Any) -> None:
    fails(lambda: Expectation.from_dict(WHOLE.to_dict() | {key: value}, WHOLE.view), "expected")


@pytest.mark.parametrize("values", [None, [], {}, {"sensor": {}, "intensity": None}])
def test_a_file_without_an_expectation_is_refused(values: Any) -> None:
    fails(lambda: Expectation.from_dict(values, WHOLE.view), "train or export again")


def test_a_weights_file_keeps_what_its_networks_expect(tmp_path: Path) -> None:
    weights = trained_at(2.6, tmp_path / "data")
    loaded = load(save(weights, tmp_path / "w.safetensors"))
    assert loaded.expects == weights.expects
    assert loaded.expects.sensor.height == pytest.approx(2.6, abs=0.05)
    assert Normaliser(loaded.expects).target().height == loaded.expects.sensor.height


def test_the_view_of_an_expectation_is_that_of_the_model() -> None:
    weights = fresh_weights()
    wider = replace(weights.model, range_view=RangeViewConfig(rows="laser", width=128))
    assert replace(weights, model=wider).expects.view == wider.range_view
