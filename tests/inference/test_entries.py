"""The same scan gets the same labels by every entry, however odd it is."""

from __future__ import annotations

import json
import shlex
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from rosbags.typesys import Stores, get_typestore

import amvnet
from amvnet import onnx_runner
from amvnet.cli.commands.export import calibration_scans
from amvnet.config.schema import RangeViewConfig
from amvnet.data.check import check_scans
from amvnet.data.datasets.open import open_dataset
from amvnet.data.datasets.training_data import Source, TrainingData
from amvnet.data.taxonomy import NUSCENES, SEMANTICKITTI
from amvnet.engines.export.onnx import describe_export, export
from amvnet.errors import InputError
from amvnet.evaluation.scoring import label_by_weights
from amvnet.inference.fuse import Fusion
from amvnet.inference.listing import find_inputs
from amvnet.inference.request import LabellingRequest
from amvnet.inference.segmenter import Segmenter
from amvnet.models.amvnet import LateFusion
from amvnet.models.views.points import PointBatch
from amvnet.models.views.range_view import RangeView
from amvnet.onnx_runner import OnnxSegmenter
from amvnet.scan import Scan, turned
from amvnet.sensors.expectation import Expectation
from amvnet.sensors.intensity import PROBABILITIES, TrainedIntensity
from amvnet.sensors.lasers import lasers_by_order
from amvnet.sensors.lidars import Sensor, rotation_from_degrees
from amvnet.sensors.normalise import Normaliser, normalised
from amvnet.training.loaders import ScanSet, collate
from amvnet.viewing.shown_scans import show_scans
from amvnet.weights.file import save
from amvnet_ros.segmentation import CloudSegmenter, Settings

from fixtures.commands import fails, run_cli, succeed
from fixtures.datasets import make_nuscenes
from fixtures.marks import with_full, with_quick
from fixtures.scan_writers import cloud_message
from fixtures.sensors import LASERS, is_on_nuscenes_car, on_nuscenes_car, place
from fixtures.tiny import fresh_weights, street, without, write_scan

try:
    import pyarrow as pa
except ImportError:  # it is not among the packages of `make test`
    pa = None

WEIGHTS = fresh_weights()
OWN = """\
classes: {classes}
scans: "*.npy"
labels: "{{name}}.label"
"""
FIELDS = np.dtype([(name, "f4") for name in ("x", "y", "z", "intensity", "ring")])


def plain() -> np.ndarray:
    """Return a scan whose intensities reach from 0 to 1, as files' are divided by the largest."""
    points, _ = street(5, 1500)
    points[:, 3] = np.clip(points[:, 3], 0, 1)
    points[0, 3] = 1
    return points


def with_rows(*rows: list[float]) -> np.ndarray:
    """Return the scan with other rows first, last and in between."""
    table = np.array(rows, np.float32)
    return np.insert(plain(), np.linspace(0, len(plain()), len(rows)).astype(int), table, axis=0)


def with_intensity(value: float, index: int = 700) -> np.ndarray:
    points = plain()
    points[index, 3] = value
    return points


def without_intensities(share: float) -> np.ndarray:
    """Return the scan with NaN in the place of some intensities."""
    points = plain()
    points[np.random.default_rng(0).random(len(points)) < share, 3] = np.nan
    return points


DARK = [0.0, 0.0, 0.0, -1.0]
BRIGHT = [0.0, 0.0, 0.0, 65535.0]
LOST: dict[str, list[float]] = {
    "at the origin": [0, 0, 0, 0.5],
    "at the origin, with a sign": [-0.0, 0, -0.0, 0],
    "not a number": [np.nan, np.nan, np.nan, 0],
    "infinite": [np.inf, -np.inf, np.inf, 0],
    "infinite in one coordinate": [3, np.inf, 1, 0.5],
    "far away": [1e20, 1, 1, 0.5],
}
SCANS: dict[str, Callable[[], np.ndarray]] = {
    "plain": plain,
    "all kinds of lost returns": lambda: with_rows(*LOST.values()),
    "a third of lost returns": lambda: with_rows(*[LOST["at the origin"]] * 750),
    "lost returns of intensity -1": lambda: with_rows(*[DARK] * 40),
    "lost returns of a huge intensity": lambda: with_rows(*[BRIGHT] * 300),
    "an intensity a little too large": lambda: with_intensity(1.0001),
    "an intensity a little too small": lambda: with_intensity(-0.0001),
    "an infinite intensity": lambda: with_intensity(np.inf),
    "a tenth of the intensities missing": lambda: without_intensities(0.1),
    "nearly all intensities missing": lambda: without_intensities(0.999),
    "on an axis": lambda: with_rows([0, 0, -1.7, 0.5], [0, 5, 0, 0.5], [5, 0, 0, 0.5]),
    "without intensities": lambda: plain()[:, :3],
    "in double precision": lambda: plain().astype(np.float64),
}


