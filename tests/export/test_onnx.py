"""Exported graphs say what torch says, and the runner needs no torch. Skipped without ONNX Runtime."""

from __future__ import annotations

import json
import re
import shlex
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch

from amvnet.data.taxonomy import NUSCENES, SEMANTICKITTI
from amvnet.inference.segmenter import Segmenter
from amvnet.models.methods import Method
from amvnet.models.neighbours import nearest_others
from amvnet.onnx_runner import OnnxSegmenter, pool
from amvnet.scan import Scan
from amvnet.weights.file import Weights, save

from fixtures.worlds import commands_of, fails, files, fresh_weights, run_cli, street, without

DOCS = Path(__file__).parents[2] / "docs"
POINTS = 6000
TAXONOMIES = {"elevation": SEMANTICKITTI, "ring": NUSCENES}  # by what fresh_weights' rows are


@pytest.fixture(scope="module")
def exported(tmp_path_factory: pytest.TempPathFactory) -> dict[str, tuple[Weights, Path]]:
    for library in ("onnx", "onnxscript", "onnxruntime"):
        pytest.importorskip(library)
    from amvnet.export.onnx import export

    found = {}
    for rows, taxonomy in TAXONOMIES.items():
        found[rows] = fresh_weights(taxonomy), tmp_path_factory.mktemp(rows)
        assert 0 <= max(export(*found[rows]).differences.values()) <= 1e-4
    return found


@pytest.fixture
def folder(exported: dict[str, tuple[Weights, Path]], tmp_path: Path) -> Path:
    """A copy that a test may break."""
    return Path(shutil.copytree(exported["elevation"][1], tmp_path / "copy"))


