"""What is measured is what was built, for every sensor; a scan fits the weights whatever its axes, units and place."""

from __future__ import annotations

import contextlib
import os
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from amvnet.cli.main import main
from amvnet.data.formats.cloud import Cloud
from amvnet.data.taxonomy import NUSCENES, SEMANTICKITTI
from amvnet.errors import InputError
from amvnet.inference.segmenter import Segmenter
from amvnet.scan import Scan
from amvnet.sensors.adapt import MEASURED, ScanAdapter
from amvnet.sensors.lidars import AXES, HEIGHTS, SENSORS, Sensor, make_sensor, rotation_from_degrees
from amvnet.sensors.measure import ground_height, measure
from amvnet.simulation.sensors import HDL32E, HDL64E
from amvnet.weights.file import save

from fixtures.scan_writers import pcd_bytes, write_bag1
from fixtures.sensors import LASERS, place
from fixtures.worlds import fails, files, fresh_weights, make_streets, run_cli

REAL = os.environ.get("AMVNET_REAL_DATA")


# --- measuring


@pytest.mark.parametrize("name", LASERS)
@pytest.mark.parametrize("height", [0.6, 1.73, 2.6])
def test_lasers_field_of_view_and_height_are_measured(name: str, height: float) -> None:
    points, laser = place(LASERS[name], height)
    by_laser = np.argsort(laser, kind="stable")
    for table, ring in ((points, None), (points[by_laser], None), (points, laser)):
        found = measure(table, ring)
        assert found.beams == len(LASERS[name])
        assert found.height == pytest.approx(height, abs=0.05)
        assert found.fov_up == pytest.approx(max(LASERS[name]), abs=0.5)
        assert found.fov_down == pytest.approx(min(LASERS[name]), abs=0.5)


@pytest.mark.parametrize("slope", [-6, 0, 4])
def test_the_ground_is_found_on_a_slope_and_among_stray_points(slope: float) -> None:
    points, _ = place(LASERS["os1-64"], 1.5, slope=slope)
    rng = np.random.default_rng(1)
    stray = rng.random(len(points)) < 0.2
    points[stray, 2] += rng.uniform(-1, 4, stray.sum()).astype(np.float32)
    assert ground_height(points[:, :3].astype(np.float64)) == pytest.approx(1.5, abs=0.08)


def test_what_a_scan_does_not_tell_is_left_open() -> None:
    rng = np.random.default_rng(0)
    sky = place(np.linspace(5, 30, 16), 1.7)[0]
    blurred = np.column_stack([rng.normal(0, (20, 20, 4), (20_000, 3)), rng.random(20_000)])
    assert measure(sky).height is None
    assert measure(blurred).beams is None
    assert measure(blurred[:50]).fov_up is None


def test_a_firing_order_and_chance_are_no_order_of_lasers() -> None:
    points, _ = place(HDL64E.elevations, 1.73)
    shuffled = points[np.random.default_rng(0).permutation(len(points))]
    for table in (points, shuffled):
        assert measure(table).beams == 64  # by the peaks


@pytest.mark.skipif(not REAL, reason="AMVNET_REAL_DATA does not name a folder")
@pytest.mark.parametrize(("name", "beams"), [("semantickitti", 64), ("nuscenes", 32)])
def test_real_sensors_stand_where_they_do(name: str, beams: int) -> None:
    from amvnet.data.datasets.open import open_dataset

    dataset = open_dataset(str(Path(REAL or "") / name))
    records = dataset.records(dataset.sequences("all"))[::5]
    found = [
        measure(scan.points[scan.valid], scan.ring)
        for scan in (dataset.read(r, labels=False) for r in records)
    ]
    expected = HEIGHTS[f"hdl{beams}e"]
    heights = [m.height for m in found if m.height is not None]
    assert len(heights) == len(records)
    assert np.median(heights) == pytest.approx(expected, abs=0.1)
    assert np.abs(np.array(heights) - expected).max() < 0.2
    assert [m.beams for m in found] == [beams] * len(found)


# --- fitting


def _fitting(
    given: Sensor | None = None, sensor: str = "hdl64e", nuscenes: bool = False
) -> tuple[ScanAdapter, list[str]]:
    said: list[str] = []
    weights = replace(fresh_weights(NUSCENES if nuscenes else SEMANTICKITTI), sensor=sensor)
    return ScanAdapter(weights, given, said.append), said