@dataclass(frozen=True)
class World:
    """A folder of its own for the files of a scan, and what labels them."""

    folder: Path
    weights: Path
    keep_own: bool = False

    @cached_property
    def segmenter(self) -> Segmenter:
        return amvnet.load(self.weights, keep_own=self.keep_own)

    @property
    def normaliser(self) -> Normaliser:
        return Normaliser(self.segmenter.weights.expects, Sensor(keep_own=self.keep_own))

    @property
    def options(self) -> str:
        return f"--weights {self.weights} --overwrite" + " --keep-own" * self.keep_own

    def write(self, points: np.ndarray) -> Path:
        path = self.folder / "scan.npy"
        np.save(path, points)
        return path

    def write_kitti(self, points: np.ndarray) -> Path:
        root = self.folder / "kitti"
        return write_scan(root, "08", "000000", points[:, :4], np.zeros(len(points))).parents[3]

    def write_own(self, points: np.ndarray) -> Path:
        path = self.folder / "own" / "own.yaml"
        path.parent.mkdir(exist_ok=True)
        np.save(path.with_name("scan.npy"), points)
        np.zeros(len(points), np.uint32).tofile(path.with_name("scan.label"))
        classes = {name: index for index, name in enumerate(SEMANTICKITTI.classes, start=1)}
        path.write_text(OWN.format(classes=classes))
        return path

    def read(self, path: Path) -> np.ndarray:
        return SEMANTICKITTI.to_train(np.fromfile(path, np.uint32))


# By what the user gives: points in memory, the path of a scan, or a dataset.


def by_tensor(world: World, points: np.ndarray) -> np.ndarray:
    return world.segmenter(torch.from_numpy(points)).labels


def by_list(world: World, points: np.ndarray) -> np.ndarray:
    return world.segmenter(points.tolist()).labels


def by_fields(world: World, points: np.ndarray) -> np.ndarray:
    """Label the array that ROS' read_points returns."""
    table = np.zeros(len(points), FIELDS)
    for name, values in zip(FIELDS.names or (), points.T, strict=False):
        table[name] = values
    return world.segmenter(table[list(FIELDS.names or ())[: points.shape[1]]]).labels


def by_scan(world: World, points: np.ndarray) -> np.ndarray:
    return world.segmenter(scan_of(points)).labels


def scan_of(points: np.ndarray) -> Scan:
    """Return the scan of points (N, 3 to 5)."""
    table = np.zeros((len(points), 4), np.float32)
    table[:, : points.shape[1]] = points[:, :4]
    return Scan(table, ring=points[:, 4].astype(np.int64) if points.shape[1] == 5 else None)


def by_many(world: World, points: np.ndarray) -> np.ndarray:
    return world.segmenter.many([plain(), points])[1].labels


def by_path(world: World, points: np.ndarray) -> np.ndarray:
    return world.segmenter(world.write(points)).labels


def by_each(world: World, points: np.ndarray) -> np.ndarray:
    (result,) = world.segmenter.each(world.write(points))
    return result.labels


def by_predict(world: World, points: np.ndarray) -> np.ndarray:
    out = world.folder / "out"
    run(f"predict {world.write(points)} --out {out} {world.options}")
    return world.read(out / "scan.label")


def run(command: str) -> None:
    """Run a command; raise InputError with its lines on stderr if it fails."""
    code, error = run_cli(*shlex.split(command))
    if code:
        raise InputError(error)
    assert not error


def by_view(world: World, points: np.ndarray) -> np.ndarray:
    scans, _ = find_inputs([str(world.write(points))]).scans(normaliser=world.normaliser)
    (shown,) = show_scans(scans, world.segmenter)
    return shown.labels["amvnet"]


def by_evaluate(world: World, points: np.ndarray) -> np.ndarray:
    dataset = open_dataset(str(world.write_own(points)))
    return _evaluated(world, normalised(dataset, Normaliser(world.segmenter.weights.expects)))


def by_node(world: World, points: np.ndarray) -> np.ndarray:
    """Label a message as the ROS node does."""
    message = cloud_message(get_typestore(Stores.ROS2_HUMBLE), scan_of(points).points)
    settings = Settings(weights=str(world.weights), keep_own=world.keep_own)
    label = CloudSegmenter(settings, "/lidar", lambda line: None)
    return SEMANTICKITTI.to_train(label(message).points.raw)


