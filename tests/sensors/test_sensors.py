"""Sensors are measured as they are built; scans fit the weights whatever their axes and units."""

from __future__ import annotations

import contextlib
import os
import warnings
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import strategies as st

import amvnet
from amvnet.cli.main import main
from amvnet.config.schema import RangeViewConfig
from amvnet.data.datasets.open import open_dataset
from amvnet.data.formats.cloud import Cloud
from amvnet.data.recordings import Recording
from amvnet.data.taxonomy import NUSCENES, SEMANTICKITTI
from amvnet.errors import InputError
from amvnet.models.views.points import PointBatch
from amvnet.models.views.range_view import RangeView
from amvnet.scan import Scan
from amvnet.sensors import lidars
from amvnet.sensors.expectation import Expectation
from amvnet.sensors.ground import find_ground
from amvnet.sensors.lasers import SensorGeometry, measure
from amvnet.sensors.lidars import KNOWN_SENSORS, Sensor, make_sensor, rotation_from_degrees
from amvnet.sensors.measure import MEASURED_SCANS, raise_points
from amvnet.sensors.normalise import Normalised, Normaliser, normalised
from amvnet.sensors.rows import _row_view
from amvnet.weights.file import built_in, load, save
from lidarstreets import LIDAR_MODELS

from fixtures.commands import fails, files, new_file, not_none, refusal, run_cli
from fixtures.datasets import make_nuscenes
from fixtures.examples import first_of, with_examples
from fixtures.scan_writers import pcd_bytes, write_bag1
from fixtures.sensors import LASERS, ground_height, on_nuscenes_car, place
from fixtures.tiny import fresh_weights, make_streets, trained_for

REAL = os.environ.get("AMVNET_REAL_DATA")
WEIGHTS = fresh_weights()
NUSCENES_WEIGHTS = fresh_weights(NUSCENES)


# --- measuring


@pytest.mark.parametrize("name", LASERS)
@pytest.mark.parametrize("height", first_of([0.6, 1.73, 2.6]))
def test_lasers_field_of_view_and_height_are_measured(name: str, height: float) -> None:
    points, laser = place(LASERS[name], height)
    by_laser = np.argsort(laser, kind="stable")

    for table, ring in ((points, None), (points[by_laser], None), (points, laser)):
        geometry = measure(table, ring)
        assert geometry.beams == (None if ring is None else len(LASERS[name]))
        assert geometry.height == pytest.approx(height, abs=0.05)
        assert geometry.fov_up == pytest.approx(max(LASERS[name]), abs=0.5)
        assert geometry.fov_down == pytest.approx(min(LASERS[name]), abs=0.5)


@pytest.mark.parametrize("slope", [-6, 0, 4])
def test_the_ground_is_found_on_a_slope_and_among_stray_points(slope: float) -> None:
    points, _ = place(LASERS["os1-64"], 1.5, slope=slope)
    rng = np.random.default_rng(1)
    is_stray = rng.random(len(points)) < 0.2
    points[is_stray, 2] += rng.uniform(-1, 4, is_stray.sum()).astype(np.float32)

    assert ground_height(points) == pytest.approx(1.5, abs=0.08)


def test_the_ground_is_the_lower_plane_even_if_more_cells_show_the_tops_of_hedges() -> None:
    rng = np.random.default_rng(2)
    x, y = rng.uniform(-18, 18, (2, 20_000))
    is_hedge = (np.floor(x / 2) + np.floor(y / 2)) % 5 < 3
    z = np.where(is_hedge, -0.6, -1.7) + rng.normal(0, 0.01, len(x))
    assert not_none(find_ground(np.column_stack([x, y, z]))).height == pytest.approx(1.7, abs=0.05)


def test_what_a_scan_does_not_tell_stays_unknown() -> None:
    rng = np.random.default_rng(0)
    sky, _ = place(np.linspace(5, 30, 16), 1.7)
    assert measure(sky).height is None
    assert measure(rng.normal(0, (20, 20, 4, 1), (50, 4))).fov_up is None


