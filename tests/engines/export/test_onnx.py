"""Exported graphs say what torch says, and the runner needs no torch."""

from __future__ import annotations

import json
import math
import os
import re
import shlex
import shutil
import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass
from importlib.metadata import packages_distributions, requires
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

import amvnet
from amvnet.data.taxonomy import NUSCENES
from amvnet.engines.export import onnx as onnx_export
from amvnet.engines.export.onnx import describe_export
from amvnet.models.methods import MethodName
from amvnet.onnx_runner import DESCRIPTION, FORMAT, OnnxSegmenter
from amvnet.scan import Scan
from amvnet.sensors.intensity import SIMULATED_QUANTILES
from amvnet.weights.file import Weights, save

from fixtures.commands import fails, files, refusal, refused, run_cli, succeed
from fixtures.examples import first_of
from fixtures.exports import check_versions, shallow_weights
from fixtures.pages import DocsPage
from fixtures.sensors import rings_of
from fixtures.tiny import fresh_weights, street, with_intensities, without

PROJECT = Path(__file__).parents[3]
POINTS = 6000
# The operators of the graphs that TensorRT has, by the table of its ONNX parser
OF_TENSORRT = (
    "Add BatchNormalization Clip Concat Conv Div GRU Gemm LeakyRelu Log MaxPool Mul ReduceMax Relu "
    "Reshape Resize Slice Split Transpose"
)
WEIGHTS: dict[str, Callable[[], Weights]] = {
    "shallow": shallow_weights,
    "deep": fresh_weights,
    "by ring": lambda: fresh_weights(NUSCENES),
}
each_export = pytest.mark.parametrize("name", first_of(WEIGHTS))


@dataclass(frozen=True)
class Export:
    """Weights, and the folder of their exported graphs, which no test may change."""

    weights: Weights
    folder: Path


class Exports(dict[str, Export]):
    """Exports by the names of `WEIGHTS`, each made when a test first needs it."""

    def __init__(self, make_folder: Callable[[str], Path]) -> None:
        super().__init__()
        self._make_folder = make_folder

    def __missing__(self, name: str) -> Export:
        weights = WEIGHTS[name]()
        folder = self._make_folder("graphs")
        graphs = onnx_export.export(weights, folder)
        assert 0 <= max(graph["difference"] for graph in graphs.values()) <= 1e-4
        self[name] = Export(weights, folder)
        return self[name]


@pytest.fixture(scope="module")
def exported(tmp_path_factory: pytest.TempPathFactory, graphs_converted_once: None) -> Exports:
    for library in ("onnx", "onnxscript", "onnxruntime"):
        pytest.importorskip(library)
    return Exports(tmp_path_factory.mktemp)


@pytest.fixture
def folder(exported: Exports, tmp_path: Path) -> Path:
    """A copy that a test may break."""
    return shutil.copytree(exported["shallow"].folder, tmp_path / "copy")