def by_fleet(world: World, points: np.ndarray) -> np.ndarray:
    """Label a file as a worker of a fleet does."""
    from amvnet.fleet.labelling import LabelScans

    out = world.folder / "fleet"
    request = LabellingRequest(world.segmenter.weights)
    table = pa.table({"path": [str(world.write(points))]})
    (row,) = LabelScans(request, str(out))(table).to_pylist()
    if row["error"]:
        raise InputError(row["error"])
    return world.read(out / "scan.label")


def by_predict_of_a_dataset(world: World, points: np.ndarray) -> np.ndarray:
    data = world.write_kitti(points)
    out = world.folder / "dataset"
    run(f"predict {data} --weights {world.weights} --out {out} --overwrite")
    return world.read(out / "sequences" / "08" / "predictions" / "000000.label")


def by_evaluate_of_a_dataset(world: World, points: np.ndarray) -> np.ndarray:
    return _evaluated(world, open_dataset(str(world.write_kitti(points)), SEMANTICKITTI))


def _evaluated(world: World, dataset: Any) -> np.ndarray:
    labeller = label_by_weights(world.segmenter)
    (record,) = dataset.records(dataset.sequences("all"))
    labels, *_ = labeller.label(record, dataset.read(record))
    return labels["amvnet"]


IN_MEMORY = (by_tensor, by_list, by_fields, by_scan, by_many)
OF_FILES = [by_path, by_each, by_predict, by_view, by_evaluate, by_node]
if pa is not None:
    OF_FILES.append(by_fleet)
OF_DATASETS = (by_predict_of_a_dataset, by_evaluate_of_a_dataset)


@pytest.fixture(scope="module")
def saved(tmp_path_factory: pytest.TempPathFactory) -> World:
    folder = tmp_path_factory.mktemp("entries")
    return World(folder, save(WEIGHTS, folder / "tiny.safetensors"))


@pytest.fixture(scope="module")
def runner(tmp_path_factory: pytest.TempPathFactory, graphs_converted_once: None) -> OnnxSegmenter:
    """One network as a graph, which is enough: all graphs get the same points."""
    for library in ("onnx", "onnxscript", "onnxruntime"):
        pytest.importorskip(library)
    folder = tmp_path_factory.mktemp("graphs")
    export(without(WEIGHTS, "polar_net", "point_head"), folder)
    return OnnxSegmenter(folder)