@pytest.mark.skipif(not REAL, reason="AMVNET_REAL_DATA does not name a folder")
@pytest.mark.parametrize(("name", "model"), [("semantickitti", "hdl64e"), ("nuscenes", "hdl32e")])
def test_real_sensors_have_the_height_that_is_known(name: str, model: str) -> None:
    from amvnet.data.datasets.open import open_dataset

    dataset = open_dataset(str(Path(REAL or "") / name))
    records = dataset.records(dataset.sequences("all"))[::5]
    heights = []
    for record in records:
        scan = dataset.read(record, labels=False)
        geometry = measure(scan.points[scan.valid], scan.ring)
        assert geometry.beams == (None if scan.ring is None else 32)

        heights.append(not_none(geometry.height))

    expected = lidars.KNOWN_HEIGHTS[model]
    assert np.median(heights) == pytest.approx(expected, abs=0.1)
    assert np.abs(np.array(heights) - expected).max() < 0.2


# --- normalising


def make_recording(
    sensor: Sensor = lidars.UNKNOWN_SENSOR, name: str = "hdl64e", is_nuscenes: bool = False
) -> tuple[Normalised, list[str]]:
    """Return a recording as fresh weights expect it, and the list of the lines that it says."""
    lines: list[str] = []
    weights = trained_for(NUSCENES_WEIGHTS if is_nuscenes else WEIGHTS, name)
    return Normaliser(weights.expects, sensor, lines.append)(Recording("a")), lines


def make_cloud(points: np.ndarray, ring: np.ndarray | None = None) -> Cloud:
    return Cloud(points[:, :3], points[:, 3], ring, "a.pcd")


def assert_alike(a: Scan, b: Scan, atol: float = 1e-4) -> None:
    np.testing.assert_allclose(a.points, b.points, atol=atol)
    # All but points at the border of two rows.
    assert np.mean(not_none(a.row) == not_none(b.row)) > 0.99


@pytest.mark.parametrize("height", [0.6, 1.73, 2.6])
def test_the_sensor_is_moved_to_the_height_of_the_training(height: float) -> None:
    points, _ = place(LASERS["os1-64"], height)
    recording, _ = make_recording()
    scan = recording.to_scan(make_cloud(points))
    np.testing.assert_array_equal(scan.points[:, [0, 1, 3]], points[:, [0, 1, 3]])
    assert ground_height(scan.points) == pytest.approx(1.73, abs=0.05)

    rise = scan.points[:, 2] - points[:, 2]
    assert rise.max() - rise.min() < 1e-5
    assert np.all(rise == 0) == (height == 1.73)


def test_a_given_height_counts_whatever_the_ground_says() -> None:
    points, _ = place(LASERS["os1-64"], 1.2)
    recording, _ = make_recording(Sensor(height=2.23))
    scan = recording.to_scan(make_cloud(points))
    np.testing.assert_allclose(scan.points[:, 2] - points[:, 2], 0.5, atol=1e-5)


@pytest.mark.parametrize("axes", lidars.AXES)
@pytest.mark.parametrize("turn", first_of([(30, 10, -5), (0, 0, 0), (90, 0, 0)]))
def test_any_described_frame_gives_one_scan(axes: str, turn: tuple[float, float, float]) -> None:
    points, _ = place(LASERS["os1-64"], 1.2)
    points[5] = 0
    level, _ = make_recording()
    expected = level.to_scan(make_cloud(points))

    offset = (0.1, -0.2, 0.4)
    matrix = rotation_from_degrees(*turn) @ np.array(lidars.AXES[axes], float)
    file_xyz = (points[:, :3] - offset) @ matrix  # the inverse of matrix @ file_xyz + offset
    file_xyz[5] = 0

    recording, _ = make_recording(Sensor(axes=axes, rotate=turn, offset=offset))
    scan = recording.to_scan(Cloud(file_xyz, points[:, 3], None, "a.pcd"))

    assert_alike(scan, expected)
    assert np.flatnonzero(~scan.valid).tolist() == [5]
    assert_in_file(scan, file_xyz)


def assert_in_file(scan: Scan, file_xyz: np.ndarray) -> None:
    """Check that `to_file` moves the valid points to where they are in the file, in metres."""
    assert scan.to_file is not None
    moved = scan.points[:, :3] @ scan.to_file[:3, :3].T + scan.to_file[:3, 3]
    np.testing.assert_allclose(moved[scan.valid], file_xyz[scan.valid], atol=1e-4)


