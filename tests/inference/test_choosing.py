"""Without a name of weights, the lasers that are measured choose the built-in weights."""

from __future__ import annotations

from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import amvnet
from amvnet.data.formats import find
from amvnet.data.taxonomy import NUSCENES, SEMANTICKITTI, Taxonomy
from amvnet.inference.listing import find_inputs
from amvnet.sensors import measure
from amvnet.sensors.built_in import lasers_of, weights_for
from amvnet.sensors.lasers import SensorGeometry
from amvnet.sensors.lidars import BUILT_IN, KNOWN_SENSORS, make_sensor
from amvnet.sensors.reading import Reading

from fixtures.commands import fails, files, new_file, refused, succeed
from fixtures.datasets import make_nuscenes, make_semantickitti
from fixtures.sensors import LASERS, place

LAST = list(BUILT_IN)[-1]  # the weights for any other sensor
CHOICES = {"hdl32e": "sim-hdl32e", "vlp16": LAST, "os1-64": LAST}


def write(
    path: Path, sensor: str, height: float = 1.7, ring: bool = False, lifted: float = 0.0
) -> Path:
    points, lasers = place(LASERS[sensor], height)
    points[:, 2] += lifted
    np.save(path, np.column_stack([points, lasers]) if ring else points)
    return path


# ---- the table


@pytest.mark.parametrize("sensor", KNOWN_SENSORS)
def test_weights_for_all_kinds_of_lasers_label_what_has_no_weights_of_its_own(sensor: str) -> None:
    own = {sensor: name for name, sensor in BUILT_IN.items()}
    name, reason = weights_for(SensorGeometry().override(KNOWN_SENSORS[sensor]))
    assert name == own.get(sensor, LAST)
    assert reason.startswith("trained for ")
    assert ("all kinds" in reason) == (sensor not in own)


def test_unknown_lasers_choose_the_last_weights_of_the_table() -> None:
    assert weights_for(SensorGeometry())[0] == LAST


def test_classes_without_weights_for_such_lasers_are_not_said_to_know_them() -> None:
    name, reason = weights_for(SensorGeometry(16, 15, -15), NUSCENES)
    assert name == "sim-hdl32e"
    assert reason.startswith("as none with these classes")


@pytest.mark.parametrize("classes", [SEMANTICKITTI, NUSCENES])
@pytest.mark.parametrize("sensor", ["hdl64e", "hdl32e", "vlp16"])
def test_the_classes_of_a_benchmark_go_before_the_lasers(sensor: str, classes: Taxonomy) -> None:
    name, _ = weights_for(SensorGeometry().override(KNOWN_SENSORS[sensor]), classes)
    assert amvnet.weights.load(name).taxonomy.classes == classes.classes
    chosen, _ = weights_for(lasers_of(classes), classes)
    assert BUILT_IN[chosen] in ("hdl64e", "hdl32e")
    assert amvnet.weights.load(chosen).taxonomy.classes == classes.classes


# ---- inputs


@pytest.mark.parametrize(("sensor", "name"), CHOICES.items())
@pytest.mark.parametrize("height", [1.7, 0.9])
def test_the_first_recording_chooses(tmp_path: Path, sensor: str, name: str, height: float) -> None:
    for folder, laser in (("a", sensor), ("b", "hdl32e")):
        (tmp_path / folder).mkdir()
        write(tmp_path / folder / "scan.npy", laser, height)
    assert find_inputs([f"{tmp_path}/a", f"{tmp_path}/b"]).choose_weights()[0] == name


def test_a_described_sensor_chooses_whatever_the_points_show(tmp_path: Path) -> None:
    path = str(write(tmp_path / "scan.npy", "vlp16"))
    for sensor, name in (("hdl32e", "sim-hdl32e"), ("hdl64e", "sim-hdl64e"), ("os1-64", LAST)):
        assert find_inputs([path], Reading(make_sensor(sensor))).choose_weights()[0] == name


