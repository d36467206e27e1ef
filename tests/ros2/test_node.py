"""The node labels messages as `amvnet predict` labels the same scans in a bag."""

from __future__ import annotations

import gc
import json
import os
import subprocess
import sys
from array import array
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from threading import Event
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from rosbags.rosbag2 import StoragePlugin

import amvnet
from amvnet.data.taxonomy import SEMANTICKITTI
from amvnet.drives.consensus import REACH, _Seen
from amvnet.engines.torch import TorchEngine
from amvnet.inference.segmentation import Segmentation
from amvnet.scan import Scan
from amvnet_ros.fusion import PastFusion
from amvnet_ros.messages import Message

from fixtures import bag_poses
from fixtures.bag_poses import FIRST, PERIOD, cloud, drive_odometry, pose_at, write_bag
from fixtures.commands import not_none, succeed
from fixtures.drives import drive_scans
from fixtures.processes import PATIENCE
from fixtures.ros import STORE, install, over_the_wire
from fixtures.scan_writers import cloud_message, write_bag2
from fixtures.tiny import street

RECORD = np.dtype(
    {
        "names": ["x", "y", "z", "rgb", "label", "uncertain"],
        "formats": ["<f4", "<f4", "<f4", "<u4", "<u4", "u1"],
        "offsets": [0, 4, 8, 12, 16, 20],
        "itemsize": 24,
    }
)
DRIVE_SCANS = 6
Start = Callable[..., Any]  # starts a node with some parameters
# All that is else measured in the first scans, which are others in `predict`.
SENSOR = {"height": 1.73, "axes": "x-forward", "unit": "m", "rotate": "0,0,0"}
SENSOR |= {"intensity_scale": 1.0, "sensor": "hdl64e"}


def scan(seed: int) -> np.ndarray:
    points, _ = street(seed)
    points[:, 3] = np.clip(points[:, 3], 0, 1)
    return points


def as_rclpy_gives_it(message: Any) -> Any:
    """Return a message with an array of bytes."""
    message.data = array("B", message.data.tobytes())
    return message


def ros_message(points: np.ndarray, **changes: Any) -> Any:
    return as_rclpy_gives_it(cloud_message(STORE, points, **changes))


@pytest.fixture
def weights(world: Path) -> Path:
    return world / "w.safetensors"


@pytest.fixture
def start(monkeypatch: pytest.MonkeyPatch, weights: Path) -> Iterator[Start]:
    """Return a function that starts a node with some parameters."""
    nodes = []

    def start_node(**parameters: Any) -> Any:
        nodes.append(install(monkeypatch, **{"weights": str(weights), **parameters}).SegmentNode())
        return nodes[-1]

    yield start_node
    for node in nodes:
        node.close()


def send(node: Any, message: Any) -> None:
    """Hand a message to the node, and wait until it is done with it."""
    is_done = Event()
    label = node._worker._work

    def work(arrival: Any) -> None:
        label(arrival)
        is_done.set()

    node._worker._work = work
    receive, _ = node.callbacks["points"]
    receive(message)
    assert is_done.wait(PATIENCE)
    node._worker._work = label


def report(node: Any) -> Any:
    (timer,) = node.timers
    timer()
    (status,) = node.publishers["/diagnostics"].messages[-1].status
    return status


@pytest.mark.parametrize("padded", [False, True])
def test_labels_are_those_of_predict_on_a_bag(
    start: Start, weights: Path, tmp_path: Path, padded: bool
) -> None:
    scans = [scan(0), scan(1)]
    bag = write_bag2(tmp_path / "bag", {"/points": scans}, StoragePlugin.MCAP, padded=padded)
    options = "--format npy --uncertain --height 1.7 --engine torch"
    succeed(f"predict {bag} --weights {weights} --out {tmp_path / 'out'} {options}")

    node = start(height=1.7, engine="torch")
    for number, points in enumerate(scans):
        send(node, ros_message(points, padded=padded))
        records = np.frombuffer(over_the_wire(node.publishers["~/cloud"].messages[-1]).data, RECORD)

        stem = tmp_path / "out/bag" / f"{number:06d}"
        raw = np.load(f"{stem}.npy")
        np.testing.assert_array_equal(records["label"], raw)
        np.testing.assert_array_equal(records["uncertain"], np.load(f"{stem}.uncertain.npy"))
        for axis, name in enumerate("xyz"):
            np.testing.assert_array_equal(records[name], points[:, axis])

        colors = np.array(SEMANTICKITTI.colors)[SEMANTICKITTI.to_train(raw)]
        bits = colors[:, 0] << 16 | colors[:, 1] << 8 | colors[:, 2]
        np.testing.assert_array_equal(records["rgb"], bits)
    assert len(set(raw)) > 1