@pytest.mark.parametrize("unit", ["mm", "m"])
def test_a_scan_knows_the_way_back_from_what_was_measured(unit: str) -> None:
    points, _ = place(LASERS["os1-64"], 1.2)
    tilted = points[:, :3] @ rotation_from_degrees(0, 6, -4).T
    for expected in (fresh_weights().expects, None):
        scale = 1000.0 if unit == "mm" else 1.0
        recording = Normaliser(expected, Sensor(unit=unit))(Recording("a"))
        scan = recording.to_scan(Cloud(tilted * scale, points[:, 3], None, "a.pcd"))
        assert_in_file(scan, tilted)


def test_rotations_are_yaw_pitch_and_roll() -> None:
    forward, left, up = np.eye(3)
    np.testing.assert_allclose(rotation_from_degrees(90, 0, 0) @ forward, left, atol=1e-12)
    np.testing.assert_allclose(rotation_from_degrees(0, 90, 0) @ forward, -up, atol=1e-12)
    np.testing.assert_allclose(rotation_from_degrees(0, 0, 90) @ left, up, atol=1e-12)


@pytest.mark.parametrize("axes", lidars.AXES.values())
def test_axes_do_not_mirror(axes: Any) -> None:
    assert np.linalg.det(np.array(axes)) == pytest.approx(1)


def test_the_sensor_of_the_training_gets_the_rows_of_the_training() -> None:
    points, _ = place(LIDAR_MODELS["hdl64e"].elevations, 1.73)
    weights = trained_for(WEIGHTS, "hdl64e")
    scan = Normaliser(weights.expects)(Recording("a")).to_scan(make_cloud(points))
    np.testing.assert_array_equal(scan.points, points)

    segmenter = amvnet.load(weights)
    result = segmenter(scan)
    expected = segmenter(points)
    np.testing.assert_array_equal(result.labels, expected.labels)
    np.testing.assert_array_equal(result.rv, expected.rv)


def test_rows_follow_the_lasers_when_the_sensor_is_moved_and_sees_more() -> None:
    points, laser = place(LASERS["os1-64"], 0.8)
    recording, _ = make_recording()
    row = not_none(recording.to_scan(make_cloud(points)).row)

    rows = []
    for index in range(64):
        rows_of_laser = np.unique(row[laser == index])
        assert len(rows_of_laser) == 1
        rows.append(rows_of_laser[0])

    assert (np.diff(rows) <= 0).all()
    assert set(np.bincount(rows).tolist()) <= {3, 4, 5}  # 64 lasers on the 16 rows of these weights


def test_rows_by_elevation_reach_half_a_row_beyond_the_lasers() -> None:
    points, _ = place(np.linspace(-20, 20, 64), 1.7)
    view = RangeViewConfig(height=16, width=64, fov_up=3, fov_down=-25)
    lasers = SensorGeometry(64, fov_up=20.0, fov_down=-20.0)
    chosen = not_none(_row_view(points, lasers, Expectation(view, Sensor())))
    half = 40 / 16 / 2
    assert (chosen.fov_up, chosen.fov_down) == (20 + half, -20 - half)


@pytest.mark.parametrize("kind", ["none", "right", "reversed", "in pairs", "random"])
def test_weights_with_rings_as_rows_get_the_rows_of_the_training(kind: str) -> None:
    points, laser = place(LASERS["hdl32e"], 1.84)
    random = np.random.default_rng(0).integers(0, 32, len(laser))
    rings = {"none": None, "right": laser, "reversed": 31 - laser, "in pairs": laser ^ 1}
    rings["random"] = random
    recording, _ = make_recording(name="hdl32e", is_nuscenes=True)
    scan = recording.to_scan(make_cloud(points, rings[kind]))
    np.testing.assert_array_equal(rows_in_nuscenes(scan), 31 - laser)


def test_rings_that_are_four_rows_off_do_not_decide_the_rows() -> None:
    """As if a file left out the lowest lasers of the sensor, and numbered the others from 0."""
    points, laser = place(LASERS["hdl32e"], 1.84)
    recording, _ = make_recording(name="hdl32e", is_nuscenes=True)
    for off in (1, 4):
        scan = recording.to_scan(make_cloud(points[laser >= off], laser[laser >= off] - off))
        np.testing.assert_array_equal(rows_in_nuscenes(scan), 31 - laser[laser >= off])