@contextmanager
def no_warnings() -> Iterator[None]:
    """Ignore that an array has no intensities."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        yield


QUICK = ("plain", "all kinds of lost returns", "without intensities")


@pytest.mark.parametrize("name", with_quick(SCANS, QUICK))
def test_every_entry_gives_a_scan_the_same_labels(saved: World, name: str) -> None:
    points = SCANS[name]()
    with no_warnings():
        expected = saved.segmenter(points).labels
    lost = expected == 0
    np.testing.assert_array_equal(lost, is_lost(points))

    entries = [*IN_MEMORY, *OF_FILES]
    if points.shape[1] == 4:
        entries += OF_DATASETS
    for entry in entries:
        with no_warnings():
            labels = entry(saved, points)
        np.testing.assert_array_equal(labels == 0, lost, entry.__name__)
        # Batches and other orders of sums may round otherwise.
        assert (labels == expected).mean() > 0.995, entry.__name__


@pytest.mark.full
def test_a_million_points_get_the_labels_of_every_entry(saved: World) -> None:
    points = np.resize(plain(), (1_000_001, 4))
    points[:, :3] += np.random.default_rng(0).normal(0, 0.02, (len(points), 3))
    expected = saved.segmenter(points).labels
    assert expected.all()
    for entry in (by_predict, by_view):
        assert (entry(saved, points) == expected).mean() > 0.995, entry.__name__


def is_lost(points: np.ndarray) -> np.ndarray:
    """Return which points of a scan are lost returns."""
    xyz = points[:, :3].astype(np.float32)
    lost = ~np.isfinite(xyz).all(axis=1) | (xyz == 0).all(axis=1)
    return lost | (np.abs(xyz) > 1e4).any(axis=1)


@pytest.mark.full
@pytest.mark.parametrize("name", [name for name in SCANS if name != "without intensities"])
def test_the_onnx_runner_gives_a_scan_the_same_labels(runner: OnnxSegmenter, name: str) -> None:
    points = SCANS[name]()
    with no_warnings():
        labels = runner(points).labels
        expected = amvnet.load(WEIGHTS, method="rv")(points).labels
    np.testing.assert_array_equal(labels == 0, is_lost(points))
    assert (labels == expected).mean() > 0.995


@pytest.mark.parametrize("keep_own", [False, True])
def test_every_entry_labels_the_own_car_only_if_told_to(by_laser: World, keep_own: bool) -> None:
    points, laser = on_nuscenes_car()
    points[0, 3] = 1
    points = np.column_stack([points, laser])
    own = np.array(list(map(is_on_nuscenes_car, points)))
    world = World(by_laser.folder, by_laser.weights, keep_own)
    entries = [by_tensor, by_list, by_fields, by_many, by_path, by_each, by_predict, by_view]
    for entry in (*entries, by_node, labels_of_runner, *([] if keep_own else [by_evaluate])):
        with no_warnings():
            labels = entry(world, points)
        np.testing.assert_array_equal(labels == 0, own & ~keep_own, entry.__name__)


@pytest.mark.parametrize("keep_own", [False, True])
def test_what_is_official_of_nuscenes_labels_the_own_car(tmp_path: Path, keep_own: bool) -> None:
    """Its server wants a class for each point, and some of its labels call this body a car."""
    layout = make_nuscenes(tmp_path / "data")
    points, laser = on_nuscenes_car()
    own = np.array(list(map(is_on_nuscenes_car, points)))
    np.column_stack([points * [1, 1, 1, 255], laser]).astype(np.float32).tofile(layout.first_points)
    np.full(len(points), 1, np.uint8).tofile(layout.first_labels)
    weights = fresh_weights(NUSCENES)
    segmenter = amvnet.load(weights, keep_own=keep_own)

    dataset = open_dataset(layout.spec)
    record, _ = dataset.records([layout.sequences[0]])
    assert label_by_weights(segmenter).label(record, dataset.read(record)).ids["rv"].all()
    (result,) = [each for each in segmenter.each(layout.spec) if len(each) == len(points)]
    np.testing.assert_array_equal(result.labels == 0, own & ~keep_own)

    save(weights, tmp_path / "tiny.safetensors")
    succeed(
        f"predict {layout.spec} --sequences {layout.sequences[0]} --out {tmp_path / 'out'} "
        f"--weights {tmp_path / 'tiny.safetensors'}"
    )
    assert np.fromfile(tmp_path / "out" / record.prediction, np.uint8).all()


# What the networks get: weights whose rows are lasers, and whose intensities are matched.

LASERS_VIEW = RangeViewConfig(rows="laser", height=16, width=64)  # rows by elevation differ
QUANTILES = tuple((np.linspace(0, 1, len(PROBABILITIES)) ** 3).tolist())
EXPECTS = Expectation(
    sensor=Sensor(beams=16, fov_up=15.0, fov_down=-15.0, height=1.73),
    intensity=TrainedIntensity(QUANTILES, is_optional=True, is_matched=True),
    as_is=True,
)
BY_LASER = replace(WEIGHTS, model=replace(WEIGHTS.model, range_view=LASERS_VIEW), expects=EXPECTS)
Seen = tuple[np.ndarray, np.ndarray]  # the valid points (P, 4) of a scan, and their rows (P,)


def in_order() -> np.ndarray:
    """Return a scan without rings, in the order of KITTI's files: laser by laser."""
    points, laser = place(LASERS["vlp16"], 1.73)
    turn = np.mod(np.arctan2(points[:, 1], points[:, 0]), 2 * np.pi)
    return points[np.lexsort([turn, -laser])]


def with_lost(*row: float, every: int = 50) -> np.ndarray:
    """Return the scan with a row in the place of every fiftieth point."""
    points = in_order()
    points[::every, : len(row)] = row
    return points


def with_brightness(change: Callable[[np.ndarray], Any]) -> np.ndarray:
    points = in_order()
    points[:, 3] = change(points[:, 3])
    return points


def with_rings(order: Callable[[np.ndarray], np.ndarray]) -> np.ndarray:
    """Return the scan with rings, which `order` makes of the right ones."""
    ring = lasers_by_order(in_order(), 16)
    assert ring is not None
    return np.column_stack([in_order(), order(ring)])


def glued() -> np.ndarray:
    """Return two scans in one, as of two sensors."""
    return np.concatenate([in_order(), turned(Scan(in_order()), 1.0).points])


def tilted() -> np.ndarray:
    points = in_order()
    points[:, :3] = points[:, :3] @ rotation_from_degrees(0, 12, 0)
    return points


RNG = np.random.default_rng(0)
PERMUTED = RNG.permutation(16)
OF_8_BITS = ("intensities in [0, 1]", "to 255", "divide")