def _cloud(points: np.ndarray, ring: np.ndarray | None = None) -> Cloud:
    return Cloud(points[:, :3], points[:, 3], ring, "a.pcd")


def _equal(a: Scan, b: Scan, atol: float = 1e-4) -> None:
    np.testing.assert_allclose(a.points, b.points, atol=atol)
    assert a.ring is not None
    assert b.ring is not None
    assert np.mean(a.ring == b.ring) > 0.99  # but for points at a border of rows


@pytest.mark.parametrize("height", [0.6, 1.73, 2.6])
def test_the_sensor_comes_to_the_height_that_the_weights_know(height: float) -> None:
    points, _ = place(LASERS["os1-64"], height)
    fit, _ = _fitting()
    scan = fit(_cloud(points), "a")
    np.testing.assert_array_equal(scan.points[:, [0, 1, 3]], points[:, [0, 1, 3]])
    assert ground_height(scan.points[:, :3].astype(np.float64)) == pytest.approx(1.73, abs=0.05)
    moved = scan.points[:, 2] - points[:, 2]
    assert moved.max() - moved.min() < 1e-5
    assert np.all(moved == 0) == (height == 1.73)


def test_a_given_height_counts_whatever_the_ground_says() -> None:
    points, _ = place(LASERS["os1-64"], 1.2)
    fit, _ = _fitting(Sensor(height=2.23))
    np.testing.assert_allclose(fit(_cloud(points), "a").points[:, 2] - points[:, 2], 0.5, atol=1e-5)


@pytest.mark.parametrize("axes", AXES)
@pytest.mark.parametrize("turn", [(0, 0, 0), (90, 0, 0), (30, 10, -5)])
def test_any_frame_that_is_described_gives_the_same_scan(
    axes: str, turn: tuple[float, float, float]
) -> None:
    points, _ = place(LASERS["os1-64"], 1.2)
    points[5] = 0
    expected = _fitting()[0](_cloud(points), "a")
    matrix, offset = rotation_from_degrees(*turn) @ np.array(AXES[axes], float), np.array([0.1, -0.2, 0.4])
    there = (points[:, :3] - offset) @ matrix  # the inverse of matrix @ there + offset
    there[5] = 0
    sensor = Sensor(axes=axes, rotate=turn, offset=(0.1, -0.2, 0.4))
    found = _fitting(sensor)[0](Cloud(there, points[:, 3], None, "a.pcd"), "a")
    _equal(found, expected)
    assert np.flatnonzero(~found.valid).tolist() == [5]


def test_rotations_are_yaw_pitch_and_roll() -> None:
    np.testing.assert_allclose(
        rotation_from_degrees(90, 0, 0) @ [1, 0, 0], [0, 1, 0], atol=1e-12
    )  # ahead comes to the left
    np.testing.assert_allclose(
        rotation_from_degrees(0, 90, 0) @ [1, 0, 0], [0, 0, -1], atol=1e-12
    )  # ahead comes down
    np.testing.assert_allclose(
        rotation_from_degrees(0, 0, 90) @ [0, 1, 0], [0, 0, 1], atol=1e-12
    )  # left comes up
    for axes in AXES.values():
        assert np.linalg.det(np.array(axes)) == pytest.approx(1)  # no mirror


def test_rows_are_those_of_the_weights_where_the_sensor_is_theirs() -> None:
    points, _ = place(HDL64E.elevations, 1.73)
    weights = replace(fresh_weights(), sensor="hdl64e")
    segmenter = Segmenter(weights)
    fitted = ScanAdapter(weights)(_cloud(points), "a")
    np.testing.assert_array_equal(fitted.points, points)
    np.testing.assert_array_equal(segmenter.by_ring()(fitted).labels, segmenter(points).labels)
    np.testing.assert_array_equal(segmenter.by_ring()(fitted).rv, segmenter(points).rv)


