"""Engines: the same labels whatever runs the networks; what is missing is one line."""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from scipy.spatial import cKDTree
from torch.nn import functional as F

import amvnet
from amvnet.data.datasets.open import open_dataset
from amvnet.export import engines, int8
from amvnet.export.engines import OnnxGraph, cache_folder, exported, use_engine
from amvnet.inference.scan_stream import stream_scans
from amvnet.inference.segmentation import expand_to_scan
from amvnet.inference.segmenter import Segmenter
from amvnet.models import layers
from amvnet.models.layers import ConvBlock
from amvnet.models.methods import MethodName
from amvnet.models.point_head import head_features, point_table
from amvnet.models.polar_net import PolarNet
from amvnet.models.views.points import PointBatch
from amvnet.scan import Scan
from amvnet.sensors.intensity import match_scan, trained_intensity
from amvnet.weights.file import Weights, load
from lidarstreets import simulate

from fixtures.worlds import fails, files, fresh_weights

TENSORRT = "TensorrtExecutionProvider"
CUDA = "CUDAExecutionProvider"
CPU = "CPUExecutionProvider"
PART = 2000  # uncertain points that the plain model settles at a time


@pytest.fixture(scope="module")
def shared(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A cache for all tests: an export takes ten seconds."""
    return tmp_path_factory.mktemp("cache")


@pytest.fixture(autouse=True)
def cache(shared: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("AMVNET_CACHE", str(shared))
    return shared


def random_points(seed: int, count: int = 4000) -> np.ndarray:
    rng = np.random.default_rng(seed)
    points = rng.normal(0, 12, (count, 4)) * [1, 1, 0.08, 0]
    points[:, 3] = rng.random(count)
    return points.astype(np.float32)


def check_equal(weights: Weights, engine: str) -> None:
    """Check that an engine changes probabilities by 1e-4 at most, and one label in 10,000."""
    expected_segmenter = Segmenter(weights)
    segmenter = Segmenter(weights)
    torch_net = segmenter.model.range_net
    use_engine(segmenter, engine)
    assert segmenter.engine == engine
    assert segmenter.model.range_net is not torch_net

    for seed in range(3):
        points = random_points(seed)
        expected = expected_segmenter(points)
        actual = segmenter(points)
        for name in ("rv", "bev"):
            assert np.abs(getattr(actual, name) - getattr(expected, name)).max() <= 1e-4
        assert (actual.labels == expected.labels).mean() >= 0.9999
        assert actual.uncertain.any()


def modification_times(folder: Path) -> dict[str, int]:
    """Return when each file below a folder was written, in ns."""
    return {name: (folder / name).stat().st_mtime_ns for name in files(folder)}


def test_onnx_says_what_torch_says_and_exports_once(cache: Path) -> None:
    pytest.importorskip("onnxruntime")
    check_equal(fresh_weights(), "onnx")

    folder = exported(Segmenter(fresh_weights()))
    assert folder.is_relative_to(cache)
    times = modification_times(folder)
    assert "amvnet.json" in times

    use_engine(Segmenter(fresh_weights()), "onnx")
    assert modification_times(folder) == times


@pytest.mark.parametrize(
    ("installed", "expected"),
    [
        ([CPU, "AzureExecutionProvider"], [CPU]),
        ([CPU, CUDA], [CUDA, CPU]),
        ([CUDA, CPU, TENSORRT], [TENSORRT, CUDA, CPU]),
    ],
)
def test_onnx_takes_the_fastest_provider_that_is_installed_and_int8_the_cpu(
    installed: list[str], expected: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    onnxruntime = pytest.importorskip("onnxruntime")
    opened: list[list[str]] = []

    class Session:
        def __init__(self, path: str, options: Any, providers: list[tuple[str, Any]]) -> None:
            opened.append([name for name, _ in providers])
            for name, values in providers:
                is_kept = values.get("trt_engine_cache_path") == str(tmp_path)
                assert is_kept == (name == TENSORRT)

        def get_inputs(self) -> list[SimpleNamespace]:
            return [SimpleNamespace(name="x")]

    monkeypatch.setattr(onnxruntime, "get_available_providers", lambda: installed)
    monkeypatch.setattr(onnxruntime, "InferenceSession", Session)
    monkeypatch.setattr(engines, "exported", lambda *args: tmp_path)

    said: list[str] = []
    use_engine(Segmenter(fresh_weights()), "onnx", said.append)
    assert opened == [expected, expected]
    assert [expected[0] in line for line in said] == [True] * (len(expected) > 1)

    use_engine(Segmenter(fresh_weights()), "int8", said.append)
    assert opened[2:] == [[CPU], [CPU]]


def test_other_weights_have_another_export(monkeypatch: pytest.MonkeyPatch) -> None:
    folders: list[Path] = []
    monkeypatch.setattr(engines, "export", lambda weights, folder, int8: folders.append(folder))
    monkeypatch.setattr(engines, "check_libraries", lambda: None)
    for seed in (7, 8, 7):
        exported(Segmenter(fresh_weights(seed=seed)))
    exported(Segmenter(fresh_weights(seed=7)), int8="simulated")
    assert folders[0] == folders[2]
    assert len(set(folders)) == 3


@pytest.mark.slow
def test_int8_keeps_nearly_all_labels_and_is_calibrated_once(
    cache: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("onnxruntime")
    pytest.importorskip("embreex")
    monkeypatch.setattr(int8, "SCANS", 3)
    weights = load("sim-hdl64e")
    scan = int8.calibration_scans("simulated", Segmenter(weights))[0]

    segmenter = Segmenter(weights)
    expected = segmenter(scan).labels
    said: list[str] = []
    for _ in range(2):
        segmenter = Segmenter(weights)
        use_engine(segmenter, "int8", said.append)
        assert segmenter.engine == "int8"
    assert len(said) == 1
    assert "calibrated" in said[0]

    labels = segmenter(scan).labels
    assert 0.9 < (labels == expected).mean() < 1


def test_int8_of_a_sensor_that_cannot_be_simulated_is_one_line() -> None:
    pytest.importorskip("onnxruntime")
    weights = replace(fresh_weights(), sensor="mine")
    fails(lambda: use_engine(Segmenter(weights), "int8"), "mine", "simulate")


@pytest.mark.parametrize("method", ["rv", "bev"])
def test_onnx_runs_the_methods_of_one_network(method: MethodName) -> None:
    pytest.importorskip("onnxruntime")
    segmenter = Segmenter(fresh_weights(), method=method)
    points = random_points(0)
    expected = segmenter(points).scores
    use_engine(segmenter, "onnx")
    np.testing.assert_allclose(segmenter(points).scores, expected, atol=1e-4)


def test_onnx_segments_scans_in_parallel_with_one_thread_each() -> None:
    pytest.importorskip("onnxruntime")
    segmenter = Segmenter(fresh_weights())
    use_engine(segmenter, "onnx")
    assert segmenter.at_once == torch.get_num_threads()

    scans = [random_points(seed) for seed in range(6)]
    expected = [segmenter(points).labels for points in scans]
    results = stream_scans(scans, lambda points: points, lambda _, points: segmenter(points), 2)
    for result, labels in zip(results, expected, strict=True):
        assert (result.labels == labels).mean() >= 0.9999

    graph = segmenter.model.range_net
    assert isinstance(graph, OnnxGraph)
    share = max(torch.get_num_threads() // 2, 1)
    assert set(graph.sessions) == {torch.get_num_threads(), share}


def test_onnx_takes_scans_one_by_one() -> None:
    pytest.importorskip("onnxruntime")
    segmenter = Segmenter(fresh_weights())
    use_engine(segmenter, "onnx")
    fails(lambda: segmenter.model.range_net(torch.zeros(2, 6, 16, 64)), "one scan", "2")


def test_other_engines_and_missing_libraries_are_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    segmenter = Segmenter(fresh_weights())
    fails(lambda: use_engine(segmenter, "tensorrt"), "tensorrt", "onnx")
    fails(lambda: amvnet.load("sim-hdl64e", engine="tensorrt"), "tensorrt")

    monkeypatch.setattr("amvnet.export.onnx.EXTRA", ("no_such_library",))
    fails(lambda: use_engine(segmenter, "onnx"), "no_such_library", "amvnet[export]")


def test_the_engine_torch_leaves_the_networks_as_they_are() -> None:
    segmenter = Segmenter(fresh_weights())
    net = segmenter.model.range_net
    use_engine(segmenter, "torch")
    assert segmenter.engine == "torch"
    assert segmenter.model.range_net is net


def test_the_cache_lies_where_it_is_said(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("AMVNET_CACHE", str(tmp_path / "cache"))
    assert cache_folder() == tmp_path / "cache"

    monkeypatch.delenv("AMVNET_CACHE")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "caches"))
    assert cache_folder() == tmp_path / "caches" / "amvnet"

    monkeypatch.delenv("XDG_CACHE_HOME")
    monkeypatch.setenv("HOME", str(tmp_path))
    assert cache_folder() == tmp_path / ".cache" / "amvnet"


def test_a_segmenters_norms_are_folded_and_its_kernels_keep_their_channels_last() -> None:
    model = Segmenter(fresh_weights()).model
    blocks = [module for module in model.modules() if isinstance(module, ConvBlock)]
    assert len(blocks) > 10
    for convolution, norm, _ in blocks:
        assert isinstance(convolution, torch.nn.Conv2d)
        assert isinstance(norm, torch.nn.Identity)
        assert convolution.weight.is_contiguous(memory_format=torch.channels_last)


# ---- the plain model


def label_plainly(weights: Weights, scan: Scan) -> np.ndarray:
    """Return (N,) train ids by AMVNet without anything that makes it fast.

    The norms are not folded, the U-Net's scores are computed for the whole map, a point looks up
    its voxel among all voxels, and SciPy finds the neighbours.
    """
    model = weights.build()
    intensity = trained_intensity(weights.training, weights.sensor)
    batch = PointBatch.of([match_scan(scan, intensity)])
    f = model.score_range(model.range_view.project(batch))

    net = model.polar_net
    assert isinstance(net, PolarNet)
    grid = model.polar_view.project(batch)
    pillars = net.compress(grid.pool(net.point_mlp(grid.features)))
    decoded = net.unet(grid.to_map(pillars))
    vertical = grid.shape[3]
    voxels = net.scores(decoded)[0].unflatten(0, (vertical, -1)).flatten(2)  # (Z, K, R * A)
    g = voxels[grid.voxel, :, grid.pillar].softmax(dim=1)

    head = model.point_head
    assert head is not None
    index = model.assertion(f, g, batch.points).nonzero()[:, 0]
    near = torch.from_numpy(nearest_by_scipy(batch.points[:, :3].numpy(), index.numpy()))
    table = point_table(batch.points, f, g)
    merged = torch.sqrt(f * g)
    for i, n in zip(index.split(PART), near.split(PART), strict=True):
        merged[i] = head(*head_features(head.config, table, i, n)).softmax(dim=1)
    return expand_to_scan(merged.argmax(dim=1) + 1, scan.valid)


def nearest_by_scipy(xyz: np.ndarray, own: np.ndarray, n: int = 15) -> np.ndarray:
    """Return (U, n) indices of the nearest other points of the points `own` (U,).

    Among many points in one place a point may be missing from its own n + 1 nearest; then the
    farthest of these is dropped.
    """
    tree = cKDTree(xyz, balanced_tree=False, compact_nodes=False)
    nearest = np.asarray(tree.query(xyz[own], k=n + 1)[1])
    rows = [row[row != index][:n] for index, row in zip(own, nearest, strict=True)]
    return np.array(rows)


def weights_and_data() -> list[tuple[str, str]]:
    """Return weights and datasets to compare with: simulated, and real ones if there are any."""
    pairs = [("sim-hdl64e", "simulated:hdl64e"), ("sim-hdl32e", "simulated:hdl32e")]
    real = os.environ.get("AMVNET_REAL_DATA")
    if real:
        pairs.append(("sim-hdl64e", f"semantickitti:{real}/semantickitti"))
        pairs.append(("sim-hdl32e", f"nuscenes:{real}/nuscenes"))
    return pairs


@pytest.mark.parametrize(("weights", "data"), weights_and_data())
def test_what_makes_it_fast_leaves_the_labels_as_they_are(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, weights: str, data: str
) -> None:
    if data.startswith("simulated:"):
        pytest.importorskip("embreex")
        sensor = data.removeprefix("simulated:")
        simulate(tmp_path, sensor=sensor, scans=2, sequences=1, seed=7)
        layout = "semantickitti" if sensor == "hdl64e" else "nuscenes"
        data = f"{layout}:{tmp_path}"
        step = 4
    else:
        step = 20 if data.startswith("semantickitti:") else 4
    dataset = open_dataset(data)
    records = dataset.records(dataset.sequences("all"))[::step][:4]
    segmenter = Segmenter(weights)

    equal = []
    for record in records:
        scan = dataset.read(record, labels=False)
        # With gradients, layers take their plain ways.
        with torch.enable_grad(), monkeypatch.context() as patch:
            patch.setattr(layers, "linear", F.linear)
            expected = label_plainly(segmenter.weights, scan)
        equal.append((segmenter(scan).labels == expected).mean())
    assert equal
    assert np.mean(equal) >= 0.9999