def make_scan(seed: int, count: int = POINTS) -> Scan:
    """Return a street with rings, lost returns, points beyond the grid, and points in one place."""
    points, _ = street(seed, count)
    rng = np.random.default_rng(seed)
    points[rng.integers(0, count, count // 50), 0] = np.nan
    points[rng.integers(0, count, count // 50), :3] *= 5
    points[-3:] = points[:3]
    return Scan(points, ring=rings_of(points, 32))


@each_export
@pytest.mark.parametrize("count", [6, 700, POINTS])
def test_the_runner_says_what_torch_says(exported: Exports, name: str, count: int) -> None:
    scan = make_scan(count, count)
    expected = amvnet.load(exported[name].weights)(scan)
    assert expected.uncertain.any()
    if count == POINTS:
        assert not expected.uncertain[scan.valid].all()

    actual = OnnxSegmenter(exported[name].folder)(scan.points, scan.ring)
    same = expected.uncertain == actual.uncertain
    assert same.mean() >= 0.9999
    assert (expected.labels == actual.labels).mean() >= 0.9999
    assert np.abs(expected.scores - actual.scores)[same].max() <= 1e-4
    assert actual.labels.dtype == np.uint8
    assert actual.scores.dtype == np.float32
    assert not actual.labels[~scan.valid].any()
    assert not actual.scores[~scan.valid].any()


@pytest.mark.parametrize("method", ["ensemble", "rv", "bev"])
def test_other_methods_say_what_torch_says(
    exported: Exports, folder: Path, method: MethodName
) -> None:
    change(folder, "method", to=method)
    scan = make_scan(3)
    expected = amvnet.load(exported["shallow"].weights, method=method)(scan)
    actual = OnnxSegmenter(folder)(scan.points)
    assert (expected.labels == actual.labels).mean() >= 0.9999
    assert (expected.uncertain == actual.uncertain).mean() >= 0.9999


def test_matched_intensities_are_in_the_description(exported: Exports, folder: Path) -> None:
    quantiles = SIMULATED_QUANTILES["hdl64e"]
    weights = with_intensities(exported["shallow"].weights, quantiles, is_matched=True)
    description = describe_export(weights, "amvnet", read_description(folder)["graphs"])
    assert description["expects"]["intensity"]["quantiles"] == list(quantiles)

    change(folder, "expects", to=description["expects"])
    scan = make_scan(3)
    expected = amvnet.load(weights)(scan)
    actual = OnnxSegmenter(folder)(scan.points)
    same = expected.uncertain == actual.uncertain
    assert same.mean() >= 0.9999
    assert np.abs(expected.scores - actual.scores)[same].max() <= 1e-4
    unmatched = amvnet.load(exported["shallow"].weights)(scan)
    assert np.abs(expected.scores - unmatched.scores).max() > 0.001


# ---- the files


def read_description(folder: Path) -> dict[str, Any]:
    return json.loads((folder / "amvnet.json").read_text())


def change(folder: Path, *keys: str, to: object) -> None:
    description = read_description(folder)
    parent = description
    for key in keys[:-1]:
        parent = parent[key]
    parent[keys[-1]] = to
    (folder / "amvnet.json").write_text(json.dumps(description))


@each_export
def test_the_description_says_what_a_program_needs(exported: Exports, name: str) -> None:
    description = read_description(exported[name].folder)
    taxonomy = exported[name].weights.taxonomy
    names = []
    for train_id, described in enumerate(description["classes"]):
        names.append(described["name"])
        assert described["raw_id"] == taxonomy.train_to_raw[train_id]
        assert tuple(described["color"]) == taxonomy.colors[train_id]
    assert names[1:] == list(taxonomy.classes)

    model = exported[name].weights.model
    assert description["sensor"] == "tiny"
    assert description["range_view"]["rows"] == model.range_view.rows
    assert len(description["range_channels"]) == 6
    assert len(description["polar_features"]) == 9
    assert description["assertion"]["threshold"] == model.assertion.threshold
    assert description["doubt"]["usual"] == exported[name].weights.usual_uncertain
    assert description["point_head"] == {
        "neighbours": 4,
        "position_scale": model.point_head.position_scale,
        "cell": model.point_head.cell,
    }

    graphs = description["graphs"]
    uncertain, neighbours = graphs["point_head"]["inputs"]
    width = 2 * taxonomy.size + 4
    assert uncertain["shape"] == ["uncertain", width]
    assert neighbours["shape"] == ["uncertain", 4, width]
    assert graphs["polar_map"]["outputs"][0]["shape"][2:] == [12, 16]
    assert graphs["polar_scores"]["outputs"][0]["shape"] == ["pillars", 4 * taxonomy.size]


@each_export
def test_the_description_is_that_of_the_graphs(exported: Exports, name: str) -> None:
    import onnx

    folder = exported[name].folder
    description = read_description(folder)
    for graph_name, graph in description["graphs"].items():
        model = onnx.load(folder / graph["file"])
        opsets = {opset.domain: opset.version for opset in model.opset_import}
        assert opsets[""] == description["opset"], graph_name
        check_values(graph["inputs"], model.graph.input)
        check_values(graph["outputs"], model.graph.output)


@each_export
def test_onnx_runtime_1_14_takes_the_graphs(exported: Exports, name: str) -> None:
    for path in exported[name].folder.glob("*.onnx"):
        check_versions(path)


@each_export
def test_tensorrt_takes_the_graphs(exported: Exports, name: str) -> None:
    import onnx

    folder = exported[name].folder
    for graph_name, graph in read_description(folder)["graphs"].items():
        model = onnx.load(folder / graph["file"])
        onnx.checker.check_model(model, full_check=True)
        weights = {tensor.name for tensor in model.graph.initializer}
        for node in model.graph.node:
            assert not node.domain
            assert node.op_type in OF_TENSORRT.split(), graph_name
            # Kernels have to be constants, and positions of maxima are not returned.
            assert node.op_type != "Conv" or set(node.input[1:]) <= weights
            assert node.op_type != "MaxPool" or len(node.output) == 1
        if graph_name in ("range_net", "polar_map"):
            sizes = model.graph.input[0].type.tensor_type.shape.dim
            assert all(size.HasField("dim_value") for size in sizes), graph_name


def check_values(described: list[dict[str, Any]], values: Any) -> None:
    """Check the description of the inputs or outputs of a graph."""
    assert len(described) == len(values)
    for description, value in zip(described, values, strict=True):
        dims = value.type.tensor_type.shape.dim
        assert description["name"] == value.name
        assert description["shape"] == [dim.dim_param or dim.dim_value for dim in dims], value.name


def test_the_graphs_say_nothing_of_the_machine(exported: Exports) -> None:
    for path in exported["shallow"].folder.iterdir():
        data = path.read_bytes()
        for word in (str(PROJECT), sys.prefix, "site-packages"):
            assert word.encode() not in data, path.name


# ---- the runner


def modules_beside(*kept: str) -> list[str]:
    """Return the modules of the packages that amvnet requires, except for these packages."""
    required = requires("amvnet") or []
    names = {re.split(r"[^\w-]", line)[0].lower() for line in required if "extra" not in line}
    modules = []
    for module, packages in packages_distributions().items():
        if {package.lower() for package in packages} & names.difference(kept):
            modules.append(module)
    return modules


def test_the_runner_needs_three_packages_and_onnx_runtime_reports_nothing(
    exported: Exports, tmp_path: Path
) -> None:
    """ONNX Runtime keeps what it would report in the user's cache, with an id of the machine."""
    home = tmp_path / "home"
    home.mkdir()
    environment = {name: text for name, text in os.environ.items() if name != "CI"}
    environment.pop("ORT_DISABLE_TELEMETRY", None)
    for name in ("HOME", "TMPDIR", "XDG_CACHE_HOME"):
        environment[name] = str(home)

    points = tmp_path / "points.npy"
    labels = tmp_path / "labels.npy"
    scan = make_scan(5)
    np.save(points, scan.points)
    missing = modules_beside("numpy", "scipy")
    assert {"torch", "yaml", "pykdtree"} <= set(missing)
    code = f"""
import sys
sys.modules.update(dict.fromkeys({missing!r}))  # their imports fail
import numpy as np
from amvnet.onnx_runner import OnnxSegmenter
result = OnnxSegmenter({str(exported["shallow"].folder)!r})(np.load({str(points)!r}))
np.save({str(labels)!r}, result.labels)
"""
    subprocess.run([sys.executable, "-c", code], env=environment, check=True)
    expected = amvnet.load(exported["shallow"].weights)(scan).labels
    assert (np.load(labels) == expected).mean() >= 0.9999
    assert not list(home.iterdir())


def remove(name: str) -> Callable[[Path], None]:
    return lambda folder: (folder / name).unlink()


def write(name: str, text: str) -> Callable[[Path], object]:
    return lambda folder: (folder / name).write_text(text)


def truncate_range_net(folder: Path) -> None:
    path = folder / "range_net.onnx"
    data = path.read_bytes()
    path.write_bytes(data[: len(data) // 2])


def replace_range_net(folder: Path) -> None:
    shutil.copy(folder / "polar_map.onnx", folder / "range_net.onnx")


@pytest.mark.parametrize(
    ("break_folder", "word"),
    [
        (remove("amvnet.json"), "amvnet.json"),
        (write("amvnet.json", "{"), "amvnet.json"),
        (write("amvnet.json", "[]"), f"format {FORMAT}"),
        (write("amvnet.json", "[" * 100_000), "amvnet.json"),
        (write("amvnet.json", "9" * 20_000_000), "amvnet.json"),
        (remove("point_head.onnx"), "point_head.onnx"),
        (truncate_range_net, "range_net.onnx"),
        (replace_range_net, "range_net.onnx"),
    ],
)
def test_a_broken_folder_is_one_line(
    folder: Path, break_folder: Callable[[Path], object], word: str
) -> None:
    break_folder(folder)
    fails(lambda: OnnxSegmenter(folder), word, "export again")


def intensities(quantiles: list[float]) -> dict[str, Any]:
    return {"quantiles": quantiles, "is_optional": False, "is_matched": True}


@pytest.mark.parametrize(
    ("keys", "value", "words"),
    [
        ("method", ["rv"], ("method", "export again")),
        ("graphs", 3, ("range_net", "export again")),
        ("graphs polar_map", {}, ("polar_map", "export again")),
        ("graphs polar_map inputs", [{"name": 1, "shape": 2}], ("polar_map", "export again")),
        ("graphs polar_map file", "../polar_map.onnx", ("polar_map", "export again")),
        ("graphs polar_map file", "a" * 5000, ("polar_map", "export again")),
        ("range_view height", -4, ("height",)),
        ("range_view height", 10**12, ("height",)),
        ("polar_view radial", 10**12, ("radial",)),
        ("polar_view z_max", math.inf, ("z_max",)),
        ("range_view fov_up", math.nan, ("fov_up",)),
        ("point_head neighbours", 10**12, ("neighbours",)),
        ("point_head position_scale", 10**400, ("position_scale",)),
        ("assertion threshold", math.nan, ("threshold",)),
        ("range_view width", 32, ("range_net", "export again")),
        ("expects", None, ("networks expect", "export again")),
        ("expects intensity", [0.5] * 11, ("networks expect", "export again")),
        ("expects intensity", intensities([0.5, math.nan]), ("quantiles", "export again")),
        ("expects intensity", intensities([10**400] * 11), ("quantiles", "export again")),
        ("expects intensity", intensities([0.0] * 11), ("quantiles", "export again")),
        ("assertion", {"threshold": -5.0}, ("threshold", "-5")),
        ("point_head neighbours", 3, ("point_head", "export again")),
    ],
)
def test_a_wrong_description_is_one_line(
    folder: Path, keys: str, value: object, words: tuple[str, ...]
) -> None:
    change(folder, *keys.split(), to=value)
    fails(lambda: OnnxSegmenter(folder), *words)


@pytest.mark.full
def test_missing_and_wrong_rings_are_one_line(exported: Exports) -> None:
    by_ring = OnnxSegmenter(exported["by ring"].folder)
    points = make_scan(0, 10).points[:4]
    fails(lambda: by_ring(points), "ring index")
    fails(lambda: by_ring(points, np.full(4, 99)), "0 to 31")


def test_wrong_scans_are_one_line(exported: Exports) -> None:
    by_elevation = OnnxSegmenter(exported["shallow"].folder)
    points = make_scan(0, 10).points[:4]
    fails(lambda: by_elevation(points[:, :3]), "(N, 4)")
    fails(lambda: by_elevation(np.full((3, 4), np.nan)), "finite")


# ---- the command


def test_the_command_exports_one_network(exported: Exports, tmp_path: Path) -> None:
    weights = without(exported["shallow"].weights, "range_net", "point_head")
    path = save(weights, tmp_path / "w.safetensors")
    succeed(f"export --weights {path} --out {tmp_path}/out")
    assert files(tmp_path / "out") == {
        "amvnet.json",
        "polar_points.onnx",
        "polar_pillars.onnx",
        "polar_map.onnx",
        "polar_scores.onnx",
    }
    assert OnnxSegmenter(tmp_path / "out")(make_scan(1).points).labels.any()


def test_mistakes_of_the_command_are_one_line(exported: Exports, tmp_path: Path) -> None:
    weights = exported["shallow"].weights
    polar_only = save(without(weights, "range_net", "point_head"), tmp_path / "polar.safetensors")
    head_only = save(without(weights, "range_net", "polar_net"), tmp_path / "head.safetensors")
    (tmp_path / "file").write_text("")

    refusal(f"export --weights {tmp_path}/none --out {tmp_path}/none_out")
    refusal(f"export --weights {polar_only} --out {tmp_path}/file")
    refusal(f"export --weights {head_only} --out {tmp_path}/head_out")
    assert not (tmp_path / "head_out").exists()


def test_a_graph_that_differs_leaves_no_files(
    exported: Exports, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = onnx_export._run

    def run_wrongly(path: Path, graph: onnx_export.Graph) -> tuple[Any, Any, Tensor]:
        inputs, outputs, result = run(path, graph)
        channels = torch.linspace(0, 1, result.shape[1])
        shape = [1, -1] + [1] * (result.ndim - 2)
        return inputs, outputs, result + channels.view(shape)

    monkeypatch.setattr(onnx_export, "_run", run_wrongly)
    weights = without(exported["shallow"].weights, "range_net", "point_head")
    fails(lambda: onnx_export.export(weights, tmp_path), "polar_points", "difference")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("library", ["onnx", "onnxscript", "onnxruntime"])
def test_without_the_extra_the_command_is_said(
    library: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("onnx")
    monkeypatch.setitem(sys.modules, library, None)
    refused(f"export --weights sim-hdl64e --out {tmp_path}/out", 'pip install "amvnet[export]"')
    assert not (tmp_path / "out").exists()


def test_the_runner_without_its_runtime_says_the_command(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "onnxruntime", None)
    fails(lambda: OnnxSegmenter(folder), "pip install onnxruntime")


@pytest.mark.full
def test_the_page_runs(exported: Exports, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    polar_only = without(exported["shallow"].weights, "range_net", "point_head")
    save(polar_only, tmp_path / "weights.safetensors")
    (tmp_path / "scans").mkdir()
    for path in ("scan.bin", "scans/0.bin"):
        make_scan(1).points.tofile(tmp_path / path)

    for words in DocsPage("docs/export.md").commands:
        command = shlex.join(words)
        if words[0] == "amvnet":
            smaller = [word.replace("sim-hdl64e", "weights.safetensors") for word in words[1:]]
            assert run_cli(*smaller)[0] == 0, command
        else:
            assert words[:2] == ["pip", "install"], command

    scope: dict[str, Any] = {}
    page = (PROJECT / "docs/export.md").read_text(encoding="utf-8")
    for block in re.findall(r"(?s)```python\n(.*?)```", page):
        exec(block, scope)
    assert len(scope["result"].labels) == POINTS


def test_a_graph_that_computes_nan_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(onnx_export, "_convert", lambda *arguments: None)
    monkeypatch.setattr(onnx_export, "_run", lambda *arguments: ([], [], torch.ones(2, 3)))
    monkeypatch.setattr(onnx_export, "_difference", lambda *arguments: math.nan)
    graph = onnx_export.Graph(torch.nn.ReLU(), {"x": torch.ones(2, 3)}, "y", torch.abs)
    fails(lambda: onnx_export._write(graph, "range_net", tmp_path / "a.onnx"), "range_net", "nan")


def test_an_interrupted_export_leaves_no_description_of_other_graphs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def write(weights: object, method: object, scans: object, folder: Path, step: object) -> Any:
        (folder / "range_net.onnx").write_bytes(b"new")
        return {"graphs": {"range_net": {}}}

    def stop(part: Path, path: Path) -> None:
        raise KeyboardInterrupt

    (tmp_path / DESCRIPTION).write_text("of earlier graphs")
    monkeypatch.setattr(onnx_export, "_write_all", write)
    monkeypatch.setattr(onnx_export, "publish", stop)
    with pytest.raises(KeyboardInterrupt):
        onnx_export.export(fresh_weights(), tmp_path)
    assert not list(tmp_path.iterdir())