@dataclass(frozen=True)
class Odd:
    """An odd scan.

    Attributes:
        make: returns its points (N, 3 to 5).
        refused: words of the error of the entries that do not normalise; empty if there is none.
        assumed: words of the line on what the entries of files assume.
        is_changed: whether these entries change what the others take as it is.
    """

    make: Callable[[], np.ndarray]
    refused: tuple[str, ...] = ()
    assumed: str = ""
    is_changed: bool = False


ODD = {
    "in order": Odd(in_order),
    "shuffled": Odd(lambda: np.random.default_rng(0).permutation(in_order())),
    "in reverse": Odd(lambda: in_order()[::-1].copy()),
    "mirrored": Odd(lambda: in_order() * np.array([1, -1, 1, 1], np.float32)),
    "glued": Odd(glued),
    "lost returns at zero": Odd(lambda: with_lost(0, 0, 0)),
    "lost returns elsewhere": Odd(lambda: with_lost(3, 1, 0.5, 0)),
    "coincident": Odd(lambda: with_lost(3, 1, 0.5, every=2)),
    "many points": Odd(lambda: np.tile(in_order(), (20, 1))),
    "missing intensities": Odd(lambda: with_lost(*in_order()[0, :3], np.nan), assumed="median"),
    "dark": Odd(lambda: with_brightness(lambda values: 0.3 * values**3)),
    "a little too bright": Odd(lambda: with_brightness(lambda values: 1.0001 * values)),
    "black": Odd(lambda: with_brightness(np.zeros_like), assumed="intensity 0 everywhere"),
    "8 bits": Odd(
        lambda: with_brightness(lambda values: np.round(values * 255)),
        OF_8_BITS,
        "intensity 0 to 255",
    ),
    "12 bits": Odd(
        lambda: with_brightness(lambda values: np.round(values * 4095)),
        ("intensities in [0, 1]", "to 4095", "divide"),
        "intensity 0 to 65535",
    ),
    "16 bits": Odd(
        lambda: with_brightness(lambda values: np.round(values * 65535)),
        ("intensities in [0, 1]", "to 65535", "divide"),
        "intensity 0 to 65535",
    ),
    "rings": Odd(lambda: with_rings(lambda ring: ring)),
    "reversed rings": Odd(
        lambda: with_rings(lambda ring: 15 - ring), assumed="rings that count from the highest"
    ),
    "permuted rings": Odd(
        lambda: with_rings(lambda ring: PERMUTED[ring]), assumed="rings in another order"
    ),
    "rings by turns": Odd(
        lambda: with_rings(lambda ring: np.arange(len(ring)) % 16), assumed="rings that do not"
    ),
    "tilted": Odd(tilted, assumed="a tilt of 12 degrees", is_changed=True),
    "no point": Odd(lambda: in_order()[:0], ("expected", "points")),
    "1 point": Odd(lambda: in_order()[:1], assumed="everywhere, so none", is_changed=True),
    "2 points": Odd(lambda: in_order()[:2], assumed="no ground"),
    "15 points": Odd(lambda: in_order()[:15], assumed="no ground"),
    "16 points": Odd(lambda: in_order()[:16], assumed="no ground"),
}
WITH_RINGS = ("reversed rings", "permuted rings", "rings by turns")


@contextmanager
def watched() -> Iterator[list[Seen]]:
    """Record the points and rows of the last scan in each batch that the range view gets."""
    seen: list[Seen] = []
    project = RangeView.project
    fuse = LateFusion.fuse
    image = onnx_runner.range_image

    def record(batch: PointBatch) -> None:
        (part,) = batch.slices[-1:]
        rows = RangeView(LASERS_VIEW).rows(batch)
        seen.append((batch.points[part].numpy().copy(), rows[part].numpy().copy()))

    def watch_project(view: RangeView, batch: PointBatch) -> Any:
        record(batch)
        return project(view, batch)

    def watch_fuse(model: LateFusion, batch: PointBatch, *scores: torch.Tensor) -> Any:
        record(batch)
        return fuse(model, batch, *scores)

    def watch_image(view: RangeViewConfig, scan: Scan) -> Any:
        seen.append((scan.points, onnx_runner.image_rows(view, scan)))
        return image(view, scan)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(RangeView, "project", watch_project)
        patch.setattr(LateFusion, "fuse", watch_fuse)
        patch.setattr(onnx_runner, "range_image", watch_image)
        yield seen


def by_fuse(world: World, points: np.ndarray) -> None:
    scores = np.full((len(points), SEMANTICKITTI.size), 1 / SEMANTICKITTI.size)
    Fusion(BY_LASER)(points, scores, scores)


