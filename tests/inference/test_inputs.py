"""The scans of any inputs are listed, read once, and normalised by what their own sensor shows."""

from __future__ import annotations

import warnings
from collections import Counter
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import amvnet
from amvnet.data.datasets.open import open_dataset
from amvnet.data.datasets.own import OwnScans
from amvnet.data.formats import detect, find
from amvnet.data.formats.cloud import Cloud
from amvnet.data.formats.detect import ending_of
from amvnet.data.formats.registry import read_file
from amvnet.data.formats.rows import parse_layout
from amvnet.data.recordings import Recording
from amvnet.inference.journal import Entry
from amvnet.inference.listing import find_inputs
from amvnet.inference.predict import ADVICE, report_certainty
from amvnet.scan import Scan
from amvnet.sensors import normalise
from amvnet.sensors.intensity import PROBABILITIES, TrainedIntensity
from amvnet.sensors.lidars import Sensor
from amvnet.sensors.measure import MEASURED_SCANS
from amvnet.sensors.normalise import Normaliser
from amvnet.sensors.reading import array_cloud, array_scan
from amvnet.viewing.shown_scans import show_scans
from amvnet.weights.file import Weights, save

from fixtures.commands import fails, files, refused, run_cli, succeed
from fixtures.datasets import make_semantickitti
from fixtures.marks import with_quick
from fixtures.sensors import LASERS, place
from fixtures.tiny import fresh_weights, street


def weights_for(sensor: str = "hdl64e") -> Weights:
    return replace(fresh_weights(), sensor=sensor)


def write(folder: Path, name: str, sensor: str, height: float, seed: int = 0) -> Path:
    folder.mkdir(exist_ok=True)
    points, _ = place(LASERS[sensor], height, seed=seed)
    path = folder / f"{name}.npy"
    np.save(path, points)
    return path


def normalised(folder: Path) -> tuple[dict[str, Scan], dict[str, str], list[str]]:
    """Return the normalised scans of a folder, the titles of their sensors, and what was said."""
    lines: list[str] = []
    inputs, _ = find_inputs([str(folder)]).scans(
        normaliser=Normaliser(weights_for().expects, report=lines.append)
    )
    scans = {scan.name: scan.load() for scan in inputs}
    return scans, {scan.name: scan.recording.name for scan in inputs}, lines


# ---- two sensors in one folder


@pytest.mark.parametrize(
    ("first", "second"),
    with_quick([("vlp16", "os1-64"), ("os1-64", "hdl32e")], [("vlp16", "os1-64")]),
)
def test_if_first_scans_differ_each_is_measured(tmp_path: Path, first: str, second: str) -> None:
    for seed in range(MEASURED_SCANS + 1):
        sensor, height = (first, 0.9) if seed < 3 else (second, 1.3)
        write(tmp_path / "both", f"s{seed}", sensor, height, seed)
        write(tmp_path / f"s{seed}", f"s{seed}", sensor, height, seed)

    scans, _, lines = normalised(tmp_path / "both")
    for name, scan in scans.items():
        expected = normalised(tmp_path / name)[0][name]
        np.testing.assert_array_equal(scan.points, expected.points)
        np.testing.assert_array_equal(scan.ring, expected.ring)
    assert len(lines) == 2  # one of each sensor
    for line in lines:
        assert "has scans of other sensors, so that each is measured alone" in line
        assert "assumed intensity 0 to 1, sensor " in line


def test_a_later_scan_of_another_sensor_is_measured_alone_and_told(tmp_path: Path) -> None:
    for seed in range(MEASURED_SCANS + 2):
        write(tmp_path / "both", f"a{seed}", "os1-64", 1.0, seed)
    write(tmp_path / "both", "b", "vlp16", 2.5)
    write(tmp_path / "alone", "b", "vlp16", 2.5)

    scans, _, lines = normalised(tmp_path / "both")
    np.testing.assert_array_equal(scans["b"].points, normalised(tmp_path / "alone")[0]["b"].points)
    assert len(lines) == 2
    assert "another sensor" in lines[1]


