"""Engines: the same labels whatever runs the networks; what is missing is one line."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.spatial import cKDTree
from torch.nn import functional as F

import amvnet
from amvnet.data.datasets.open import open_dataset
from amvnet.export import engines
from amvnet.export.engines import cache_folder, exported, use_engine
from amvnet.inference.segmenter import Segmenter, expand_to_scan
from amvnet.models import layers
from amvnet.models.layers import ConvBlock
from amvnet.models.point_head import head_features, point_table
from amvnet.models.views.points import PointBatch
from amvnet.scan import Scan
from amvnet.simulation import simulate
from amvnet.weights.file import Weights

from fixtures.worlds import fails, files, fresh_weights


@pytest.fixture(scope="module")
def shared(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A cache for all tests: an export takes ten seconds."""
    return tmp_path_factory.mktemp("cache")


@pytest.fixture(autouse=True)
def cache(shared: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("AMVNET_CACHE", str(shared))
    return shared


def scan(seed: int, points: int = 4000) -> np.ndarray:
    rng = np.random.default_rng(seed)
    found = rng.normal(0, 12, (points, 4)) * [1, 1, 0.08, 0]
    found[:, 3] = rng.random(points)
    return found.astype(np.float32)


def check_equal(weights: object, engine: str) -> None:
    """Both networks' probabilities within 1e-4, labels on 99.99 % of the points."""
    before, after = Segmenter(weights), Segmenter(weights)
    untouched = after.model.range_net
    assert use_engine(after, engine) == engine
    assert after.model.range_net is not untouched
    for seed in range(3):
        expected, found = before(scan(seed)), after(scan(seed))
        for name in ("rv", "bev"):
            assert np.abs(getattr(found, name) - getattr(expected, name)).max() <= 1e-4
        assert (found.labels == expected.labels).mean() >= 0.9999
        assert found.uncertain.any()


def test_onnx_says_what_torch_says_and_exports_once(cache: Path) -> None:
    pytest.importorskip("onnxruntime")
    check_equal(fresh_weights(), "onnx")
    folder = exported(Segmenter(fresh_weights()))
    assert folder.is_relative_to(cache)
    written = {name: (folder / name).stat().st_mtime_ns for name in files(folder)}
    assert "amvnet.json" in written
    use_engine(Segmenter(fresh_weights()), "onnx")
    assert {name: (folder / name).stat().st_mtime_ns for name in files(folder)} == written


def test_other_weights_have_another_export(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[Path] = []
    monkeypatch.setattr(engines, "export", lambda weights, folder: asked.append(folder))
    monkeypatch.setattr(engines, "check_libraries", lambda: None)
    for seed in (7, 8, 7):
        exported(Segmenter(fresh_weights(seed=seed)))
    assert asked[0] == asked[2] != asked[1]


def test_onnx_runs_the_methods_of_one_network() -> None:
    pytest.importorskip("onnxruntime")
    for method in ("rv", "bev"):
        segmenter = Segmenter(fresh_weights(), method=method)
        expected = segmenter(scan(0)).scores
        use_engine(segmenter, "onnx")
        np.testing.assert_allclose(segmenter(scan(0)).scores, expected, atol=1e-4)


def test_onnx_takes_scans_one_by_one(tmp_path: Path) -> None:
    pytest.importorskip("onnxruntime")
    segmenter = Segmenter(fresh_weights())
    use_engine(segmenter, "onnx")
    fails(lambda: segmenter.model.range_net(torch.zeros(2, 6, 16, 64)), "one scan", "2")


@pytest.mark.slow
def test_compile_says_what_torch_says() -> None:
    check_equal(fresh_weights(), "compile")


def test_without_a_compiler_compile_is_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(function: object) -> object:
        def run(*_: object) -> None:
            raise RuntimeError("no working C++ compiler\nand a page of it")

        return run

    monkeypatch.setattr(torch, "compile", broken)
    fails(
        lambda: use_engine(Segmenter(fresh_weights()), "compile"),
        "no working C++ compiler",
        "engine torch",
    )


def test_other_engines_and_missing_libraries_are_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    fails(lambda: use_engine(Segmenter(fresh_weights()), "tensorrt"), "tensorrt", "onnx")
    fails(lambda: amvnet.load("sim-hdl64e", engine="tensorrt"), "tensorrt")
    monkeypatch.setattr("amvnet.export.onnx.EXTRA", ("no_such_library",))
    fails(
        lambda: use_engine(Segmenter(fresh_weights()), "onnx"), "no_such_library", "amvnet[export]"
    )


def test_auto_is_torch_as_it_is() -> None:
    segmenter = Segmenter(fresh_weights())
    before = segmenter.model.range_net
    assert use_engine(segmenter, "auto") == engines.FASTEST == "torch"
    assert segmenter.model.range_net is before


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
        assert isinstance(norm, torch.nn.Identity)
        assert convolution.weight.is_contiguous(memory_format=torch.channels_last)


def plainly(weights: Weights, scan: Scan) -> np.ndarray:
    """Labels without any measure for speed: norms as they are, matrix products, whole maps, every voxel, SciPy."""
    model, batch = weights.build(), PointBatch.of([scan])
    f = model.score_range_view(batch)
    net, grid = model.polar_net, model.polar_view.project(batch)
    decoded = net.unet(grid.to_map(net.compress(grid.pool(net.point_mlp(grid.features)))))
    voxels = net.scores(decoded)[0].unflatten(0, (grid.shape[3], -1)).flatten(2)  # (Z, K, R * A)
    g = voxels[grid.voxel, :, grid.pillar].softmax(dim=1)
    uncertain = model.assertion(f, g, batch.points)
    index = uncertain.nonzero()[:, 0]
    near = torch.from_numpy(nearest_by_scipy(batch.points[:, :3].numpy(), index.numpy()))
    merged = torch.sqrt(f * g)
    for i, n in zip(index.split(2000), near.split(2000), strict=True):
        rows = head_features(model.point_head.config, point_table(batch.points, f, g), i, n)
        merged[i] = model.point_head(*rows).softmax(dim=1)
    return expand_to_scan(merged.argmax(dim=1) + 1, scan.valid)


def nearest_by_scipy(xyz: np.ndarray, own: np.ndarray, n: int = 15) -> np.ndarray:
    """The n nearest others; where the point itself is not among the n + 1 nearest, others lie in its place."""
    found = cKDTree(xyz, balanced_tree=False, compact_nodes=False).query(xyz[own], k=n + 1)[1]
    return np.array(
        [[i for i in row if i != self][:n] for self, row in zip(own, found, strict=True)]
    )


def scans_to_compare() -> list[tuple[str, str]]:
    """Weights and data sets: simulated, and real ones where they are at hand."""
    found = [("sim-hdl64e", "simulated:hdl64e"), ("sim-hdl32e", "simulated:hdl32e")]
    if real := os.environ.get("AMVNET_REAL_DATA"):
        found += [
            ("sim-hdl64e", f"semantickitti:{real}/semantickitti"),
            ("sim-hdl32e", f"nuscenes:{real}/nuscenes"),
        ]
    return found


@pytest.mark.parametrize(("weights", "data"), scans_to_compare())
def test_what_makes_it_fast_leaves_the_labels_as_they_are(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, weights: str, data: str
) -> None:
    kind, place = data.split(":", 1)
    if kind == "simulated":
        pytest.importorskip("embreex")
        simulate(tmp_path, sensor=place, scans=2, sequences=1, seed=7)
        data = ("semantickitti:" if place == "hdl64e" else "nuscenes:") + str(tmp_path)
    dataset, segmenter = open_dataset(data), Segmenter(weights)
    equal = []
    for record in dataset.records(dataset.sequences("all"))[
        :: 20 if kind == "semantickitti" else 4
    ][:4]:
        scan = dataset.read(record, labels=False)
        with (
            torch.enable_grad(),
            monkeypatch.context() as patched,
        ):  # with gradients: the plain way of `joined`
            patched.setattr(layers, "linear", F.linear)
            plain = plainly(segmenter.weights, scan)
        equal.append((plain == segmenter(scan).labels).mean())
    assert len(equal) >= 1
    assert np.mean(equal) >= 0.9999