def by_training(world: World, points: np.ndarray) -> None:
    dataset = open_dataset(str(world.write_kitti(points)))
    data = TrainingData([Source(dataset, dataset.records(["08"]))])
    batch, _, _ = collate([ScanSet(data, BY_LASER.expects)[0, 0]])
    RangeView(LASERS_VIEW).project(batch)


def by_check(world: World, points: np.ndarray) -> None:
    dataset = open_dataset(str(world.write_kitti(points)))
    for line in check_scans(dataset, {"train": dataset.records(["08"])}).broken.values():
        raise InputError(line)


def by_calibration(world: World, points: np.ndarray) -> None:
    _calibrate(world.write_kitti(points))


def by_calibration_on_files(world: World, points: np.ndarray) -> None:
    _calibrate(world.write(points))


def _calibrate(path: Path) -> None:
    """Compute the images on which graphs in int8 are calibrated."""
    (scan,) = calibration_scans(str(path), BY_LASER)
    onnx_runner.range_image(LASERS_VIEW, scan.select(scan.valid))


@pytest.fixture(scope="module")
def by_laser(tmp_path_factory: pytest.TempPathFactory) -> World:
    folder = tmp_path_factory.mktemp("by_laser")
    return World(folder, save(BY_LASER, folder / "tiny.safetensors"))


class BlindRunner(OnnxSegmenter):
    """The ONNX runner of an export whose graphs see nothing, so that none has to be exported."""

    def _check_sizes(self, folder: Path, k: int) -> None:
        pass

    def _run(self, name: str, *inputs: np.ndarray) -> np.ndarray:
        _, _, height, width = inputs[0].shape
        return np.zeros((1, SEMANTICKITTI.size, height, width), np.float32)


def by_runner(world: World, points: np.ndarray) -> None:
    labels_of_runner(world, points)


def labels_of_runner(world: World, points: np.ndarray) -> np.ndarray:
    scan = scan_of(points)
    return blind_runner(world)(scan.points, scan.ring).labels


def blind_runner(world: World) -> BlindRunner:
    graphs = {"range_net": {"file": "range_net.onnx", "inputs": []}}
    description = describe_export(BY_LASER, "rv", graphs)
    (world.folder / onnx_runner.DESCRIPTION).write_text(json.dumps(description))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(onnx_runner, "_open_graph", lambda *_: None)
        return BlindRunner(world.folder, keep_own=world.keep_own)


AS_GIVEN = (*IN_MEMORY, *OF_DATASETS, by_runner, by_fuse, by_training, by_calibration)
NORMALISING = (*OF_FILES, by_calibration_on_files)


@dataclass(frozen=True)
class Outcome:
    """What an entry makes of a scan: what the networks get and say, or the reason of an error."""

    error: str = ""
    seen: Seen | None = None
    labels: np.ndarray | None = None

    @classmethod
    def of(cls, entry: Callable[..., Any], world: World, points: np.ndarray) -> Outcome:
        with watched() as seen, no_warnings():
            try:
                labels = entry(world, points)
            except InputError as error:
                return Outcome(str(error))
        return Outcome(seen=seen[-1] if seen else None, labels=labels)

    def check_like(self, expected: Outcome, name: str) -> None:
        """Check that the outcome is the expected one, as far as the entry shows it."""
        assert ("expected" in self.error) == bool(expected.error), (name, self.error)
        if self.seen is not None and expected.seen is not None:
            points, rows = expected.seen
            np.testing.assert_array_equal(self.seen[1], rows, name)
            np.testing.assert_allclose(self.seen[0], points, atol=1e-6, err_msg=name)
        if self.labels is not None and expected.labels is not None:
            assert (self.labels == expected.labels).mean() > 0.995, name


QUICK_ODD = ("shuffled", "lost returns at zero", "reversed rings", "8 bits", "tilted", "1 point")


@pytest.mark.parametrize("name", with_quick(ODD, QUICK_ODD))
def test_every_entry_gives_networks_the_same_points_and_rows(by_laser: World, name: str) -> None:
    """Those that normalise agree, and so do the others; the rings of a scan change nothing."""
    odd = ODD[name]
    points = odd.make()
    given = Outcome.of(by_list, by_laser, points[:, :4])
    file = Outcome.of(by_path, by_laser, points[:, :4])
    for word in odd.refused:
        assert word in given.error
    if not odd.refused and not odd.is_changed:
        file.check_like(given, name)
    if given.seen is not None:
        valid = scan_of(points).valid
        np.testing.assert_array_equal(given.seen[0][:, :3], points[valid, :3])
        if len(points) > 100 and name != "black":
            found = np.quantile(given.seen[0][:, 3], PROBABILITIES)
            np.testing.assert_allclose(found, QUANTILES, atol=0.02)

    for entries, expected in ((AS_GIVEN, given), (NORMALISING, file)):
        for entry in entries:
            outcome = Outcome.of(entry, by_laser, points)
            if entry is by_training and len(points) == 1:
                assert "two valid points" in outcome.error
            else:
                outcome.check_like(expected, entry.__name__)
    checked = Outcome.of(by_check, by_laser, points)
    assert ("points" in checked.error) == (len(points) < 2), checked.error
    if not file.error:
        assert odd.assumed in by_laser.segmenter(by_laser.write(points)).assumed


