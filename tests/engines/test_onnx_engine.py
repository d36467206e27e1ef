"""ONNX Runtime as the engine: the labels of torch; what is missing is one line."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch

import amvnet
from amvnet.engines.base import WithUnet
from amvnet.engines.export import cache as cache_module
from amvnet.engines.export import int8
from amvnet.engines.export.cache import cached_networks
from amvnet.engines.onnx import OnnxEngine, OnnxGraph
from amvnet.inference.scan_stream import stream_scans
from amvnet.models.methods import MethodName
from amvnet.weights.file import load

from fixtures.commands import fails, files
from fixtures.exports import shallow_weights
from fixtures.tiny import fresh_weights

TENSORRT = "TensorrtExecutionProvider"
CUDA = "CUDAExecutionProvider"
CPU = "CPUExecutionProvider"
WEIGHTS = shallow_weights()


@pytest.fixture(scope="module", autouse=True)
def cache(tmp_path_factory: pytest.TempPathFactory, graphs_converted_once: None) -> Iterator[Path]:
    pytest.importorskip("onnxruntime")
    folder = tmp_path_factory.mktemp("cache")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("AMVNET_CACHE", str(folder))
        yield folder


def random_points(seed: int, count: int = 4000) -> np.ndarray:
    rng = np.random.default_rng(seed)
    points = rng.normal(0, 12, (count, 4)) * [1, 1, 0.08, 0]
    points[:, 3] = rng.random(count)
    return points.astype(np.float32)


def modification_times(folder: Path) -> dict[str, int]:
    """Return when each file below a folder was written, in ns."""
    return {name: (folder / name).stat().st_mtime_ns for name in files(folder)}


def test_onnx_gives_the_labels_of_torch_and_exports_once(cache: Path) -> None:
    """It changes probabilities by 1e-4 at most, and one label in 10,000."""
    expected_segmenter = amvnet.load(WEIGHTS)
    segmenter = amvnet.load(WEIGHTS, engine="onnx")
    assert (expected_segmenter.engine.name, segmenter.engine.name) == ("torch", "onnx")

    for seed in range(3):
        points = random_points(seed)
        expected = expected_segmenter(points)
        actual = segmenter(points)
        for name in ("rv", "bev"):
            assert 0 < np.abs(getattr(actual, name) - getattr(expected, name)).max() <= 1e-4
        assert (actual.labels == expected.labels).mean() >= 0.9999
        assert actual.uncertain.any()

    times = modification_times(cache)
    assert any(name.endswith("amvnet.json") for name in times)
    amvnet.load(WEIGHTS, engine="onnx")
    assert modification_times(cache) == times


@pytest.mark.parametrize(
    ("installed", "expected"),
    [
        ([CPU, "AzureExecutionProvider"], [CPU]),
        ([CPU, CUDA], [CUDA, CPU]),
        ([CUDA, CPU, TENSORRT], [TENSORRT, CUDA, CPU]),
    ],
)
def test_onnx_takes_the_fastest_provider_that_is_installed_and_int8_the_cpu(
    installed: list[str], expected: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    import onnxruntime

    networks = cached_networks(WEIGHTS)
    opened: list[list[str]] = []
    caches: list[str | None] = []

    class Session:
        def __init__(self, content: bytes, options: Any, providers: list[tuple[str, Any]]) -> None:
            assert content in networks.files.values()
            opened.append([name for name, _ in providers])
            for name, values in providers:
                assert not values or name == TENSORRT
                if name == TENSORRT:
                    caches.append(values.get("trt_engine_cache_path"))

        def get_inputs(self) -> list[SimpleNamespace]:
            return [SimpleNamespace(name="x")]

    monkeypatch.setattr(onnxruntime, "get_available_providers", lambda: installed)
    monkeypatch.setattr(onnxruntime, "InferenceSession", Session)

    said: list[str] = []
    amvnet.load(WEIGHTS, engine="onnx", report=said.append)
    assert opened == [expected, expected]
    (line,) = said
    assert ("Provider" in line) == (len(expected) > 1)
    assert expected[0] in line or expected == [CPU]
    assert set(caches) <= {str(networks.folder)}

    # A run that must not use the cache keeps nothing.
    OnnxEngine(WEIGHTS, replace(networks, folder=None))
    assert set(caches[2:]) <= {None}

    engine = OnnxEngine(WEIGHTS, networks, int8=True)
    assert opened[-2:] == [[CPU], [CPU]]
    assert (engine.name, engine.hardware) == ("int8", "cpu")


@pytest.mark.full
@pytest.mark.parametrize("name", ["sim-hdl64e", "sim-any"])
def test_int8_keeps_nearly_all_labels_and_is_calibrated_once(
    monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    pytest.importorskip("embreex")
    monkeypatch.setattr(int8, "MAX_SCANS", 3)
    weights = load(name)
    scan = int8.simulated_scans(weights)[0]

    expected = amvnet.load(weights)(scan).labels
    said: list[str] = []
    for _ in range(2):
        segmenter = amvnet.load(weights, engine="int8", report=said.append)
        assert segmenter.engine.name == "int8"
    assert sum("calibrated" in line for line in said) == 1

    assert 0.9 < (segmenter(scan).labels == expected).mean() < 1


@pytest.mark.parametrize("method", ["rv", "bev"])
def test_onnx_runs_the_methods_of_one_network(method: MethodName) -> None:
    points = random_points(0)
    expected = amvnet.load(WEIGHTS, method=method)(points).scores
    actual = amvnet.load(WEIGHTS, method=method, engine="onnx")(points).scores
    np.testing.assert_allclose(actual, expected, atol=1e-4)


def test_onnx_segments_scans_in_parallel_with_one_thread_each() -> None:
    segmenter = amvnet.load(WEIGHTS, engine="onnx")
    assert segmenter.at_once == torch.get_num_threads()

    scans = [random_points(seed) for seed in range(6)]
    expected = [segmenter(points).labels for points in scans]
    results = stream_scans(scans, lambda points: points, lambda _, points: segmenter(points), 2)
    for result, labels in zip(results, expected, strict=True):
        assert (result.labels == labels).mean() >= 0.9999

    graph = segmenter.model.range_net
    assert isinstance(graph, OnnxGraph)
    assert set(graph.sessions) == {torch.get_num_threads(), max(torch.get_num_threads() // 2, 1)}


def test_onnx_takes_scans_one_by_one() -> None:
    model = amvnet.load(WEIGHTS, engine="onnx").model
    assert isinstance(model.polar_net, WithUnet)
    for network, channels in ((model.range_net, 6), (model.polar_net.unet, 8)):
        fails(lambda: network(torch.zeros(2, channels, 16, 64)), "one scan", "2")  # noqa: B023


def test_other_engines_and_missing_libraries_are_one_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    engine: Any = "tensorrt"
    fails(lambda: amvnet.load(WEIGHTS, engine=engine), "tensorrt", "onnx")
    fails(lambda: amvnet.load("sim-hdl64e", engine=engine), "tensorrt")

    monkeypatch.setattr("amvnet.engines.export.onnx.LIBRARIES", ("no_such_library",))
    fails(lambda: amvnet.load(WEIGHTS, engine="onnx"), "no_such_library", "amvnet[export]")


@pytest.mark.parametrize("engine", ["onnx", "int8"])
def test_what_onnx_runtime_lacks_is_one_line_before_anything_is_exported(
    engine: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(cache_module, "export", lambda *_, **__: 1 / 0)
    other = fresh_weights(seed=8)
    fails(lambda: amvnet.load(other, "cpu", precision="bfloat16", engine=engine), "bfloat16", "cpu")
    fails(lambda: amvnet.load(other, method="vote", engine=engine), "vote")  # type: ignore[arg-type]
    fails(lambda: amvnet.load(other, "abacus", engine=engine), "abacus")
