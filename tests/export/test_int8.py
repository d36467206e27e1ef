"""Graphs in int8 hold integers, are calibrated as asked, and say nearly what they said. Needs ONNX Runtime."""

from __future__ import annotations

import json
import shutil
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from amvnet.data.taxonomy import NUSCENES
from amvnet.onnx_runner import OnnxSegmenter
from amvnet.weights.file import Weights, save

from fixtures.worlds import fails, files, fresh_weights, run_cli, street, without

POINTS = 3000
QUANTISED = ("range_net", "polar_map")


@pytest.fixture(scope="module")
def weights() -> Weights:
    for library in ("onnx", "onnxscript", "onnxruntime"):
        pytest.importorskip(library)
    return without(fresh_weights(), "point_head")


@pytest.fixture(scope="module")
def scans(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("scans")
    for seed in range(6):
        street(seed, POINTS)[0].tofile(folder / f"{seed:06d}.bin")
    return folder


@pytest.fixture(scope="module")
def exported(
    weights: Weights, scans: Path, tmp_path_factory: pytest.TempPathFactory
) -> tuple[Path, Path]:
    """The same graphs as they were before, in float32, and in int8."""
    from amvnet.export import onnx as module

    float32, int8, quantise = (
        tmp_path_factory.mktemp("a") / "float32",
        tmp_path_factory.mktemp("b"),
        module.quantise,
    )

    def kept(folder: Path, *rest: Any) -> Any:
        shutil.copytree(folder, float32)
        return quantise(folder, *rest)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(module, "quantise", kept)
        assert set(module.export(weights, int8, int8=str(scans)).agreement) == set(QUANTISED)
    return float32, int8


def model_of(folder: Path, name: str) -> Any:
    import onnx

    return onnx.load(folder / f"{name}.onnx")


def kernels(model: Any) -> dict[str, tuple[np.ndarray, np.ndarray | None]]:
    """By their name each convolution's weights as stored, and where they are integers the scale of each channel."""
    from onnx import numpy_helper

    stored = {one.name: numpy_helper.to_array(one) for one in model.graph.initializer}
    made = {one.output[0]: one for one in model.graph.node}
    found: dict[str, tuple[np.ndarray, np.ndarray | None]] = {}
    for node in model.graph.node:
        if node.op_type == "Conv" and node.input[1] in stored:
            found[node.input[1]] = stored[node.input[1]], None
        elif node.op_type == "Conv":
            weight, scale = made[node.input[1]].input[:2]
            found[weight.removesuffix("_quantized")] = stored[weight], stored[scale]
    return found


@pytest.mark.parametrize("name", QUANTISED)
def test_convolutions_hold_integers_nearest_to_their_weights(
    exported: tuple[Path, Path], name: str
) -> None:
    before, after = (kernels(model_of(folder, name)) for folder in exported)
    assert set(before) == set(after)
    assert [key for key, (_, scale) in after.items() if scale is None] == {
        "range_net": ["stem.0.weight"]
    }.get(name, [])
    for key, (integers, scale) in after.items():
        if scale is not None:
            weight = before[key][0]
            assert integers.dtype == np.int8
            assert np.abs(integers.astype(int)).max() <= 64  # seven bits
            assert scale.shape == weight.shape[:1]
            steps = scale.reshape(-1, 1, 1, 1)
            assert (np.abs(integers * steps - weight) <= 0.5001 * steps + 1e-7).all()


def test_the_gru_stays_in_float32(exported: tuple[Path, Path]) -> None:
    model = model_of(exported[1], "range_net")
    made = {one.output[0]: one.op_type for one in model.graph.node}
    layers = [one for one in model.graph.node if one.op_type == "GRU"]
    assert layers
    assert all(made.get(name) != "DequantizeLinear" for one in layers for name in one.input[1:3])


def test_the_description_says_which_graphs_are_in_int8(
    exported: tuple[Path, Path], scans: Path
) -> None:
    import hashlib

    said = json.loads((exported[1] / "amvnet.json").read_text())["graphs"]
    precisions = {name: one["precision"] for name, one in said.items()}
    assert precisions == {name: "int8" if name in QUANTISED else "float32" for name in said}
    for one in said.values():
        assert one["sha256"] == hashlib.sha256((exported[1] / one["file"]).read_bytes()).hexdigest()
        assert ("difference" in one) == (one["precision"] == "float32")
    runners = [OnnxSegmenter(folder) for folder in exported]
    held = [np.fromfile(scans / f"{seed:06d}.bin", np.float32).reshape(-1, 4) for seed in (0, 5)]
    for name, score in (("range_net", "score_range_view"), ("polar_map", "score_polar_view")):
        labels = [
            np.concatenate([getattr(one, score)(points).argmax(axis=1) for points in held])
            for one in runners
        ]
        assert said[name]["agreement"] == pytest.approx((labels[0] == labels[1]).mean(), abs=1e-3)
        assert said[name]["agreement"] >= 0.9


def test_the_graphs_say_nothing_of_the_machine(exported: tuple[Path, Path]) -> None:
    float32, int8 = exported
    assert files(float32) == files(int8)
    for path in int8.iterdir():
        for word in (str(Path(__file__).parents[2]), sys.prefix, "site-packages"):
            assert word.encode() not in path.read_bytes(), path.name


def test_one_scan_and_rows_by_ring_do(scans: Path, tmp_path: Path) -> None:
    weights = replace(without(fresh_weights(NUSCENES), "polar_net", "point_head"), sensor="hdl32e")
    path = save(weights, tmp_path / "w.safetensors")
    assert (
        run_cli(
            "export", "--weights", path, "--out", tmp_path / "out", "--int8", scans / "000003.bin"
        )[0]
        == 0
    )
    points = np.fromfile(scans / "000003.bin", np.float32).reshape(-1, 4)
    assert OnnxSegmenter(tmp_path / "out")(points, np.arange(POINTS) % 16).labels.all()


@pytest.mark.parametrize(
    "case", ["none", "empty", "broken", "lost", "other sensor", "other labels"]
)
def test_mistakes_are_one_line_and_leave_no_files(
    case: str, weights: Weights, scans: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from amvnet.export import int8 as quantising
    from amvnet.export.onnx import export

    given, word = tmp_path / "given", "expected"
    if case not in ("none", "other sensor"):
        given.mkdir()
    if case == "broken":
        (given / "a.bin").write_bytes(b"123")
    if case == "lost":
        np.full((5, 4), np.nan, np.float32).tofile(given / "a.bin")
    if case == "other labels":
        monkeypatch.setattr(quantising, "LEAST_AGREEMENT", 1.01)
        given, word = scans, "calibrate with more scans"
    text = quantising.SIMULATED if case == "other sensor" else str(given)
    if case == "other sensor":
        word = "name scans"
    few = without(weights, "range_net")
    fails(lambda: export(few, tmp_path / "out", int8=text), word)
    assert not files(tmp_path / "out")