def test_rows_follow_the_lasers_when_the_sensor_is_moved_and_sees_more() -> None:
    points, laser = place(LASERS["os1-64"], 0.8)
    weights = replace(fresh_weights(), sensor="hdl64e")
    ring = ScanAdapter(weights)(_cloud(points), "a").ring
    assert ring is not None
    of_laser = [np.unique(ring[laser == k]) for k in range(64)]
    assert all(len(rows) == 1 for rows in of_laser)
    rows = np.concatenate(of_laser)
    assert (np.diff(rows) >= 0).all()
    assert set(np.bincount(rows).tolist()) <= {3, 4, 5}  # 64 lasers on the 16 rows of these weights


@pytest.mark.parametrize("known", ["none", "right", "reversed"])
def test_weights_by_ring_get_the_rings_that_they_know(known: str) -> None:
    points, laser = place(LASERS["hdl32e"], 1.84)
    rings = {"none": None, "right": laser, "reversed": 31 - laser}
    ring = _fitting(sensor="hdl32e", nuscenes=True)[0](_cloud(points, rings[known]), "a").ring
    assert ring is not None
    np.testing.assert_array_equal(ring, laser)


def test_weights_of_an_unknown_sensor_get_rings_where_lasers_can_be_told() -> None:
    lasers = np.linspace(-20, 12, 32)
    points, laser = place(lasers, 1.84)
    fit, _ = _fitting(sensor="homemade", nuscenes=True)
    np.testing.assert_array_equal(fit(_cloud(points), "a").ring, laser)
    few = place(np.linspace(-20, 12, 20), 1.84)[0]
    assert fit(_cloud(few), "b").ring is None
    np.testing.assert_array_equal(fit(_cloud(points, 31 - laser), "c").ring, 31 - laser)


def test_what_was_assumed_is_said_once_for_a_source() -> None:
    points, _ = place(LASERS["vlp16"], 0.9)
    points[:, 3] *= 255
    fit, said = _fitting()
    for seed in range(3):
        fit(
            _cloud(
                place(LASERS["vlp16"], 0.9, seed=seed)[0] * np.array([1, 1, 1, 255], np.float32)
            ),
            "drive",
        )
    assert len(said) == 1
    for word in (
        "a.pcd",
        "0 to 255",
        "m over the ground",
        "1.73 m",
        "16 lasers",
        "+15 to -15",
        "hdl64e",
        "no such sensor",
    ):
        assert word in said[0]
    fit(_cloud(points), "other")
    assert len(said) == 2
    own, said = _fitting()
    own(_cloud(place(HDL64E.elevations, 1.73)[0]), "drive")
    assert "no such sensor" not in said[0]
    assert "moved" not in said[0]


def test_scans_of_one_source_keep_one_height_unless_they_disagree() -> None:
    fit, _ = _fitting()
    rises = []
    for seed, height in enumerate((1.0, 1.0, 1.1, 1.0, 1.0, 1.1, 1.1, 1.1, 1.1, 1.1)):
        points, _ = place(LASERS["os1-64"], height, seed=seed)
        rises.append(float((fit(_cloud(points), "drive").points[:, 2] - points[:, 2]).mean()))
    assert np.ptp(rises[MEASURED:]) < 1e-5
    assert rises[-1] == pytest.approx(1.0 - 1.73, abs=0.03)
    for height in (1.0, 2.5, 1.0, 2.5):  # a folder of two robots
        points, _ = place(LASERS["os1-64"], height)
        rise = float((fit(_cloud(points), "mixed").points[:, 2] - points[:, 2]).mean())
        assert rise == pytest.approx(height - 1.73, abs=0.05) or height == 1.0


@pytest.mark.parametrize("up", [1.5, 1.73, 2.0])
def test_a_scan_whose_origin_is_on_the_ground_or_below_is_moved(up: float) -> None:
    points, _ = place(HDL64E.elevations, 1.73)
    on_ground = points + np.array([0, 0, up, 0], np.float32)
    _equal(_fitting()[0](_cloud(on_ground), "a"), _fitting()[0](_cloud(points), "a"), atol=0.05)


coordinate = (
    st.floats(width=32)
    | st.floats(-50, 50, width=32)
    | st.sampled_from([0.0, 1.0, -1.7, 1e4, 3e38])
)