def test_a_sensor_in_the_yaml_file_counts_unless_the_command_describes_one(tmp_path: Path) -> None:
    write(tmp_path / "scans", "a", "vlp16", 1.2)
    path = tmp_path / "own.yaml"
    path.write_text('classes: {a: 1, b: 2}\nscans: "scans/*"\nsensor: {height: 1.5}\n')

    for described, expected in ((Sensor(), 1.5), (Sensor(height=2.0), 2.0)):
        dataset = normalise.normalised(
            open_dataset(str(path)), Normaliser(weights_for().expects, described)
        )
        assert isinstance(dataset, OwnScans)
        assert isinstance(dataset.normalise, Normaliser)
        assert dataset.normalise.sensor.height == expected


def test_a_sensor_that_misses_points_is_still_the_same_one(tmp_path: Path) -> None:
    """Not even half of the points, as in a tunnel or in rain, make another sensor."""
    for seed in range(MEASURED_SCANS + 3):
        path = write(tmp_path / "drive", str(seed), "os1-64", 1.0, seed)
        points = np.load(path)
        is_lost = np.random.default_rng(seed).random(len(points)) < 0.6
        np.save(path, points[~is_lost] if seed > MEASURED_SCANS else points)

    _, titles, lines = normalised(tmp_path / "drive")
    assert len(set(titles.values())) == 1
    assert len(lines) == 1


# ---- how sure the labels are


def said(entries: list[Entry], usual: float = 0.1) -> list[str]:
    lines: list[str] = []
    report_certainty(entries, "amvnet", usual, lines.append)
    return lines


def entry(sensor: str, share: float, points: int = 1000) -> Entry:
    return Entry(sensor, "", sensor, points, round(share * points), [])


def test_each_recording_is_judged_by_its_own_share() -> None:
    """A good drive does not hide the other sensor in it, nor a bag that is tilted."""
    good = entry("drive", 0.1, 10_000)
    assert said([good, good]) == ["10.0% of the points are uncertain (usual: 10.0%)"]

    lines = said([good, entry("drive, another sensor", 0.8), entry("a.bag", 0.9), good])
    assert lines[0].startswith("16.8%")
    assert "warning: drive, another sensor: do not rely on these labels: 80.0%" in lines[1]
    assert "warning: a.bag: do not rely on these labels: 90.0%" in lines[2]
    assert lines[3] == f"warning: {ADVICE}"
    assert len(lines) == 4


def test_a_doubtful_scan_is_named_and_not_the_mean_of_its_folder() -> None:
    def of_folder(name: str, share: float, points: int = 1000) -> Entry:
        return Entry(f"{name}.npz", "", "folder", points, round(share * points), [])

    for points in (100, 9000):  # the mean is doubtful with the second one
        lines = said([of_folder("good", 0.1), of_folder("bad", 0.9, points)])
        assert "warning: bad: do not rely on these labels: 90.0%" in lines[1]
        assert lines[2:] == [f"warning: {ADVICE}"]


def test_one_doubtful_recording_is_one_line() -> None:
    (line,) = said([entry("drive", 0.8)])
    assert line.startswith("warning: do not rely")
    assert line.endswith(ADVICE)
    assert said([]) == said([Entry("drive", "", "drive", 0, 0, [])]) == []


def test_many_doubtful_recordings_are_few_lines() -> None:
    lines = said([entry(str(index), 0.9) for index in range(50)])
    assert len(lines) == 12
    assert "40 more" in lines[-1]
    lines = said([entry(str(index), 0.9) for index in range(10)])
    assert lines[-1] == f"warning: {ADVICE}"