def test_messages_keep_the_header_and_the_rows_of_the_scan(start: Start) -> None:
    node = start()
    message = ros_message(scan(0), padded=True)
    send(node, message)
    for topic, names in (
        ("~/labels", ["label", "uncertain"]),
        ("~/cloud", ["x", "y", "z", "rgb", "label", "uncertain"]),
    ):
        published = over_the_wire(node.publishers[topic].messages[-1])
        assert published.header == message.header
        assert (published.height, published.width) == (message.height, message.width)
        assert [field.name for field in published.fields] == names


def test_nothing_is_encoded_that_nobody_subscribes_to(start: Start) -> None:
    node = start()
    node.publishers["~/cloud"].subscriptions = 0
    send(node, ros_message(scan(0)))
    assert not node.publishers["~/cloud"].messages
    assert len(node.publishers["~/labels"].messages) == 1


def test_a_single_network_has_no_uncertain_points(start: Start) -> None:
    node = start(method="rv")
    send(node, ros_message(scan(0)))
    published = over_the_wire(node.publishers["~/labels"].messages[-1])
    assert [field.name for field in published.fields] == ["label"]


@pytest.mark.parametrize("method", ["amvnet", "rv", "bev"])
def test_the_diagnostics_have_the_verdict_of_other_entries(
    start: Start, weights: Path, tmp_path: Path, method: Any
) -> None:
    np.save(tmp_path / "scan.npy", scan(0))
    verdict = not_none(amvnet.load(weights, method=method)(tmp_path / "scan.npy").verdict)

    node = start(method=method)
    send(node, ros_message(scan(0)))
    status = report(node)
    values = {value.key: value.value for value in status.values}
    assert values[f"{verdict.name} (%)"] == f"{100 * verdict.share:.1f}"
    assert status.message.startswith(str(verdict) if verdict.is_doubtful else "labelling")


def test_a_broken_message_is_reported_and_the_next_one_labelled(start: Start) -> None:
    node = start()
    send(node, ros_message(scan(0), width=10**6))
    send(node, ros_message(scan(0), fields=[]))
    message = ros_message(scan(0))
    message.fields[0].datatype = 99
    send(node, message)

    status = report(node)
    assert status.level == status.ERROR
    assert "/points: expected" in status.message
    lines = [text for level, text in node.logger.lines if level == "error"]
    assert len(lines) == 3
    assert not any("\n" in line for line in lines)

    send(node, ros_message(scan(0)))
    assert len(node.publishers["~/labels"].messages) == 1
    assert report(node).level != status.ERROR


def test_the_diagnostics_tell_latency_and_counts(start: Start) -> None:
    node = start()
    assert report(node).level == 1  # no clouds

    send(node, ros_message(scan(0)))  # its stamp is 1 s 2 ns, and the clock says 2.5 s
    status = report(node)
    values = {value.key: value.value for value in status.values}
    assert status.hardware_id == "cpu"
    assert (values["clouds received"], values["stamp to labels (ms)"]) == ("1", "1500")
    assert float(values["latency (ms)"]) > 0


def test_the_classes_are_published_once_for_late_subscribers(start: Start) -> None:
    publisher = start().publishers["~/classes"]
    (message,) = publisher.messages
    classes = json.loads(message.data)
    assert publisher.qos.durability == "latched"
    assert [entry["id"] for entry in classes] == list(SEMANTICKITTI.train_to_raw)
    assert [entry["name"] for entry in classes[1:]] == list(SEMANTICKITTI.classes)
    assert [tuple(entry["color"]) for entry in classes] == list(SEMANTICKITTI.colors)