def test_the_classes_of_a_dataset_choose(tmp_path: Path) -> None:
    for make, name in ((make_semantickitti, "sim-hdl64e"), (make_nuscenes, "sim-hdl32e")):
        root = tmp_path / name
        make(root)
        assert find_inputs([str(root)]).choose_weights()[0] == name


def test_the_yaml_file_of_own_scans_describes_the_sensor_that_chooses(tmp_path: Path) -> None:
    write(tmp_path / "scan.npy", "vlp16")
    path = new_file(tmp_path / "own.yaml", "scans: '*.npy'\nclasses: {car: 1}\nsensor: hdl32e\n")
    assert find_inputs([str(path)]).choose_weights()[0] == "sim-hdl32e"
    path.write_text("scans: '*.npy'\nclasses: {car: 1}\nsensor: {name: hdl32e, height: 1}\n")
    assert find_inputs([str(path)]).choose_weights()[0] == "sim-hdl32e"
    path.write_text("scans: '*.npy'\nclasses: {car: 1}\n")
    assert find_inputs([str(path)]).choose_weights()[0] == LAST


def test_scans_that_cannot_be_read_choose_as_unknown_lasers(tmp_path: Path) -> None:
    for name in ("a.bin", "b.bin"):
        (tmp_path / name).write_bytes(b"123")
    assert find_inputs([str(tmp_path)]).choose_weights() == (LAST, "as the lasers are unknown")


def test_a_single_scan_that_cannot_be_read_is_refused_before_its_labels_get_a_place(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "scan.bin").write_bytes(b"123")
    refused(f"predict {tmp_path}/scan.bin --out {tmp_path}/labels", "scan.bin: expected rows")
    assert not capsys.readouterr().out


def test_scans_of_several_sensors_in_a_folder_choose_no_lasers(tmp_path: Path) -> None:
    for index, sensor in enumerate(("vlp16", "hdl32e", "os1-64")):
        write(tmp_path / f"{index}.npy", sensor)
    choice = find_inputs([str(tmp_path)]).choose_weights()
    assert choice == (LAST, "as the scans are of several sensors")