def test_points_whose_ring_is_unknown_get_no_row_by_their_ring() -> None:
    points, laser = place(np.linspace(-20, 12, 32), 1.84)
    unknown = np.arange(len(laser)) % 7 == 0
    recording, _ = make_recording(Sensor(beams=32), "homemade", is_nuscenes=True)
    row = not_none(recording.to_scan(make_cloud(points, np.where(unknown, -1, laser))).row)
    np.testing.assert_array_equal(row, np.where(unknown, -1, 31 - laser))


def rows_in_nuscenes(scan: Scan) -> np.ndarray:
    """Return the (N,) rows of a scan in the range image of weights whose rows are rings."""
    return RangeView(NUSCENES_WEIGHTS.model.range_view).rows(PointBatch.of([scan])).numpy()


def test_weights_of_an_unknown_sensor_get_rows_if_the_number_of_lasers_fits() -> None:
    points, laser = place(np.linspace(-20, 12, 32), 1.84)
    for count in (32, 20, None):
        recording, _ = make_recording(Sensor(beams=count), "homemade", is_nuscenes=True)
        row = recording.to_scan(make_cloud(points)).row
        assert (row is not None) == (count == 32)
        if row is not None:
            np.testing.assert_array_equal(row, 31 - laser)

    for ring in (laser, 31 - laser):
        scan = recording.to_scan(make_cloud(points, ring))
        np.testing.assert_array_equal(rows_in_nuscenes(scan), 31 - laser)


def test_what_was_assumed_is_said_once_for_a_source() -> None:
    drive, lines = make_recording()
    for seed in range(3):
        points, _ = place(LASERS["vlp16"], 0.9, seed=seed)
        points[:, 3] *= 255
        drive.to_scan(make_cloud(points))

    assert len(lines) == 1
    lasers = ("+15 to -15", "hdl64e", "no such sensor")
    for word in ("a.pcd", "0 to 255", "m over the ground", "1.73 m", *lasers):
        assert word in lines[0]

    other, higher = map(drive.normaliser, (Recording("other"), Recording("higher")))
    other.to_scan(make_cloud(points))  # of the same sensor
    assert len(lines) == 1
    points, _ = place(LASERS["vlp16"], 1.9)
    higher.to_scan(make_cloud(points))
    assert len(lines) == 2


def test_recordings_that_are_only_looked_at_share_a_line_if_they_are_alike() -> None:
    lines: list[str] = []
    normaliser = Normaliser(report=lines.append)
    points, _ = place(LASERS["vlp16"], 0.9)
    site_a, site_b, site_c = (normaliser(Recording(name)) for name in ("a", "b", "c"))
    for site in (site_a, site_b, site_a):
        site.to_scan(make_cloud(points))
    assert len(lines) == 1
    site_c.to_scan(make_cloud(points * np.array([1, 1, 1, 255], np.float32)))
    assert len(lines) == 2
    assert "0 to 255" in lines[1]


@pytest.mark.parametrize(
    ("stated", "words"),
    [
        (Sensor(height=0.9), ["0.90 m", "measured is 1.7"]),
        (KNOWN_SENSORS["os1-64"], ["64 lasers", "rings are 32", "-22.5 degrees"]),
        (Sensor(fov_up=10, fov_down=-10), ["-10.0 degrees", "points lie"]),
        (Sensor(fov_up=90, fov_down=-90), ["+90.0 to -90.0 degrees", "points lie from +1"]),
        (Sensor(fov_up=15, fov_down=-45), ["+15.0 to -45.0 degrees", "points lie from +1"]),
        (Sensor(fov_up=60, fov_down=-30), []),  # there may be nothing above
        (Sensor(height=1.6), []),
        (KNOWN_SENSORS["vlp32c"], []),
        (Sensor(), []),
    ],
)
def test_a_sensor_that_contradicts_the_scan_is_named(stated: Sensor, words: list[str]) -> None:
    lines: list[str] = []
    normaliser = Normaliser(Expectation.of_sensor("hdl64e"), stated, lines.append)
    points, ring = place(LASERS["vlp32c"], 1.75)
    for source in ("drive", "same"):
        normaliser(Recording(source)).to_scan(make_cloud(points, ring))
    warnings = [line for line in lines if "you state" in line]
    assert len(warnings) == (1 if words else 0)
    assert all(word in warnings[0] for word in words)


