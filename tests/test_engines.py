"""Engines: the same labels whatever runs the networks; what is missing is one line."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from worlds import fails, files, fresh_weights

import amvnet
from amvnet import engines
from amvnet.engines import cache_folder, engage
from amvnet.models.layers import ConvBlock
from amvnet.segmenter import Segmenter


@pytest.fixture(autouse=True)
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("AMVNET_CACHE", str(tmp_path / "cache"))
    return tmp_path / "cache"


def scan(seed: int, points: int = 4000) -> np.ndarray:
    rng = np.random.default_rng(seed)
    found = rng.normal(0, 12, (points, 4)) * [1, 1, 0.08, 0]
    found[:, 3] = rng.random(points)
    return found.astype(np.float32)


def check_equal(weights: object, engine: str) -> None:
    """Both networks' probabilities within 1e-4, labels on 99.99 % of the points."""
    before, after = Segmenter(weights), Segmenter(weights)
    untouched = after.model.range_net
    assert engage(after, engine) == engine
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
    (folder,) = (cache / "onnx").iterdir()
    written = {name: (folder / name).stat().st_mtime_ns for name in files(folder)}
    assert "amvnet.json" in written
    engage(Segmenter(fresh_weights()), "onnx")
    assert {name: (folder / name).stat().st_mtime_ns for name in files(folder)} == written
    engage(Segmenter(fresh_weights(seed=1)), "onnx")
    assert len(list((cache / "onnx").iterdir())) == 2


def test_onnx_runs_the_methods_of_one_network() -> None:
    pytest.importorskip("onnxruntime")
    for method in ("rv", "bev"):
        segmenter = Segmenter(fresh_weights(), method=method)
        expected = segmenter(scan(0)).scores
        engage(segmenter, "onnx")
        np.testing.assert_allclose(segmenter(scan(0)).scores, expected, atol=1e-4)


def test_onnx_takes_scans_one_by_one(tmp_path: Path) -> None:
    pytest.importorskip("onnxruntime")
    segmenter = Segmenter(fresh_weights())
    engage(segmenter, "onnx")
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
    fails(lambda: engage(Segmenter(fresh_weights()), "compile"), "no working C++ compiler", "engine torch")


def test_other_engines_and_missing_libraries_are_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    fails(lambda: engage(Segmenter(fresh_weights()), "tensorrt"), "tensorrt", "onnx")
    fails(lambda: amvnet.load("sim-hdl64e", engine="tensorrt"), "tensorrt")
    monkeypatch.setattr("amvnet.export.EXTRA", ("no_such_library",))
    fails(lambda: engage(Segmenter(fresh_weights()), "onnx"), "no_such_library", "amvnet[export]")


def test_auto_is_torch_as_it_is() -> None:
    segmenter = Segmenter(fresh_weights())
    before = segmenter.model.range_net
    assert engage(segmenter, "auto") == engines.FASTEST == "torch"
    assert segmenter.model.range_net is before


def test_the_cache_lies_where_it_is_said(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
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