@pytest.mark.parametrize("kind", ["elevation", "laser", "ring"])
@pytest.mark.parametrize("seed", range(3))
def test_the_runner_takes_the_rows_and_rings_of_torch(kind: Any, seed: int) -> None:
    """Also unknown ones, which are -1, and those of another sensor."""
    view = replace(LASERS_VIEW, rows=kind)
    rng = np.random.default_rng(seed)
    points = plain()[:50]

    def draw(lowest: int, end: int) -> np.ndarray | None:
        return rng.integers(lowest, end, len(points)) if rng.random() < 0.8 else None

    def rows_or_error(rows: Callable[[Scan], Any], scan: Scan) -> Any:
        try:
            return rows(scan).tolist()
        except InputError as error:
            return str(error)

    for _ in range(50):
        lowest, end = rng.choice([-1, 0]), rng.choice([16, 17])
        scan = Scan(points, row=draw(lowest, 16), ring=draw(rng.choice([-1, 0]), end))
        if rng.random() < 0.2:
            scan = replace(scan, row=draw(lowest, end))
        expected = rows_or_error(lambda each: RangeView(view).rows(PointBatch.of([each])), scan)
        assert rows_or_error(partial(onnx_runner.image_rows, view), scan) == expected


@pytest.mark.parametrize("name", WITH_RINGS)
def test_rings_that_are_not_in_order_are_said(by_laser: World, name: str) -> None:
    for entry in (by_list, by_scan, by_runner):
        with pytest.warns(UserWarning, match=f"the scan has {ODD[name].assumed}"):
            entry(by_laser, ODD[name].make())


@pytest.mark.parametrize(("unit", "factor"), [("mm", 1000.0), ("cm", 100.0), ("ft", 1 / 0.3048)])
def test_arrays_in_other_units_need_a_sensor(by_laser: World, unit: str, factor: float) -> None:
    points = in_order()
    scaled = points * np.array([factor, factor, factor, 1])
    for entry in (by_list, by_fields, by_many, by_runner):
        fails(partial(entry, by_laser, scaled), "expected", "give metres", unit)

    expected = by_path(by_laser, points)
    described = amvnet.load(by_laser.weights, sensor={"unit": unit})
    for given in (scaled, by_laser.write(scaled)):
        result = described(given)
        assert (result.labels == expected).mean() > 0.995
        assert result.origin is not None
        assert "over the ground" in result.assumed


@pytest.mark.parametrize(
    "how",
    [
        {"offset": (0.5, -0.25, 1.0)},
        {"axes": "y-forward"},
        {"axes": "z-down", "offset": (2.0, 0.0, -1.0)},
        {"rotate": (90.0, 0.0, 0.0)},
        {"rotate": (0.0, 9.0, 0.0), "offset": (0.0, 0.0, 0.5)},
    ],
)
def test_a_scan_moved_and_moved_back_keeps_its_rows(by_laser: World, how: dict[str, Any]) -> None:
    points = turned(Scan(in_order()), 0.003).points  # so that no point is on the axis
    expected = by_laser.segmenter(by_laser.write(points))
    sensor = Sensor(**how)
    moved = points.astype(np.float64)
    moved[:, :3] = (moved[:, :3] - np.array(sensor.offset or (0, 0, 0))) @ sensor.turn

    described = amvnet.load(by_laser.weights, sensor=how)
    for given in (moved, by_laser.write(moved)):
        result = described(given)
        assert result.origin is not None
        assert expected.origin is not None
        row = expected.origin.scan.row
        assert row is not None
        np.testing.assert_array_equal(result.origin.scan.row, row)
        assert (result.labels == expected.labels).mean() > 0.995


def with_fields(points: np.ndarray) -> np.ndarray:
    """Return an array with fields in the other byte order, as of PCL on a network."""
    kind = np.dtype([(name, ">f4") for name in ("x", "y", "z", "intensity")])
    return points.astype(">f4").view(kind)[:, 0]