def test_a_tilt_that_is_not_levelled_contradicts_no_lasers() -> None:
    for up, words in ((15, ""), (10, "+10.0 degrees")):
        lines: list[str] = []
        stated = Sensor(fov_up=up, fov_down=-15)
        points, _ = place(np.linspace(15, -15, 32), 0.9)
        points[:, :3] = points[:, :3] @ rotation_from_degrees(0, 3, 0).T.astype(np.float32)
        normaliser = Normaliser(Expectation.of_sensor("hdl64e"), stated, lines.append)
        normaliser(Recording("drive")).to_scan(make_cloud(points))
        stating = " ".join(line for line in lines if "you state" in line)
        assert words in stating
        assert bool(words) == bool(stating)


@pytest.mark.parametrize(
    ("laser", "advice"), [("hdl32e", "sim-hdl32e would fit"), ("vlp16", "sim-any would fit")]
)
def test_a_warning_of_another_sensor_names_weights_that_fit(laser: str, advice: str) -> None:
    recording, lines = make_recording()
    points, _ = place(LASERS[laser], 1.7)
    recording.to_scan(make_cloud(points))
    assert lines[0].endswith(f"have seen no such sensor; {advice}")


def test_the_table_of_built_in_weights_has_the_sensors_of_their_files() -> None:
    assert {name: load(name).sensor for name in built_in()} == lidars.BUILT_IN


def test_the_sensor_of_the_training_is_said_to_be_familiar_and_in_place() -> None:
    points, _ = place(LIDAR_MODELS["hdl64e"].elevations, 1.73)
    recording, lines = make_recording()
    recording.to_scan(make_cloud(points))
    assert "no such sensor" not in lines[0]
    assert "moved" not in lines[0]


def rise_of(recording: Normalised, points: np.ndarray) -> float:
    """Return how far a scan of a recording is moved up, metres."""
    return float((recording.to_scan(make_cloud(points)).points[:, 2] - points[:, 2]).mean())


def test_scans_of_one_source_keep_one_height() -> None:
    recording, _ = make_recording()
    rises = []
    for seed, height in enumerate((1.0, 1.0, 1.1, 1.0, 1.0, 1.1, 1.1, 1.1, 1.1, 1.1)):
        points, _ = place(LASERS["os1-64"], height, seed=seed)
        rises.append(rise_of(recording, points))

    assert np.ptp(rises[MEASURED_SCANS:]) < 1e-5
    assert rises[-1] == pytest.approx(1.0 - 1.73, abs=0.03)


def test_scans_of_two_robots_in_one_source_get_their_own_heights() -> None:
    recording, _ = make_recording()
    for height in (1.0, 2.5, 1.0, 2.5):
        points, _ = place(LASERS["os1-64"], height)
        assert rise_of(recording, points) == pytest.approx(height - 1.73, abs=0.05)


COORDINATE = (
    st.floats(width=32)
    | st.floats(-50, 50, width=32)
    | st.sampled_from([0.0, 1.0, -1.7, 1e4, 3e38])
)
STATED = [
    lidars.UNKNOWN_SENSOR,
    Sensor(fov_up=-40),
    KNOWN_SENSORS["vlp16"],
    Sensor(height=1, rotate=(1, 2, 3)),
]


@with_examples(
    200,
    derandomize=True,
    rows=st.lists(st.tuples(*[COORDINATE] * 4), max_size=8),
    repeated=st.sampled_from([1, 3, 60]),
    has_ring=st.booleans(),
    sensor=st.sampled_from(STATED),
    trained_for=st.sampled_from(["hdl64e", "hdl32e", "homemade"]),
    is_nuscenes=st.booleans(),
)
def test_any_numbers_end_in_a_scan_or_one_line(
    rows: list[Any],
    repeated: int,
    has_ring: bool,
    sensor: Sensor,
    trained_for: str,
    is_nuscenes: bool,
) -> None:
    points = np.array(rows * repeated, np.float32).reshape(-1, 4)
    cloud = make_cloud(points, np.arange(len(points)) % 40 if has_ring else None)
    recording, _ = make_recording(sensor, trained_for, is_nuscenes)

    with contextlib.suppress(InputError):
        for _ in range(2):
            scan = recording.to_scan(cloud)
            assert len(scan) == len(points)

            assert not scan.valid[(points[:, :3] == 0).all(axis=1)].any()
            intensity = scan.points[scan.valid, 3]
            assert ((intensity >= 0) & (intensity <= 1)).all()