@settings(max_examples=200, deadline=None, derandomize=True, database=None)
@given(
    rows=st.lists(st.tuples(*[coordinate] * 4), max_size=8),
    repeated=st.sampled_from([1, 3, 60]),
    ring=st.booleans(),
    sensor=st.sampled_from(["hdl64e", "hdl32e", "homemade"]),
    nuscenes=st.booleans(),
    given_sensor=st.sampled_from(
        [None, Sensor(fov_up=-40), SENSORS["vlp16"], Sensor(height=1, rotate=(1, 2, 3))]
    ),
)
def test_any_numbers_end_in_a_scan_or_one_line(
    rows: list[Any],
    repeated: int,
    ring: bool,
    sensor: str,
    nuscenes: bool,
    given_sensor: Sensor | None,
) -> None:
    points = np.array(rows * repeated, np.float32).reshape(-1, 4)
    cloud = _cloud(points, np.arange(len(points)) % 40 if ring else None)
    fit, _ = _fitting(given_sensor, sensor, nuscenes)
    with contextlib.suppress(InputError):
        for _ in range(2):
            scan = fit(cloud, "a")
            assert len(scan) == len(points)
            assert not scan.valid[(points[:, :3] == 0).all(axis=1)].any()
            assert ((scan.points[scan.valid, 3] >= 0) & (scan.points[scan.valid, 3] <= 1)).all()


# --- descriptions


def test_a_sensor_is_described_by_name_file_and_options(tmp_path: Path) -> None:
    path = tmp_path / "robot.yaml"
    path.write_text(
        "beams: 16\nfov_up: 15\nfov_down: -15\nheight: 0.4\naxes: z-forward\nrotate: [0, -5, 0]\n"
    )
    assert make_sensor(str(path)) == Sensor(
        "robot", 16, 15, -15, 0.4, None, "z-forward", (0, -5, 0)
    )
    assert make_sensor(str(path), height=0.5, offset="0,0,1e-1").height == 0.5
    assert make_sensor(None, rotate="90, 0,0").rotate == (90, 0, 0)
    assert make_sensor("vlp16") is not None
    assert make_sensor() == Sensor()


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("beams: many", ["beams", "many"]),
        ("beams: 1.5", ["beams"]),
        ("colour: red", ["colour", "beams"]),
        ("height: -1", ["height", "-1"]),
        ("height: .nan", ["height"]),
        ("intensity_scale: 0", ["intensity_scale"]),
        ("fov_up: -20\nfov_down: 3", ["fov_down"]),
        ("rotate: [1, 2]", ["rotate"]),
        ("offset: here", ["offset"]),
        ("axes: up", ["axes", "x-forward"]),
        ("- 1", ["keys"]),
        ("a: [", ["YAML"]),
        ("[" * 5000, ["YAML"]),
    ],
)
def test_a_wrong_description_is_named(tmp_path: Path, text: str, words: list[str]) -> None:
    path = tmp_path / "robot.yaml"
    path.write_text(text)
    fails(lambda: make_sensor(str(path)), path, *words)


def test_wrong_options_are_named(tmp_path: Path) -> None:
    fails(lambda: make_sensor("eye"), "eye", "vlp16")
    fails(lambda: make_sensor(str(tmp_path / "no.yaml")), "no.yaml")
    fails(lambda: make_sensor(rotate="1,2"), "--rotate", "90,0,0")
    fails(lambda: make_sensor(intensity_scale="much"), "--intensity-scale")


def test_known_sensors_are_those_that_are_simulated() -> None:
    for name, simulated in {"hdl64e": HDL64E, "hdl32e": HDL32E}.items():
        known = SENSORS[name]
        assert known.beams == len(simulated.elevations)
        assert known.fov_up == pytest.approx(simulated.elevations[0], abs=0.1)
        assert known.fov_down == pytest.approx(simulated.elevations[-1], abs=0.5)
        assert HEIGHTS[name] == simulated.height


# --- on the command line