ARRAYS: dict[str, Callable[[np.ndarray], Any]] = {
    "half precision": lambda points: points.astype(np.float16),
    "by columns": np.asfortranarray,
    "backwards": lambda points: points[::-1][::-1],
    "read-only": lambda points: np.lib.stride_tricks.as_strided(points, writeable=False),
    "another byte order": lambda points: points.astype(">f8"),
    "named": with_fields,
    "with a gradient": lambda points: torch.from_numpy(points).requires_grad_(),
    "on no device": lambda points: torch.from_numpy(points).to("meta"),
    "sparse": lambda points: torch.from_numpy(points).to_sparse(),
}


@pytest.mark.parametrize("name", ARRAYS)
def test_every_kind_of_array_is_labelled_or_one_line(by_laser: World, name: str) -> None:
    points = in_order()
    if name == "half precision":
        points = points.astype(np.float16).astype(np.float32)
    expected = by_laser.segmenter(points).labels
    given = ARRAYS[name](points)
    if name in ("on no device", "sparse"):
        fails(partial(by_laser.segmenter, given), "a Tensor", "give one array")
        fails(partial(blind_runner(by_laser), given), "a Tensor", "give one array")
        return
    np.testing.assert_array_equal(by_laser.segmenter(given).labels, expected)
    labels = blind_runner(by_laser)(points).labels
    if name == "named":
        fails(partial(blind_runner(by_laser), given), "named columns", "stack")
        return
    np.testing.assert_array_equal(blind_runner(by_laser)(given).labels, labels)


@pytest.mark.parametrize("kind", [np.float16, np.float64, ">f4", np.int64])
def test_the_runner_gives_its_graphs_float32(by_laser: World, kind: Any) -> None:
    points = in_order().astype(kind)
    with watched() as seen:
        for given in (points, Scan(points)):
            blind_runner(by_laser)(given)
    for read, _ in seen:
        assert read.dtype == np.float32
        np.testing.assert_array_equal(read, seen[0][0])


OF_LOST_RETURNS = ("-1 in 300 of 1,500 points", "write 0")


def with_negative_intensities() -> np.ndarray:
    points = plain()
    points[1:301, 3] = -1
    return points


def test_files_of_8_bits_get_the_labels_of_fractions(saved: World) -> None:
    points = plain()
    expected = saved.segmenter(points).labels
    points[:, 3] *= 255
    for entry in OF_FILES:
        assert (entry(saved, points) == expected).mean() > 0.995, entry.__name__


def test_negative_intensities_are_named_with_their_number(saved: World) -> None:
    fails(partial(saved.segmenter, with_negative_intensities()), *OF_LOST_RETURNS)


@pytest.mark.parametrize("value", with_full([np.nan, np.inf], [np.inf]))
@pytest.mark.parametrize("share", with_full([1.0, 0.999, 0.6], [0.6]))
def test_intensities_mostly_missing_are_none(saved: World, value: float, share: float) -> None:
    points = plain()
    points[: round(share * len(points)), 3] = value
    with no_warnings():
        expected = saved.segmenter(points[:, :3]).labels
        for entry in (*IN_MEMORY, *OF_FILES, *OF_DATASETS):
            assert (entry(saved, points) == expected).mean() > 0.995, entry.__name__


def test_missing_intensities_are_counted(saved: World) -> None:
    points = without_intensities(0.1)
    with pytest.warns(UserWarning, match="no intensity in 1[012] % of the points"):
        saved.segmenter(points)
    result = saved.segmenter(saved.write(points))
    assert result.origin is not None
    assert f"no intensity in {np.isnan(points[:, 3]).sum()} of 1,500 points" in result.assumed


def of_lost_returns(name: str) -> np.ndarray:
    return np.array([LOST[name]] * 100, np.float32)


@pytest.mark.parametrize("name", with_quick(LOST, ["at the origin", "not a number"]))
def test_a_scan_of_lost_returns_alone_is_refused_by_every_entry(saved: World, name: str) -> None:
    points = of_lost_returns(name)
    fails(partial(saved.segmenter, points), "expected points to segment")
    for entry in (by_scan, by_path, by_evaluate, by_node, by_evaluate_of_a_dataset):
        fails(partial(entry, saved, points), "expected")


@pytest.mark.full
def test_the_onnx_runner_refuses_what_the_segmenter_refuses(runner: OnnxSegmenter) -> None:
    fails(partial(runner, with_negative_intensities()), *OF_LOST_RETURNS)
    for name in LOST:
        fails(partial(runner, of_lost_returns(name)), "expected points to segment")