# --- descriptions


def test_a_sensor_is_described_by_name_file_and_options(tmp_path: Path) -> None:
    path = tmp_path / "robot.yaml"
    path.write_text(
        "beams: 16\nfov_up: 15\nfov_down: -15\nheight: 0.4\naxes: z-forward\nrotate: [0, -5, 0]\n"
    )
    lasers = Sensor("robot", 16, 15, -15)
    expected = replace(lasers, height=0.4, axes="z-forward", rotate=(0, -5, 0))
    assert make_sensor(str(path)) == expected

    assert make_sensor(str(path), height=0.5, offset="0,0,1e-1").height == 0.5
    assert make_sensor(None, rotate="90, 0,0").rotate == (90, 0, 0)
    assert make_sensor("vlp16") == KNOWN_SENSORS["vlp16"]
    assert make_sensor() == Sensor()


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("beams: many", ["beams", "many"]),
        ("beams: 1.5", ["beams"]),
        ("colour: red", ["colour", "beams"]),
        ("height: -1", ["height", "-1"]),
        ("unit: inch", ["unit", "mm"]),
        ("height: .nan", ["height"]),
        ("intensity_scale: 0", ["intensity_scale"]),
        ("fov_up: -20\nfov_down: 3", ["fov_down"]),
        ("rotate: [1, 2]", ["rotate"]),
        ("offset: here", ["offset"]),
        ("axes: up", ["axes", "x-forward"]),
        ("- 1", ["keys"]),
        ("classes: {car: 1}\nscans: '*.pcd'", ["(classes, scans); give it as DATA or INPUT"]),
        ("a: [", ["YAML"]),
        ("[" * 5000, ["YAML"]),
    ],
)
def test_a_wrong_description_is_named(tmp_path: Path, text: str, words: list[str]) -> None:
    path = new_file(tmp_path / "robot.yaml", text)
    fails(lambda: make_sensor(str(path)), path, *words)


def test_sensors_are_described_as_they_are_simulated() -> None:
    """The field of view is that of the points, seen from the origin of the coordinates."""
    for name, simulated in LIDAR_MODELS.items():
        sensor = KNOWN_SENSORS[name]
        ends = np.array([simulated.elevations[0], simulated.elevations[-1]])
        heights = np.interp(ends, *np.transpose(simulated.origins))
        slopes = np.tan(np.radians(ends))
        # The lowest laser sees the ground, the highest one mostly things about 18 m away.
        distance = np.array([18.0, -(simulated.height + heights[1]) / slopes[1]])
        top, bottom = np.degrees(np.arctan(slopes + heights / distance))
        assert sensor.beams == len(simulated.elevations)
        assert sensor.fov_up == pytest.approx(top, abs=0.1)
        assert sensor.fov_down == pytest.approx(bottom, abs=0.5)
        if name in lidars.KNOWN_HEIGHTS:  # the sensor of weights is mounted at one height
            assert lidars.KNOWN_HEIGHTS[name] == simulated.height
    assert set(lidars.KNOWN_HEIGHTS) <= {*LIDAR_MODELS, lidars.ANY}


# --- on the command line