def scan_of(seed: int, count: int = POINTS) -> Scan:
    """A street with lost returns, points beyond the grid, two in one place, and rings."""
    points = street(seed, count)[0]
    rng = np.random.default_rng(seed)
    points[rng.integers(0, count, count // 50), 0] = np.nan
    points[rng.integers(0, count, count // 50), :3] *= 5
    points[-3:] = points[:3]
    return Scan(points, ring=rng.integers(0, 16, count))


@pytest.mark.parametrize("rows", TAXONOMIES)
@pytest.mark.parametrize("count", [6, 700, POINTS])
def test_the_runner_says_what_torch_says(
    exported: dict[str, tuple[Weights, Path]], rows: str, count: int
) -> None:
    weights, folder = exported[rows]
    scan = scan_of(count, count)
    expected, found = Segmenter(weights)(scan), OnnxSegmenter(folder)(scan.points, scan.ring)
    assert expected.uncertain.any()
    assert count < POINTS or not expected.uncertain[scan.valid].all()
    same = expected.uncertain == found.uncertain
    assert same.mean() >= 0.9999
    assert (expected.labels == found.labels).mean() >= 0.9999
    assert np.abs(expected.scores - found.scores)[same].max() <= 1e-4
    assert found.labels.dtype == np.uint8
    assert found.scores.dtype == np.float32
    assert not found.labels[~scan.valid].any()
    assert not found.scores[~scan.valid].any()


@pytest.mark.parametrize("rows", TAXONOMIES)
def test_the_networks_alone_say_what_torch_says(
    exported: dict[str, tuple[Weights, Path]], rows: str
) -> None:
    weights, folder = exported[rows]
    scan, runner = scan_of(7), OnnxSegmenter(folder)
    expected, valid = Segmenter(weights)(scan), scan.valid
    assert scan.ring is not None
    assert expected.rv is not None
    assert expected.bev is not None
    f = runner.score_range_view(scan.points[valid], scan.ring[valid])
    assert np.abs(f - expected.rv[valid]).max() <= 1e-4
    assert np.abs(runner.score_polar_view(scan.points[valid]) - expected.bev[valid]).max() <= 1e-4


@pytest.mark.parametrize("method", ["ensemble", "rv", "bev"])
def test_other_methods_say_what_torch_says(
    exported: dict[str, tuple[Weights, Path]], folder: Path, method: Method
) -> None:
    _change(folder, "method", to=method)
    scan = scan_of(3)
    expected = Segmenter(exported["elevation"][0], method=method)(scan)
    found = OnnxSegmenter(folder)(scan.points)
    assert (expected.labels == found.labels).mean() >= 0.9999
    assert (expected.uncertain == found.uncertain).mean() >= 0.9999


def test_the_description_says_what_a_program_needs(
    exported: dict[str, tuple[Weights, Path]],
) -> None:
    import onnx

    weights, folder = exported["ring"]
    said = json.loads((folder / "amvnet.json").read_text())
    assert [one["name"] for one in said["classes"][1:]] == list(NUSCENES.classes)
    assert [one["raw_id"] for one in said["classes"]] == list(NUSCENES.train_to_raw)
    assert [tuple(one["color"]) for one in said["classes"]] == list(NUSCENES.colors)
    assert said["range_view"]["rows"] == "ring"
    assert said["sensor"] == "tiny"
    assert said["assertion"]["threshold"] == weights.model.assertion.threshold
    assert said["point_head"] == {
        "neighbours": 4,
        "position_scale": weights.model.point_head.position_scale,
    }
    assert len(said["polar_features"]) == 9
    assert len(said["range_channels"]) == 6
    for name, graph in said["graphs"].items():
        model = onnx.load(folder / graph["file"])
        assert {one.domain: one.version for one in model.opset_import}[""] == said["opset"], name
        for ours, theirs in (
            (graph["inputs"], model.graph.input),
            (graph["outputs"], model.graph.output),
        ):
            shapes = [
                [d.dim_param or d.dim_value for d in one.type.tensor_type.shape.dim]
                for one in theirs
            ]
            assert [one["shape"] for one in ours] == shapes, name
            assert [one["name"] for one in ours] == [one.name for one in theirs], name
    shapes = {
        name: [one["shape"] for one in graph["inputs"]] for name, graph in said["graphs"].items()
    }
    assert shapes["point_head"] == [["uncertain", 36], ["uncertain", 4, 36]]
    assert said["graphs"]["polar_map"]["outputs"][0]["shape"][2:] == [12, 16]
    assert said["graphs"]["polar_scores"]["outputs"][0]["shape"] == ["pillars", 4 * 16]


def test_the_graphs_say_nothing_of_the_machine(exported: dict[str, tuple[Weights, Path]]) -> None:
    for path in exported["elevation"][1].iterdir():
        data = path.read_bytes()
        for word in (str(Path(__file__).parents[2]), sys.prefix, "site-packages"):
            assert word.encode() not in data, path.name


def test_the_runner_needs_no_torch(
    exported: dict[str, tuple[Weights, Path]], tmp_path: Path
) -> None:
    weights, folder = exported["elevation"]
    scan = scan_of(5)
    np.save(tmp_path / "points.npy", scan.points)
    code = f"""
import sys
sys.modules["torch"] = None  # an import fails
import numpy as np
from amvnet.onnx_runner import OnnxSegmenter
result = OnnxSegmenter({str(folder)!r})(np.load({str(tmp_path / "points.npy")!r}))
np.save({str(tmp_path / "labels.npy")!r}, result.labels)
"""
    subprocess.run([sys.executable, "-c", code], check=True, timeout=60)
    assert (np.load(tmp_path / "labels.npy") == Segmenter(weights)(scan).labels).mean() >= 0.9999


def test_pooling_is_the_maximum_of_each_pillar() -> None:
    rng = np.random.default_rng(0)
    pillar, features = rng.integers(0, 9, 50), rng.normal(size=(50, 3)).astype(np.float32)
    occupied, pooled = pool(pillar, features)
    assert occupied.tolist() == sorted(set(pillar.tolist()))
    for place, values in zip(occupied, pooled, strict=True):
        assert values.tolist() == [
            max(features[i, c] for i in range(50) if pillar[i] == place) for c in range(3)
        ]


def test_neighbours_are_the_nearest_of_all_others() -> None:
    xyz = np.random.default_rng(0).normal(size=(40, 3)).astype(np.float32)
    for own, near in enumerate(nearest_others(xyz, np.arange(40), 5)):
        far = [float(np.linalg.norm(xyz[i] - xyz[own])) if i != own else np.inf for i in range(40)]
        assert near.tolist() == sorted(range(40), key=far.__getitem__)[:5]


def _cut(folder: Path) -> None:
    data = (folder / "range_net.onnx").read_bytes()
    (folder / "range_net.onnx").write_bytes(data[: len(data) // 2])


def _change(folder: Path, *keys: str, to: object) -> None:
    said = json.loads((folder / "amvnet.json").read_text())
    place = said
    for key in keys[:-1]:
        place = place[key]
    place[keys[-1]] = to
    (folder / "amvnet.json").write_text(json.dumps(said))


@pytest.mark.parametrize(
    ("breaks", "word"),
    [
        (lambda folder: (folder / "amvnet.json").unlink(), "amvnet.json"),
        (lambda folder: (folder / "amvnet.json").write_text("{"), "amvnet.json"),
        (lambda folder: (folder / "amvnet.json").write_text("[]"), "format 2"),
        (lambda folder: _change(folder, "method", to=["rv"]), "method"),
        (lambda folder: _change(folder, "graphs", to=3), "range_net"),
        (lambda folder: _change(folder, "graphs", "polar_map", to={}), "polar_map"),
        (
            lambda folder: _change(
                folder, "graphs", "polar_map", "inputs", to=[{"name": 1, "shape": 2}]
            ),
            "polar_map",
        ),
        (lambda folder: _change(folder, "range_view", "height", to=-4), "height"),
        (lambda folder: _change(folder, "range_view", "width", to=32), "range_net"),
        (lambda folder: _change(folder, "point_head", "neighbours", to=3), "point_head"),
        (lambda folder: (folder / "point_head.onnx").unlink(), "point_head.onnx"),
        (_cut, "range_net.onnx"),
        (
            lambda folder: shutil.copy(folder / "polar_map.onnx", folder / "range_net.onnx"),
            "range_net.onnx",
        ),
    ],
)
def test_a_broken_folder_is_one_line(
    folder: Path, breaks: Callable[[Path], object], word: str
) -> None:
    breaks(folder)
    fails(lambda: OnnxSegmenter(folder), word, "export again" if word != "height" else "height")


def test_wrong_scans_are_one_line(exported: dict[str, tuple[Weights, Path]]) -> None:
    by_ring, by_elevation = (
        OnnxSegmenter(exported["ring"][1]),
        OnnxSegmenter(exported["elevation"][1]),
    )
    points = scan_of(0, 10).points[:4]
    fails(lambda: by_ring(points), "ring index")
    fails(lambda: by_ring(points, np.full(4, 99)), "0 to 31")
    fails(lambda: by_elevation(points[:, :3]), "(N, 4)")
    fails(lambda: by_elevation(np.full((3, 4), np.nan)), "finite")


def test_the_verb_exports_and_its_mistakes_are_one_line(
    exported: dict[str, tuple[Weights, Path]], tmp_path: Path
) -> None:
    weights = exported["elevation"][0]
    path = save(without(weights, "range_net", "point_head"), tmp_path / "w.safetensors")
    assert run_cli("export", "--weights", path, "--out", tmp_path / "out")[0] == 0
    assert files(tmp_path / "out") == {
        "amvnet.json",
        "polar_points.onnx",
        "polar_pillars.onnx",
        "polar_map.onnx",
        "polar_scores.onnx",
    }
    assert OnnxSegmenter(tmp_path / "out")(scan_of(1).points).labels.any()
    code, line = run_cli("export", "--weights", tmp_path / "none", "--out", tmp_path / "none_out")
    assert code == 2
    assert line.count("\n") == 1
    (tmp_path / "file").write_text("")
    code, line = run_cli("export", "--weights", path, "--out", tmp_path / "file")
    assert code == 2
    assert line.count("\n") == 1
    head_only = save(without(weights, "range_net", "polar_net"), tmp_path / "head.safetensors")
    code, line = run_cli("export", "--weights", head_only, "--out", tmp_path / "head_out")
    assert code == 2
    assert line.count("\n") == 1
    assert not (tmp_path / "head_out").exists()


def test_a_graph_that_differs_leaves_no_files(
    exported: dict[str, tuple[Weights, Path]], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from amvnet.export import onnx as module

    run = module._run

    def wrong(path: Path, graph: module.Graph) -> tuple[object, object, torch.Tensor]:
        inputs, outputs, found = run(path, graph)
        return (
            inputs,
            outputs,
            found + torch.linspace(0, 1, found.shape[1]).view(1, -1, *[1] * (found.ndim - 2)),
        )

    monkeypatch.setattr(module, "_run", wrong)
    weights = without(exported["elevation"][0], "range_net", "point_head")
    fails(lambda: module.export(weights, tmp_path), "polar_points", "difference")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("library", ["onnx", "onnxscript", "onnxruntime"])
def test_without_the_extra_the_command_is_said(
    library: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("onnx")
    monkeypatch.setitem(sys.modules, library, None)
    code, line = run_cli("export", "--weights", "sim-hdl64e", "--out", tmp_path / "out")
    assert code == 2
    assert line.count("\n") == 1
    assert "pip install 'amvnet[export]'" in line
    assert not (tmp_path / "out").exists()


def test_the_runner_without_its_runtime_says_the_command(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "onnxruntime", None)
    fails(lambda: OnnxSegmenter(folder), "pip install onnxruntime")


def test_the_page_runs(
    exported: dict[str, tuple[Weights, Path]], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    quick = without(exported["elevation"][0], "range_net", "point_head")
    save(quick, tmp_path / "weights.safetensors")
    (tmp_path / "scans").mkdir()
    for path in ("scan.bin", "scans/0.bin"):
        scan_of(1).points.tofile(tmp_path / path)
    for words in commands_of("docs/export.md"):
        if words[0] == "amvnet":
            small = ["weights.safetensors" if word == "sim-hdl64e" else word for word in words]
            assert run_cli(*small[1:])[0] == 0, shlex.join(words)
        else:
            assert words[:2] == ["pip", "install"], shlex.join(words)
    scope: dict[str, object] = {}
    for block in re.findall(
        r"(?s)```python\n(.*?)```", (DOCS / "export.md").read_text(encoding="utf-8")
    ):
        exec(block, scope)
    assert len(scope["result"].labels) == POINTS  # type: ignore[attr-defined]