@pytest.fixture(scope="module")
def world(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Weights for two sensors, and scans of others."""
    root = tmp_path_factory.mktemp("sensors")
    save(replace(fresh_weights(), sensor="hdl64e"), root / "w.safetensors")
    save(replace(fresh_weights(NUSCENES), sensor="hdl32e"), root / "ring.safetensors")
    points = place(LASERS["vlp16"], 0.9)[0]
    points.tofile(root / "robot.bin")
    write_bag1(root / "drive.bag", {"/top": [points] * 3, "/side": [points]})
    return root


def test_labels_stand_at_the_lines_of_their_points(world: Path, tmp_path: Path) -> None:
    points = place(LASERS["vlp16"], 0.9)[0]
    lost = np.random.default_rng(0).random(len(points)) < 0.2
    points[lost] = 0
    points[np.flatnonzero(lost)[::2], :3] = np.nan
    table = points.view([(name, "f4") for name in ("x", "y", "z", "intensity")]).ravel()
    content = pcd_bytes(table, [(name, "F 4", 1) for name in table.dtype.names or ()], height=16)
    (tmp_path / "a.pcd").write_bytes(content)
    for weights in ("w", "ring"):
        out = tmp_path / weights
        assert (
            run_cli(
                "predict",
                tmp_path / "a.pcd",
                "--weights",
                world / f"{weights}.safetensors",
                "--out",
                out,
            )[0]
            == 0
        )
        labels = np.fromfile(out / "a.label", np.uint32)
        assert len(labels) == len(points)
        assert np.array_equal(labels == 0, lost)


def test_a_bag_is_segmented_scan_by_scan(
    world: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    options = (
        "--weights",
        world / "w.safetensors",
        "--out",
        tmp_path,
        "--topic",
        "/top",
        "--scores",
    )
    assert main(["predict", str(world / "drive.bag"), *map(str, options)]) == 0
    shown = capsys.readouterr().out
    assert files(tmp_path) == {f"drive/{i:06d}.{end}" for i in range(3) for end in ("label", "npz")}
    assert shown.count("assumed") == 1
    assert (
        run_cli(
            "predict", world / "robot.bin", "--weights", world / "w.safetensors", "--out", tmp_path
        )[0]
        == 0
    )
    expected = (tmp_path / "robot.label").read_bytes()
    assert {path.read_bytes() for path in (tmp_path / "drive").glob("*.label")} == {expected}


def test_options_override_what_is_measured(world: Path, tmp_path: Path) -> None:
    labels = {}
    for name, options in {
        "measured": (),
        "stated": ("--height", 0.9),
        "other": ("--height", 2.9),
    }.items():
        call = (
            "predict",
            world / "robot.bin",
            "--weights",
            world / "w.safetensors",
            "--out",
            tmp_path / name,
        )
        assert run_cli(*call, *options)[0] == 0
        labels[name] = np.fromfile(tmp_path / name / "robot.label", np.uint32)
    assert np.mean(labels["measured"] == labels["stated"]) > 0.95
    assert np.mean(labels["measured"] == labels["other"]) < 0.95


@pytest.mark.parametrize(
    "mistake",
    [
        "{w}/drive.bag",
        "{w}/drive.bag --topic /none",
        "{w}/robot.bin --sensor eye",
        "{w}/robot.bin --sensor {w}/none.yaml",
        "{w}/robot.bin --axes up",
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
    code, error = run_cli("predict", *mistake.format(w=world).split(), *options)
    assert (code, error.count("\n")) == (2, 1), error
    assert not files(tmp_path)


def test_data_sets_stay_as_they_are(tmp_path: Path) -> None:
    save(replace(fresh_weights(), sensor="hdl64e"), tmp_path / "w.safetensors")
    data = make_streets(tmp_path / "data", ("00",), 1)
    path = data / "sequences/00/velodyne/000000.bin"
    points = np.fromfile(path, np.float32).reshape(-1, 4)
    points[:, 2] += 1  # another height, another range, a point at the origin
    points[:, 3] *= 255
    points[3] = 0
    points.tofile(path)
    call = ("--weights", tmp_path / "w.safetensors", "--height", 0.5, "--axes", "z-forward")
    assert run_cli("predict", data, *call, "--out", tmp_path / "out")[0] == 0
    found = np.fromfile(tmp_path / "out/sequences/00/predictions/000000.label", np.uint32)
    expected = Segmenter(str(tmp_path / "w.safetensors"))(points).labels
    np.testing.assert_array_equal(found, SEMANTICKITTI.to_raw(expected))
    assert found[3] != 0