@pytest.fixture(scope="module")
def world(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("sensors")
    save(trained_for(WEIGHTS, "hdl64e"), root / "w.safetensors")
    save(trained_for(NUSCENES_WEIGHTS, "hdl32e"), root / "ring.safetensors")

    points, _ = place(LASERS["vlp16"], 0.9)
    points.tofile(root / "robot.bin")
    write_bag1(root / "drive.bag", {"/top": [points] * 3, "/side": [points]})
    return root


@pytest.mark.parametrize("weights", ["w", "ring"])
def test_labels_are_at_the_lines_of_their_points(world: Path, tmp_path: Path, weights: str) -> None:
    points, _ = place(LASERS["vlp16"], 0.9)
    is_lost = np.random.default_rng(0).random(len(points)) < 0.2
    points[is_lost] = 0
    points[np.flatnonzero(is_lost)[::2], :3] = np.nan

    names = ("x", "y", "z", "intensity")
    table = points.view([(name, "f4") for name in names]).ravel()
    content = pcd_bytes(table, [(name, "F 4", 1) for name in names], height=16)
    path = new_file(tmp_path / "a.pcd", content)

    options = ("--weights", world / f"{weights}.safetensors", "--out", tmp_path)
    assert run_cli("predict", path, *options)[0] == 0

    labels = np.fromfile(tmp_path / "a.label", np.uint32)
    assert len(labels) == len(points)
    assert np.array_equal(labels == 0, is_lost)


def test_a_bag_is_segmented_scan_by_scan(
    world: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    options = ("--weights", world / "w.safetensors", "--out", tmp_path)
    bag_options = (*options, "--topic", "/top", "--scores")
    assert main(["predict", str(world / "drive.bag"), *map(str, bag_options)]) == 0
    assert capsys.readouterr().out.count(": assumed") == 1

    expected_files = set()
    for index in range(3):
        expected_files |= {f"drive/{index:06d}.label", f"drive/{index:06d}.npz"}
    assert files(tmp_path) == expected_files

    assert run_cli("predict", world / "robot.bin", *options, "--resume")[0] == 2
    assert run_cli("predict", world / "robot.bin", *options, "--overwrite")[0] == 0
    expected = (tmp_path / "robot.label").read_bytes()
    for path in (tmp_path / "drive").glob("*.label"):
        assert path.read_bytes() == expected


@pytest.mark.parametrize(
    "mistake",
    [
        "{w}/drive.bag",
        "{w}/drive.bag --topic /none",
        "{w}/robot.bin --sensor eye",
        "{w}/robot.bin --sensor {w}/none.yaml",
        "{w}/robot.bin --axes up",
        "{w}/robot.bin --unit inch",
        "{w}/robot.bin --rotate 1,2",
        "{w}/robot.bin --offset=-1,x,2",
        "{w}/robot.bin --height=-1",
        "{w}/robot.bin --height tall",
        "{w}/robot.bin --intensity-scale 0",
        "{w}/w.safetensors",
    ],
)
def test_mistakes_are_one_line(mistake: str, world: Path, tmp_path: Path) -> None:
    options = ("--weights", world / "w.safetensors", "--out", tmp_path / "out")
    refusal("predict", *mistake.format(w=world).split(), *options)
    assert not files(tmp_path)


def test_scans_of_datasets_are_not_normalised(tmp_path: Path) -> None:
    weights = save(trained_for(WEIGHTS, "hdl64e"), tmp_path / "w.safetensors")
    data = make_streets(tmp_path / "data", ("00",), 1)
    path = data / "sequences/00/velodyne/000000.bin"
    points = np.fromfile(path, np.float32).reshape(-1, 4)
    points[:, 2] += 1  # another height, other intensities, a point at the origin
    points[:, 3] *= 0.1
    points[3] = 0
    points.tofile(path)

    options = ("--weights", weights, "--height", 0.5, "--axes", "z-forward")
    assert run_cli("predict", data, *options, "--out", tmp_path / "out")[0] == 0

    labels = np.fromfile(tmp_path / "out/sequences/00/predictions/000000.label", np.uint32)
    expected = amvnet.load(str(weights))(points).labels
    np.testing.assert_array_equal(labels, SEMANTICKITTI.to_raw(expected))
    assert labels[3] == 0
    assert np.delete(expected, 3).all()


@pytest.mark.parametrize(("sensor", "is_changed"), [("hdl64e", True), ("hdl32e", False)])
def test_scans_of_a_benchmark_are_normalised_for_weights_that_do_not_know_its_sensor(
    tmp_path: Path, sensor: str, is_changed: bool
) -> None:
    layout = make_nuscenes(tmp_path)
    points, laser = on_nuscenes_car()
    np.column_stack([points * [1, 1, 1, 255], laser]).astype(np.float32).tofile(layout.first_points)
    layout.first_labels.write_bytes(np.ones(len(points), np.uint8).tobytes())
    dataset = open_dataset(layout.spec)
    expected = Expectation.of_sensor(sensor)
    changed = normalised(dataset, Normaliser(expected))

    unchanged, scan = (
        {scan.path: scan for scan in each.records(layout.sequences)}[layout.first_points].load(True)
        for each in (dataset, changed)
    )
    np.testing.assert_array_equal(scan.labels, np.where(scan.valid, not_none(unchanged.labels), 0))
    assert (scan.row is not None) == is_changed
    if is_changed:
        normaliser = Normaliser(expected, Sensor(unit="m"))
        alone = normaliser(Recording("alone")).to_scan(Cloud.of(unchanged))
        np.testing.assert_array_equal(scan.points, alone.points)
        np.testing.assert_array_equal(scan.valid, alone.valid)
        assert 0.1 < 1 - scan.valid.mean() < 0.4  # of the car itself
    else:
        np.testing.assert_array_equal(scan.points, unchanged.points)
        assert scan.valid.all()


def test_the_sensor_of_a_scene_is_measured_on_the_scene_and_not_on_each_scan(
    tmp_path: Path,
) -> None:
    layout = make_nuscenes(tmp_path)
    dataset = open_dataset(layout.spec)
    first, second = (record.path for record in dataset.records(layout.sequences[:1]))
    points, laser = on_nuscenes_car()
    table = np.column_stack([points * [1, 1, 1, 255], laser]).astype(np.float32)
    is_low = laser < 29  # in the second scan, the upper lasers see the sky
    table.tofile(first)
    table[is_low].tofile(second)

    changed = normalised(dataset, Normaliser(Expectation.of_sensor("hdl64e")))
    whole, part = (record.load() for record in changed.records(layout.sequences[:1]))
    np.testing.assert_array_equal(part.points, whole.points[is_low])
    np.testing.assert_array_equal(part.row, not_none(whole.row)[is_low])

    record = changed.records(layout.sequences[:1])[0]
    unchanged = changed.read_unchanged(record)
    np.testing.assert_array_equal(unchanged.points[:, :3], table[:, :3])


@pytest.mark.parametrize("seed", range(4))
def test_random_bytes_as_points_give_no_warning(seed: int) -> None:
    # Signalling NaN, infinity and numbers close to the largest are among them.
    points = np.frombuffer(np.random.default_rng(seed).bytes(16 * 5000), np.float32).reshape(-1, 4)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        raised = raise_points(Scan(points), 0.5)
    finite = np.isfinite(points[:, 2]) & (np.abs(points[:, 2]) < 1e30)
    assert np.allclose(raised.points[finite, 2], points[finite, 2] + np.float32(0.5))


@pytest.mark.parametrize(("beams", "other"), [(16, 64), (64, 16), (32, 64)])
def test_sensors_with_far_more_or_fewer_lasers_are_not_alike(beams: int, other: int) -> None:
    assert not SensorGeometry(beams, 10, -20).is_like(SensorGeometry(other, 10, -20))
    assert SensorGeometry(beams, 10, -20).is_like(SensorGeometry(beams + 2, 10, -20))


def test_a_stated_unit_settles_that_a_sensor_is_high() -> None:
    weights = trained_for(WEIGHTS, "hdl64e")
    points, _ = place(LASERS["os1-64"], 6.0)
    cloud = Cloud(points[:, :3], np.linspace(0, 0.6, len(points)), name="a")
    fails(lambda: Normaliser(weights.expects)(Recording("a")).to_scan(cloud), "--unit")
    for sensor in (Sensor(unit="m"), Sensor(height=6.0)):
        assert Normaliser(weights.expects, sensor)(Recording("a")).to_scan(cloud).valid.any()


def test_a_name_in_a_description_is_that_of_a_known_sensor(tmp_path: Path) -> None:
    known = KNOWN_SENSORS["pandar64"]
    assert make_sensor({"name": "pandar64"}) == known
    assert make_sensor({"name": "pandar64", "height": 2}) == replace(known, height=2)
    fails(lambda: make_sensor({"name": "pandar6444"}), "did you mean pandar64?")

    path = new_file(tmp_path / "robot.yaml", "name: pandar64\nfov_up: 12\n")
    assert make_sensor(str(path)) == replace(known, fov_up=12)
    path.write_text("name: pandar6444\n")
    fails(lambda: make_sensor(str(path)), path, "did you mean pandar64?")
    path.write_text("fov_up: 12\n")
    assert make_sensor(str(path)).name == "robot"
