"""Graphs in int8 hold integers, are calibrated as asked, and keep nearly all labels."""

from __future__ import annotations

import hashlib
import json
import shutil
import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from amvnet.cli.commands.export import calibration_scans
from amvnet.data.taxonomy import NUSCENES
from amvnet.engines.export import int8 as int8_export
from amvnet.engines.export import onnx as onnx_export
from amvnet.onnx_runner import OnnxSegmenter
from amvnet.scan import Scan
from amvnet.sensors.intensity import PROBABILITIES
from amvnet.weights.file import Weights, save

from fixtures.commands import fails, files, new_file, succeed
from fixtures.exports import check_versions, shallow_weights
from fixtures.sensors import rings_of
from fixtures.tiny import fresh_weights, street, trained_for, with_intensities, without

POINTS = 3000
QUANTISED = ("range_net", "polar_map")


@dataclass(frozen=True)
class Folders:
    float32: Path
    int8: Path


@dataclass(frozen=True)
class Kernel:
    """The weights of a convolution as stored; for integers, the scale of each channel."""

    weights: np.ndarray
    scale: np.ndarray | None = None


@pytest.fixture(scope="module")
def weights(graphs_converted_once: None) -> Weights:
    for library in ("onnx", "onnxscript", "onnxruntime"):
        pytest.importorskip(library)
    return without(shallow_weights(), "point_head")