def test_recordings_of_a_run_are_judged_on_the_command_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The scans of one folder are those of the training, the others stand on their side."""
    weights = weights_for()
    points = {"level": street(0)[0], "side": street(0)[0][:, [1, 2, 0, 3]]}
    shares = {}
    for name, table in points.items():
        (tmp_path / name).mkdir()
        table.tofile(tmp_path / name / f"{name}.bin")
        cloud = Cloud(table[:, :3], table[:, 3], name=name)
        result = amvnet.load(weights)(Normaliser(weights.expects)(Recording(name)).to_scan(cloud))
        shares[name] = f"{result.uncertain.mean():.1%}"

    path = save(weights, tmp_path / "w.safetensors")
    inputs = f"{tmp_path}/level {tmp_path}/side"
    succeed(f"predict {inputs} --weights {path} --out {tmp_path}/out")
    lines = capsys.readouterr().out.splitlines()
    for name, share in shares.items():
        (line,) = [line for line in lines if line.startswith(f"warning: {tmp_path}/{name}/")]
        assert share in line


# ---- listing


def test_a_dead_link_is_a_broken_scan(tmp_path: Path) -> None:
    path = save(weights_for(), tmp_path / "w.safetensors")
    scans = tmp_path / "scans"
    scans.mkdir()
    for name in "ac":
        street(ord(name), 300)[0].tofile(scans / f"{name}.bin")
    (scans / "b.bin").symlink_to(tmp_path / "nothing.bin")

    for inputs in ([scans], sorted(scans.iterdir())):
        out = tmp_path / f"out{len(inputs)}"
        code, error = run_cli("predict", *inputs, "--weights", path, "--out", out)
        assert code == 3
        assert "b.bin: expected a scan file, found a link that leads nowhere" in error
        assert files(out) == {"a.label", "c.label"}

    refused(f"predict {scans}/b.bin --weights {path} --out {tmp_path}/out", "leads nowhere")


def test_each_file_is_read_once_and_its_format_detected_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    counts: Counter[str] = Counter()

    def count(function: Any, name: str) -> Any:
        def counted(path: Path, *arguments: Any) -> Any:
            counts[f"{name} {path.name}"] += 1
            return function(path, *arguments)

        return counted

    monkeypatch.setattr(find, "read_file", count(read_file, "read"))
    monkeypatch.setattr(detect, "ending_of", count(ending_of, "detect"))
    names = [f"{index}.bin" for index in range(MEASURED_SCANS + 2)]
    (tmp_path / "scans").mkdir()
    for index, name in enumerate(names):
        street(index, 300)[0].tofile(tmp_path / "scans" / name)
    path = save(weights_for(), tmp_path / "w.safetensors")
    succeed(f"predict {tmp_path}/scans --weights {path} --out {tmp_path}/out")
    succeed(f"predict {tmp_path}/scans/0.bin --weights {path} --out {tmp_path}/one")

    for name in names:
        times = 2 if name == "0.bin" else 1  # 0.bin is in both runs
        assert (counts[f"read {name}"], counts[f"detect {name}"]) == (times, times)


# ---- rows


def test_every_command_labels_a_normalised_scan_by_its_rows(tmp_path: Path) -> None:
    """Of every fourth laser, rows by elevation or by ring give other labels."""
    weights = weights_for()
    segmenter = amvnet.load(weights)
    points, laser = place(LASERS["os1-64"], 1.0)
    points = points[laser % 4 == 0]
    np.save(tmp_path / "a.npy", points)

    cloud = Cloud(points[:, :3], points[:, 3], name="a")
    scan = Normaliser(weights.expects)(Recording("a")).to_scan(cloud)
    expected = segmenter(scan).labels
    assert np.mean(segmenter(replace(scan, row=None)).labels != expected) > 0.02

    path = save(weights, tmp_path / "w.safetensors")
    succeed(f"predict {tmp_path}/a.npy --weights {path} --out {tmp_path}")
    raw = np.fromfile(tmp_path / "a.label", np.uint32)
    np.testing.assert_array_equal(raw, weights.taxonomy.to_raw(expected))

    scans, _ = find_inputs([f"{tmp_path}/a.npy"]).scans(normaliser=Normaliser(weights.expects))
    (shown,) = show_scans(scans, segmenter)
    np.testing.assert_array_equal(shown.labels["amvnet"], expected)
    np.testing.assert_array_equal(segmenter(tmp_path / "a.npy").labels, expected)


# ---- arrays

POINTS = np.clip(street(5, 400)[0], [-99, -99, -99, 0], [99, 99, 99, 1]).astype(np.float32)
RING = np.arange(len(POINTS)) % 32
TRAINED = TrainedIntensity(tuple(np.linspace(0.1, 0.9, len(PROBABILITIES)).tolist()))


@pytest.mark.parametrize(
    ("array", "columns"),
    [
        (POINTS.astype(np.float64), None),
        (np.column_stack([POINTS, RING]), None),
        (np.column_stack([POINTS, np.linspace(0, 0.1, len(POINTS)), RING]), None),
        (np.column_stack([RING, POINTS]), "ring,x,y,z,intensity"),
        (POINTS[:, [3, 2, 1, 0]], "intensity,z,y,x"),
    ],
)
def test_an_array_is_taken_with_any_columns(array: np.ndarray, columns: str | None) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        scan = array_scan(array_cloud(array, parse_layout(columns)))
    np.testing.assert_array_equal(scan.points, POINTS)
    has_ring = array.shape[1] == 5
    np.testing.assert_array_equal(scan.ring, RING if has_ring else None)

    expected = amvnet.load(weights_for())(POINTS).labels
    labels = amvnet.load(weights_for())(array, columns=columns).labels
    np.testing.assert_array_equal(labels, expected)


def test_an_array_without_intensity_gets_those_that_the_weights_need_and_a_warning() -> None:
    with pytest.warns(UserWarning, match="no intensity: drawn at random"):
        scan = array_scan(array_cloud(POINTS[:, :3]), TRAINED)
    np.testing.assert_array_equal(scan.points[:, :3], POINTS[:, :3])
    np.testing.assert_array_equal(scan.points[:, 3], TRAINED.filler(len(POINTS)))

    with pytest.warns(UserWarning, match="no intensity"):
        labels = amvnet.load(weights_for())(POINTS[:, :3]).labels
    assert labels.all()


@pytest.mark.parametrize(
    ("array", "columns", "word"),
    [
        (POINTS.T, None, "transpose"),
        (POINTS[:, :2], None, "(N, 3 or more)"),
        (POINTS[None], None, "(N, 3 or more)"),
        (POINTS[:, 0], None, "(N, 3 or more)"),
        (POINTS, "x,y,intensity", "x, y and z"),
        (POINTS, "x,y,z,intensity,ring", "5 columns"),
    ],
)
def test_arrays_of_other_shapes_fail(array: np.ndarray, columns: str | None, word: str) -> None:
    fails(lambda: array_cloud(array, parse_layout(columns)), "expected", word)


def test_inputs_of_different_classes_are_refused(tmp_path: Path) -> None:
    kitti = make_semantickitti(tmp_path / "kitti").spec
    scan = tmp_path / "scan.pcd.bin"  # the ending of nuScenes
    np.zeros((9, 5), np.float32).tofile(scan)
    fails(lambda: find_inputs([kitti, str(scan)]).scans(), "the same classes")


def test_a_scan_that_was_read_and_moved_has_the_points_that_it_was_moved_to(tmp_path: Path) -> None:
    street(0)[0].tofile(tmp_path / "a.bin")
    scan = amvnet.read(tmp_path / "a.bin")
    moved = replace(scan, points=scan.points[::2] + np.array([1, 0, 0, 0], np.float32), ring=None)
    np.testing.assert_array_equal(amvnet.load(weights_for())(moved).points, moved.points[:, :3])


def test_a_scan_that_is_read_again_is_the_file_as_it_is_then(tmp_path: Path) -> None:
    """A scan that was kept since its sensor was measured is kept no longer than that."""
    path = write(tmp_path, "a", "os1-64", 1.7)
    (scan,), _ = find_inputs([str(path)]).scans(normaliser=Normaliser(weights_for().expects))
    assert len(scan.load()) > 100
    np.save(path, np.load(path)[:100])
    assert len(scan.load()) == 100