@pytest.mark.parametrize(("sensor", "name"), [("hdl32e", "sim-hdl32e"), ("", "sim-hdl64e")])
def test_the_first_cloud_chooses_the_weights_and_their_classes(
    start: Start, sensor: str, name: str
) -> None:
    node = start(weights="auto", sensor=sensor)
    assert not node.publishers["~/classes"].messages
    assert report(node).hardware_id == ""

    for seed in range(2):
        send(node, ros_message(scan(seed)))
    (message,) = node.publishers["~/classes"].messages
    names = [entry["name"] for entry in json.loads(message.data)]
    assert names == list(amvnet.weights.load(name).taxonomy.names)
    assert report(node).hardware_id == "cpu"
    lines = [text for _, text in node.logger.lines if text.startswith("weights ")]
    assert len(lines) == 1
    assert name in lines[0]


def test_clouds_have_the_quality_of_service_of_sensor_data(start: Start) -> None:
    node = start()
    _, qos = node.callbacks["points"]
    for profile in (qos, node.publishers["~/labels"].qos, node.publishers["~/cloud"].qos):
        assert (profile.reliability, profile.history) == ("best_effort", "keep_last")
        assert profile.depth == 1


def test_what_a_topic_overrides_does_not_change_the_others(start: Start) -> None:
    node = start()
    node.publishers["~/cloud"].qos.reliability = "reliable"  # as rclpy does
    _, qos = node.callbacks["points"]
    assert qos.reliability == node.publishers["~/labels"].qos.reliability == "best_effort"


def test_an_error_of_the_program_ends_the_node_with_its_traceback(
    start: Start, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*_: object) -> None:
        raise ZeroDivisionError("of the test")

    node = start()
    monkeypatch.setattr(TorchEngine, "score", fail)
    receive, _ = node.callbacks["points"]
    receive(ros_message(scan(0)))
    node._worker._thread.join(PATIENCE)

    assert node.exit_code == 1
    ((_, text),) = [line for line in node.logger.lines if line[0] == "fatal"]
    assert "ZeroDivisionError: of the test" in text