def test_evaluate_says_what_it_assumed(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    scan = write(tmp_path / "scan.npy", "vlp16", 1.1)
    np.ones(len(np.load(scan)), np.uint32).tofile(tmp_path / "scan.label")
    text = "scans: '*.npy'\nlabels: .label\nclasses: {car: 1}\nsplit: {val: scan}\n"
    (tmp_path / "own.yaml").write_text(text)
    (tmp_path / "map.yaml").write_text("classes: {car: [car]}\n")
    succeed(f"evaluate {tmp_path}/own.yaml --classes {tmp_path}/map.yaml")
    assert "sensor 1.10 m over the ground" in capsys.readouterr().out


def test_scans_of_one_name_are_refused_with_their_folders(tmp_path: Path) -> None:
    paths = [tmp_path / name / "x/0.npy" for name in ("a", "b")]
    for path in paths:
        path.parent.mkdir(parents=True)
        write(path, "vlp16")
    command = f"predict {paths[0].parent} {paths[1].parent} --out {tmp_path}/labels"
    refused(command, f"found 0 in {paths[0]} and in {paths[1]};")


# ---- labels


@pytest.mark.parametrize(
    ("sensor", "rings", "is_on_ground"),
    [("vlp16", False, False), ("hdl32e", True, False), ("hdl32e", False, True)],
)
def test_chosen_weights_label_as_if_they_were_named_and_nothing_is_read_or_measured_twice(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    sensor: str,
    rings: bool,
    is_on_ground: bool,
) -> None:
    calls: Counter[str] = Counter()
    for module, function in ((find, "read_file"), (measure, "find_frame")):
        original = getattr(module, function)

        def counted(*args: object, name: str = function, original: object = original) -> object:
            calls[name] += 1
            return original(*args)  # type: ignore[operator]

        monkeypatch.setattr(module, function, counted)

    monkeypatch.chdir(tmp_path)
    write(tmp_path / "scan.npy", sensor, 1.7, rings, lifted=1.7 if is_on_ground else 0.0)
    name = CHOICES[sensor]
    succeed("predict scan.npy")
    line = next(line for line in capsys.readouterr().out.splitlines() if "weights" in line)
    assert line.startswith(f"weights {name}, ")
    assert line.endswith("labels go to labels")
    chosen = dict(calls)

    calls.clear()
    succeed(f"predict scan.npy --weights {name} --out named")
    assert files(tmp_path / "labels") == files(tmp_path / "named") == {"scan.label"}
    labels = (tmp_path / "labels/scan.label").read_bytes()
    assert labels == (tmp_path / "named/scan.label").read_bytes()
    assert chosen["read_file"] == calls["read_file"] == 1
    # The height of an origin on the ground is that of the weights' sensor.
    assert chosen["find_frame"] == calls["find_frame"] + is_on_ground


def test_a_segmenter_without_a_name_takes_the_weights_of_its_first_scan(tmp_path: Path) -> None:
    lines: list[str] = []
    path = write(tmp_path / "scan.npy", "hdl32e", ring=True)
    segmenter = amvnet.load(report=lines.append)
    fails(lambda: segmenter.taxonomy, "expected a segmented scan")
    result = segmenter(path)
    expected = amvnet.load("sim-hdl32e")(path)
    np.testing.assert_array_equal(result.labels, expected.labels)
    assert result.assumed == expected.assumed

    segmenter(write(tmp_path / "other.npy", "vlp16"))
    assert segmenter.taxonomy is segmenter.weights.taxonomy
    assert segmenter.taxonomy.classes == NUSCENES.classes
    assert len([line for line in lines if line.startswith("weights ")]) == 1


def test_each_result_has_the_assumptions_of_its_own_recording(tmp_path: Path) -> None:
    scans = {"low": 0.9, "lower": 0.9, "tall": 1.9}
    for folder, height in scans.items():
        (tmp_path / folder).mkdir()
        write(tmp_path / folder / "0.npy", "vlp16", height)
        write(tmp_path / folder / "1.npy", "vlp16", height)
    results = list(amvnet.load("sim-hdl64e").each(f"{tmp_path}/*/*.npy"))
    lines = [result.assumed for result in results]
    for index, (folder, height) in enumerate(scans.items()):
        first, second = lines[2 * index : 2 * index + 2]
        assert first == second
        assert first.count("assumed") == 1
        assert first.startswith(f"{tmp_path}/{folder}/0.npy: assumed")
        assert f"sensor {height - 0.01:.2f} m" in first


def test_a_segmenter_without_a_name_takes_points_in_memory_as_they_are(tmp_path: Path) -> None:
    points, ring = place(LASERS["hdl32e"], 1.84)
    for given, name in (
        (np.column_stack([points, ring]), "sim-hdl32e"),
        (amvnet.Scan(points, ring=ring), "sim-hdl32e"),
        (points, LAST),  # without rings, the networks of sim-hdl32e do not know the lasers
    ):
        expected = amvnet.load(name)(given).labels
        np.testing.assert_array_equal(amvnet.load()(given).labels, expected)
        np.testing.assert_array_equal(amvnet.load().many([given])[0].labels, expected)
    assert len(list(amvnet.load().each(write(tmp_path / "scan.npy", "vlp16")))) == 1


@pytest.mark.parametrize(
    "wrong", [{"method": "vote"}, {"device": "abacus"}, {"tau": 2.0}, {"sensor": "hdl65"}]
)
def test_a_segmenter_without_a_name_refuses_wrong_options_at_once(wrong: dict[str, Any]) -> None:
    fails(lambda: amvnet.load(**wrong), "expected")