@pytest.fixture(scope="module")
def scans(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("scans")
    for seed in range(6):
        points, _ = street(seed, POINTS)
        points.tofile(folder / f"{seed:06d}.bin")
    return folder


@pytest.fixture(scope="module")
def exported(weights: Weights, scans: Path, tmp_path_factory: pytest.TempPathFactory) -> Folders:
    folders = Folders(tmp_path_factory.mktemp("a") / "float32", tmp_path_factory.mktemp("b"))
    quantise = int8_export.quantise

    def copy_and_quantise(folder: Path, *rest: Any) -> Any:
        shutil.copytree(folder, folders.float32)
        return quantise(folder, *rest)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(onnx_export, "quantise", copy_and_quantise)
        graphs = onnx_export.export(
            weights, folders.int8, scans=calibration_scans(str(scans), weights)
        )
    assert {name for name, graph in graphs.items() if "agreement" in graph} == set(QUANTISED)
    return folders


def load_model(folder: Path, name: str) -> Any:
    import onnx

    return onnx.load(folder / f"{name}.onnx")


def read_points(path: Path) -> np.ndarray:
    return np.fromfile(path, np.float32).reshape(-1, 4)


def nodes_by_output(model: Any) -> dict[str, Any]:
    return {node.output[0]: node for node in model.graph.node}


def kernels(model: Any) -> dict[str, Kernel]:
    from onnx import numpy_helper

    stored = {value.name: numpy_helper.to_array(value) for value in model.graph.initializer}
    nodes = nodes_by_output(model)

    by_name = {}
    for node in model.graph.node:
        if node.op_type != "Conv":
            continue
        name = node.input[1]
        if name in stored:
            by_name[name] = Kernel(stored[name])
        else:
            integers, scale = nodes[name].input[:2]
            by_name[integers.removesuffix("_quantized")] = Kernel(stored[integers], stored[scale])
    return by_name


@pytest.mark.parametrize("name", QUANTISED)
def test_onnx_runtime_1_14_takes_the_graphs(exported: Folders, name: str) -> None:
    check_versions(exported.int8 / f"{name}.onnx")


@pytest.mark.parametrize("name", QUANTISED)
def test_convolutions_hold_integers_nearest_to_their_weights(exported: Folders, name: str) -> None:
    before = kernels(load_model(exported.float32, name))
    after = kernels(load_model(exported.int8, name))
    assert set(before) == set(after)

    in_float32 = []
    for key, kernel in after.items():
        if kernel.scale is None:
            in_float32.append(key)
            continue
        weights = before[key].weights
        assert kernel.weights.dtype == np.int8
        assert np.abs(kernel.weights.astype(int)).max() <= 64  # seven bits
        assert kernel.scale.shape == weights.shape[:1]
        steps = kernel.scale.reshape(-1, 1, 1, 1)
        assert (np.abs(kernel.weights * steps - weights) <= 0.5001 * steps + 1e-7).all()
    assert in_float32 == (["stem.0.weight"] if name == "range_net" else [])


@pytest.mark.parametrize("sensor", ["any", "vlp16", "hdl64e"])
def test_scans_of_every_sensor_can_be_simulated_as_its_training_has_them(
    monkeypatch: pytest.MonkeyPatch, sensor: str
) -> None:
    pytest.importorskip("embreex")
    monkeypatch.setattr(int8_export, "MAX_SCANS", 1)
    weights = replace(trained_for(fresh_weights(), "any"), sensor=sensor)
    (scan,) = int8_export.simulated_scans(weights)
    around = np.linalg.norm(scan.points[:, :2], axis=1) < 10
    ground = np.quantile(scan.points[around & scan.valid, 2], 0.2)
    assert ground == pytest.approx(-1.73, abs=0.3)


@pytest.mark.full
def test_the_gru_stays_in_float32(weights: Weights, scans: Path, tmp_path: Path) -> None:
    deep = without(fresh_weights(), "polar_net", "point_head")
    onnx_export.export(deep, tmp_path, scans=calibration_scans(str(scans), deep))
    model = load_model(tmp_path, "range_net")
    nodes = nodes_by_output(model)
    layers = [node for node in model.graph.node if node.op_type == "GRU"]
    assert layers
    for layer in layers:
        for stored in layer.input[1:3]:
            assert stored not in nodes or nodes[stored].op_type != "DequantizeLinear"


@pytest.mark.full
def test_the_description_says_which_graphs_are_in_int8(exported: Folders, scans: Path) -> None:
    graphs = json.loads((exported.int8 / "amvnet.json").read_text())["graphs"]
    for name, graph in graphs.items():
        assert graph["precision"] == ("int8" if name in QUANTISED else "float32")
        content = (exported.int8 / graph["file"]).read_bytes()
        assert graph["sha256"] == hashlib.sha256(content).hexdigest()
        assert ("difference" in graph) == (graph["precision"] == "float32")

    before = OnnxSegmenter(exported.float32)
    after = OnnxSegmenter(exported.int8)
    equal: dict[str, list[np.ndarray]] = {"range_net": [], "polar_map": []}
    for name in ("000000.bin", "000005.bin"):  # the first of every five scans checks
        points = read_points(scans / name)
        f = before.score_range_view(Scan(points)).argmax(axis=1)
        g = before.score_polar_view(points).argmax(axis=1)
        equal["range_net"].append(f == after.score_range_view(Scan(points)).argmax(axis=1))
        equal["polar_map"].append(g == after.score_polar_view(points).argmax(axis=1))
    for name, parts in equal.items():
        agreement = graphs[name]["agreement"]
        assert agreement == pytest.approx(np.concatenate(parts).mean(), abs=1e-3)
        assert agreement >= 0.9


def test_the_graphs_say_nothing_of_the_machine(exported: Folders) -> None:
    assert files(exported.float32) == files(exported.int8)
    for path in exported.int8.iterdir():
        for word in (str(Path(__file__).parents[3]), sys.prefix, "site-packages"):
            assert word.encode() not in path.read_bytes(), path.name


@pytest.mark.full
def test_one_scan_and_rows_by_ring_do(scans: Path, tmp_path: Path) -> None:
    weights = trained_for(fresh_weights(NUSCENES), "hdl32e")
    weights = without(weights, "polar_net", "point_head")
    path = save(weights, tmp_path / "w.safetensors")
    succeed(f"export --weights {path} --out {tmp_path}/out --int8 {scans}/000003.bin")

    points = read_points(scans / "000003.bin")
    assert OnnxSegmenter(tmp_path / "out")(points, rings_of(points, 16)).labels.all()


# ---- mistakes


def check_refused(weights: Weights, int8: str, folder: Path, word: str) -> None:
    """Check that an export in int8 fails with a word in one line, and leaves no files."""
    polar_only = without(weights, "range_net")
    out = folder / "out"
    fails(
        lambda: onnx_export.export(polar_only, out, scans=calibration_scans(int8, polar_only)), word
    )
    assert not files(out)


def test_calibrating_without_a_folder_is_one_line(weights: Weights, tmp_path: Path) -> None:
    check_refused(weights, str(tmp_path / "missing"), tmp_path, "expected")


def test_calibrating_scans_have_the_intensities_that_the_networks_get(scans: Path) -> None:
    quantiles = (np.linspace(0, 1, len(PROBABILITIES)) ** 3).tolist()
    weights = with_intensities(fresh_weights(), quantiles, is_matched=True)
    for scan in calibration_scans(str(scans), weights):
        found = np.quantile(scan.points[scan.valid, 3], PROBABILITIES)
        np.testing.assert_allclose(found, quantiles, atol=0.02)


def test_calibrating_without_scans_is_one_line(weights: Weights, tmp_path: Path) -> None:
    (tmp_path / "empty").mkdir()
    check_refused(weights, str(tmp_path / "empty"), tmp_path, "expected")


@pytest.mark.parametrize(
    "content",
    [b"123", np.full((5, 4), np.nan, np.float32).tobytes()],
    ids=["broken", "without finite points"],
)
def test_calibrating_with_a_bad_scan_is_one_line(
    weights: Weights, tmp_path: Path, content: bytes
) -> None:
    scan = new_file(tmp_path / "scans/a.bin", content)
    check_refused(weights, str(scan.parent), tmp_path, "expected")


def test_calibrating_for_a_sensor_that_cannot_be_simulated_is_one_line(
    weights: Weights, tmp_path: Path
) -> None:
    check_refused(weights, int8_export.SIMULATED, tmp_path, "scans of this sensor to amvnet export")


@pytest.mark.full
def test_graphs_that_change_too_many_labels_are_one_line(
    weights: Weights, scans: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(int8_export, "LEAST_AGREEMENT", 1.01)
    check_refused(weights, str(scans), tmp_path, "calibrate with more scans")


def test_a_graph_is_calibrated_without_the_scans_of_its_check(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    calibrated: list[Any] = []
    recorder: Any = SimpleNamespace(recorded={"range_net": []}, replace=lambda name, path: None)

    def labels(segmenter: Any, name: str, scans: Sequence[Any]) -> np.ndarray:
        recorder.recorded.setdefault(name, []).extend(scans)
        return np.zeros(len(scans))

    monkeypatch.setattr(int8_export, "_Recorder", lambda folder: recorder)
    monkeypatch.setattr(int8_export, "_labels", labels)
    monkeypatch.setattr(int8_export, "_write", lambda path, inputs: calibrated.extend(inputs))
    monkeypatch.setattr(int8_export, "digest", lambda path: "")
    scans: Any = list(range(12))
    ((_, changes),) = int8_export.quantise(tmp_path, ["range_net"], scans)
    assert calibrated == [1, 2, 3, 4, 6, 7, 8, 9, 11]
    assert changes["agreement"] == 1