@pytest.mark.parametrize(
    ("parameters", "words"),
    [
        ({"weights": "nowhere"}, "nowhere"),
        ({"weights": "auto", "method": "magic"}, "magic"),
        ({"axes": "sideways"}, "sideways"),
        ({"rotate": "1,2"}, "rotate"),
        ({"sensor": "nothing.yaml"}, "nothing.yaml"),
        ({"engine": "steam"}, "steam"),
        ({"method": "magic"}, "magic"),
        ({"device": "abacus"}, "abacus"),
        ({"height": "high"}, "height"),
    ],
)
def test_a_wrong_parameter_is_one_line_and_exit_code_2(
    parameters: dict[str, Any],
    words: str,
    weights: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setenv("OMP_WAIT_POLICY", "active")  # undoes what `main` sets
    assert install(monkeypatch, **{"weights": str(weights), **parameters}).main([]) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    assert words in error


def test_the_sensor_is_described_as_for_predict(start: Start) -> None:
    node = start(sensor="vlp16", height=0.9, axes="y-forward", intensity_scale=255.0)
    sensor = node._segment._sensor
    assert (sensor.name, sensor.beams) == ("vlp16", 16)
    assert (sensor.height, sensor.axes, sensor.intensity_scale) == (0.9, "y-forward", 255.0)

    assert start()._segment._sensor.height is None
    assert start(height=0.0)._segment._sensor.height == 0


def test_what_is_assumed_of_the_sensor_is_logged_once(start: Start) -> None:
    node = start()
    for seed in range(3):
        send(node, ros_message(scan(seed)))
    lines = [text for level, text in node.logger.lines if "assumed" in text]
    assert len(lines) == 1
    assert lines[0].startswith("/points: assumed")


# ---- fusion over time


@dataclass(frozen=True)
class Drive:
    """Messages of a drive and the poses of its LiDAR, by nanoseconds."""

    messages: list[Any]
    poses: dict[int, np.ndarray]


@pytest.fixture(scope="module")
def drive() -> Drive:
    messages = [as_rclpy_gives_it(sent.make(STORE)) for sent in bag_poses.drive_clouds(DRIVE_SCANS)]
    odometry = drive_odometry(DRIVE_SCANS)
    return Drive(messages, {round(sent.time * 1e9): pose_at(sent.time) for sent in odometry})


def labels_of(node: Any) -> list[np.ndarray]:
    labels = []
    for message in node.publishers["~/cloud"].messages:
        labels.append(np.frombuffer(over_the_wire(message).data, RECORD)["label"])
    return labels


def label_all(node: Any, messages: list[Any]) -> list[np.ndarray]:
    for message in messages:
        send(node, message)
    return labels_of(node)


def fusing(start: Start, drive: Drive, **changes: Any) -> Any:
    """Start a node that fuses scans and has the odometry of the whole drive."""
    node = start(**{"odom_frame": "odom", **SENSOR, **changes})
    node._frames.poses |= drive.poses
    return node


def alone(start: Start, messages: list[Any]) -> list[np.ndarray]:
    return label_all(start(**SENSOR), messages)


def warnings_of(node: Any) -> list[str]:
    return [text for level, text in node.logger.lines if level == "warning"]


def test_scans_are_fused_with_past_scans_as_by_predict_on_a_bag(
    start: Start, weights: Path, tmp_path: Path, drive: Drive
) -> None:
    sent = [*drive_odometry(DRIVE_SCANS), *bag_poses.drive_clouds(DRIVE_SCANS)]
    bag = write_bag(tmp_path / "bag", sent)
    options = "--drive --past-only --poses /odom --format npy"
    for name, value in SENSOR.items():
        options += f" --{name.replace('_', '-')} {value}"
    succeed(f"predict {bag} --weights {weights} --out {tmp_path / 'out'} {options}")

    node = fusing(start, drive)
    for number, labels in enumerate(label_all(node, drive.messages)):
        np.testing.assert_array_equal(labels, np.load(tmp_path / f"out/bag/{number:06d}.npy"))
    assert not warnings_of(node)
    alone_labels = alone(start, drive.messages)
    assert any((a != b).any() for a, b in zip(labels_of(node), alone_labels, strict=True))


@pytest.mark.parametrize(("unit", "factor"), [("mm", 1000), ("ft", 1 / 0.3048)])
def test_scans_in_another_unit_are_fused_as_those_in_metres(
    start: Start, drive: Drive, unit: str, factor: float
) -> None:
    scale = np.array([factor, factor, factor, 1], np.float32)
    messages = [
        as_rclpy_gives_it(cloud(FIRST + PERIOD * index, points * scale).make(STORE))
        for index, (points, _) in enumerate(drive_scans(DRIVE_SCANS))
    ]
    found = []
    for sent, stated in ((messages, unit), (drive.messages, "m")):
        found.append(np.concatenate(label_all(fusing(start, drive, unit=stated), sent)))
    assert np.mean(found[0] == found[1]) > 0.99
    alone_labels = np.concatenate(alone(start, drive.messages))
    assert np.mean(found[0] == alone_labels) < 0.9


def test_odometry_that_comes_while_a_scan_is_labelled_counts(
    start: Start, drive: Drive, monkeypatch: pytest.MonkeyPatch
) -> None:
    expected = label_all(fusing(start, drive), drive.messages[:3])

    node = start(odom_frame="odom", **SENSOR)
    score = TorchEngine.score

    def odometry_and_score(*arguments: Any) -> Any:
        node._frames.poses |= drive.poses
        return score(*arguments)

    monkeypatch.setattr(TorchEngine, "score", odometry_and_score)
    np.testing.assert_array_equal(label_all(node, drive.messages[:3]), expected)
    assert not warnings_of(node)


def test_without_odometry_scans_are_labelled_alone_with_a_warning(
    start: Start, drive: Drive
) -> None:
    messages = drive.messages[:3]
    expected = alone(start, messages)
    node = start(odom_frame="odom", **SENSOR)
    np.testing.assert_array_equal(label_all(node, messages), expected)
    assert len(warnings_of(node)) == 3  # rclpy throttles them
    assert "extrapolation" in warnings_of(node)[0]

    node = fusing(start, drive, odom_frame="map")  # tf does not know it
    np.testing.assert_array_equal(label_all(node, messages), expected)
    assert not any("\n" in line for line in warnings_of(node))

    node = start(odom_frame="odom", **SENSOR)
    broken = SimpleNamespace(x=np.nan, y=0.0, z=0.0, w=1.0)
    transform = SimpleNamespace(translation=broken, rotation=broken)
    node._frames.lookup_transform = lambda *_, **__: SimpleNamespace(transform=transform)
    np.testing.assert_array_equal(label_all(node, messages), expected)
    assert "quaternions" in warnings_of(node)[0]


def test_a_scan_without_odometry_stops_nothing(start: Start, drive: Drive) -> None:
    """The scans around it are fused as if it were not there."""
    node = fusing(start, drive)
    first, lost, last = drive.messages[:3]
    expected = label_all(node, [first, last])

    node = fusing(start, drive)
    send(node, first)
    node._frames.frames = ("odom", "elsewhere")
    send(node, lost)
    node._frames.frames = ("odom", "lidar")
    send(node, last)
    np.testing.assert_array_equal(labels_of(node)[::2], expected)


def test_a_bag_played_twice_has_the_same_labels(start: Start, drive: Drive) -> None:
    node = fusing(start, drive)
    first = label_all(node, drive.messages[:4])
    send(node, drive.messages[0])  # its odometry is not there yet
    assert len(warnings_of(node)) == 1
    node._frames.poses |= drive.poses
    np.testing.assert_array_equal(labels_of(node)[4], alone(start, drive.messages[:1])[0])
    again = label_all(node, drive.messages[1:4])[5:]

    np.testing.assert_array_equal(again, label_all(fusing(start, drive), drive.messages[1:4]))
    assert len(first) == 4


def test_odometry_that_jumps_starts_anew(
    start: Start, drive: Drive, monkeypatch: pytest.MonkeyPatch
) -> None:
    # The jump shows only after the networks have seen the scan, turned or not.
    monkeypatch.setattr("amvnet.inference.drive.TURN", 0.0)
    expected = label_all(fusing(start, drive), drive.messages[2:4])

    node = start(odom_frame="odom", **SENSOR)
    moved = np.eye(4)
    moved[1, 3] = 10  # within reach of the same walls
    node._frames.poses |= {time: moved @ pose for time, pose in drive.poses.items()}
    label_all(node, drive.messages[:2])
    node._frames.poses |= drive.poses
    np.testing.assert_array_equal(label_all(node, drive.messages[2:4])[2:], expected)


def test_only_scans_in_reach_are_in_memory() -> None:
    def scans_in_memory() -> int:
        return sum(type(item) is _Seen for item in gc.get_objects())

    before = scans_in_memory()
    rng = np.random.default_rng(0)
    fuse = PastFusion(lambda origin, is_back: np.eye(4))
    for stamp in range(3 * REACH):
        scores = rng.dirichlet(np.ones(4), 50).astype(np.float32)
        result = Segmentation(np.ones(50, np.uint8), np.zeros(50, bool), scores)
        fuse(Message(stamp, "lidar"), Scan(rng.normal(0, 5, (50, 4)).astype(np.float32)), result)
    assert scans_in_memory() <= before + REACH + 2


def test_importing_the_node_does_not_import_torch() -> None:
    """Then `main` can still set the environment that OpenMP reads."""
    code = (
        "import sys, pytest; from fixtures.ros import install\n"
        "monkeypatch = pytest.MonkeyPatch(); install(monkeypatch)\n"
        "assert 'torch' not in sys.modules"
    )
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
    subprocess.run([sys.executable, "-c", code], check=True, env=environment)
