"""Trained networks as ONNX, checked, beside a description of all that one needs to use them."""

from __future__ import annotations

import importlib
import json
import os
import shutil
import uuid
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from amvnet import __version__
from amvnet.config.nested import to_dict
from amvnet.errors import InputError
from amvnet.export.int8 import FIRST_KEPT, calibration_scans, quantise
from amvnet.export.onnx_files import digest, one_line, quiet, strip
from amvnet.files import atomic_write, make_folder
from amvnet.inference.methods import widest_method
from amvnet.inference.segmenter import Segmenter
from amvnet.models.amvnet import AMVNet
from amvnet.models.point_head import head_features, point_table
from amvnet.models.polar_net import PolarNet
from amvnet.models.views.points import PointBatch
from amvnet.onnx_runner import DESCRIPTION, FORMAT, GRAPHS
from amvnet.scan import FARTHEST, Scan
from amvnet.weights.file import Weights, load

EXTRA = ("onnx", "onnxscript", "onnxruntime")
OPSET = 18  # the least that PyTorch's exporter writes; TensorRT 10 and ONNX Runtime 1.14 read it
LARGEST_DIFFERENCE = 1e-4  # of probabilities, and of features as shares of the largest
POINTS = 5000  # of the made scan that the graphs are traced and checked with
# name of the first axis
DYNAMIC = {
    "polar_points": "points",
    "polar_pillars": "pillars",
    "polar_scores": "pillars",
    "point_head": "uncertain",
}


@dataclass(frozen=True)
class Graph:
    """One part as it is exported.

    Attributes:
        module: what is traced.
        inputs: an example of each input, by name.
        output: the output's name.
        compared: what is compared with the module: probabilities, or shares of the largest value.
    """

    module: nn.Module
    inputs: dict[str, Tensor]
    output: str
    compared: Callable[[Tensor], Tensor]


class _Part(nn.Module):
    """What a network does between two of its boundaries, as a module by itself."""

    def __init__(self, net: nn.Module, part: Callable[[Tensor], Tensor]) -> None:
        super().__init__()
        self.net, self.part = net, part

    def forward(self, x: Tensor) -> Tensor:
        return self.part(x)


@dataclass(frozen=True)
class Exported:
    """By how much each graph differs from torch (before int8), and what share of labels stays in those in int8."""

    differences: dict[str, float]
    agreement: dict[str, float]


def export(
    weights: Weights | Path | str,
    out: Path | str,
    progress: Callable[[int, int], None] = lambda done, total: None,
    int8: str | None = None,
) -> Exported:
    """Write the graphs and `amvnet.json` into a folder.

    Args:
        int8: put the convolutions into int8, calibrated with these scans: as `predict` takes them, or `simulated`.

    Raises:
        InputError: where a library is missing, the weights have no network or need labels, there are no scans, or a
            graph cannot be written, differs by more than `LARGEST_DIFFERENCE`, or gives too many points other
            labels in int8; then the folder is as it was.
    """
    check_libraries()
    given = weights if isinstance(weights, Weights) else load(weights)
    segmenter = Segmenter(given, method=widest_method(given))
    scans = [] if int8 is None else calibration_scans(int8, segmenter)
    out = Path(out)
    make_folder(out)
    part = out / f".{uuid.uuid4().hex}.part"
    part.mkdir()
    try:
        said, measured = _write_all(segmenter, scans, part, progress)
        (out / DESCRIPTION).unlink(
            missing_ok=True
        )  # so that it never speaks of another export's graphs
        for name in said["graphs"]:
            os.replace(part / f"{name}.onnx", out / f"{name}.onnx")
    finally:
        shutil.rmtree(part, ignore_errors=True)
    with atomic_write(out / DESCRIPTION) as file:
        _save(said, file)
    return measured


def _write_all(
    segmenter: Segmenter, scans: Sequence[Scan], part: Path, progress: Callable[[int, int], None]
) -> tuple[dict[str, Any], Exported]:
    """Write the graphs, in int8 where there are scans; returns the description, and what was measured."""
    written: dict[str, dict[str, Any]] = {}
    with torch.no_grad():
        graphs = _graphs(segmenter)
        convolutions = [name for name in graphs if scans and name in FIRST_KEPT]
        total = len(graphs) + len(convolutions)
        for name, graph in graphs.items():
            progress(len(written), total)
            written[name] = _write(graph, name, part / f"{name}.onnx")
    measured = Exported({name: one["difference"] for name, one in written.items()}, {})
    said = describe_export(segmenter, written)
    _save(said, part / DESCRIPTION)  # which the graphs are run by
    progress(len(graphs), total)
    for name, anew in quantise(part, convolutions, scans):
        said["graphs"][name] = {
            key: value for key, value in written[name].items() if key != "difference"
        } | anew
        measured.agreement[name] = anew["agreement"]
        progress(len(graphs) + len(measured.agreement), total)
    return said, measured


def _save(said: dict[str, Any], path: Path) -> None:
    path.write_text(json.dumps(said, indent=1) + "\n", encoding="utf-8")


def check_libraries() -> None:
    """Raises InputError where one of the extra's libraries is not installed."""
    for name in EXTRA:
        try:
            importlib.import_module(name)
        except ImportError:
            raise InputError(
                f"expected {name} to export, found none; pip install 'amvnet[export]'"
            ) from None


def describe_export(segmenter: Segmenter, graphs: dict[str, Any]) -> dict[str, Any]:
    """All that a user of the graphs needs to know, for JSON."""
    model, classes = segmenter.weights.model, segmenter.taxonomy
    head = {key: getattr(model.point_head, key) for key in ("neighbours", "position_scale")}
    rows = zip(("ignored", *classes.classes), classes.train_to_raw, classes.colors, strict=True)
    return {
        "format": FORMAT,
        "made_by": f"amvnet {__version__}, torch {torch.__version__}",
        "method": segmenter.method,
        "sensor": segmenter.weights.sensor,
        "points": {"columns": ["x", "y", "z", "intensity"], "farthest": FARTHEST},
        "range_view": to_dict(model.range_view),
        "range_channels": ["x", "y", "z", "intensity", "range", "mask"],
        "polar_view": to_dict(model.polar_view),
        "polar_features": [
            *("radius - centre", "angle - centre", "z - centre"),
            *("radius", "angle", "z", "x", "y", "intensity"),
        ],
        "assertion": to_dict(model.assertion),
        **({"point_head": head} if "point_head" in graphs else {}),
        "taxonomy": classes.name,
        "classes": [
            {"id": id, "name": name, "raw_id": raw, "color": list(color)}
            for id, (name, raw, color) in enumerate(rows)
        ],
        "opset": OPSET,
        "graphs": graphs,
    }


def _graphs(segmenter: Segmenter) -> dict[str, Graph]:
    """The graphs of a method with inputs such as they will see: of a made scan."""
    model, classes = segmenter.model.requires_grad_(False), segmenter.taxonomy.size
    batch = _made_scan(segmenter)
    found = {}
    if segmenter.method != "bev":
        image = model.range_view.project(batch).image
        found["range_net"] = Graph(
            model.range_net, {"image": image.contiguous()}, "scores", _probabilities
        )
    if segmenter.method != "rv":
        found |= _polar_graphs(model, batch, classes)
    if model.point_head is not None and segmenter.method == "amvnet":
        found["point_head"] = _head_graph(model, batch, classes)
    assert tuple(found) == GRAPHS[segmenter.method]
    return found


def _polar_graphs(model: AMVNet, batch: PointBatch, classes: int) -> dict[str, Graph]:
    net, grid = model.polar_net, model.polar_view.project(batch)
    assert isinstance(net, PolarNet)
    pooled = grid.pool(net.point_mlp(grid.features))
    plane = grid.to_map(net.compress(pooled)).contiguous()
    decoded = grid.at_pillars(net.unet(plane))

    def by_voxel(scores: Tensor) -> Tensor:
        return scores.unflatten(1, (-1, classes)).softmax(dim=2)

    return {
        "polar_points": Graph(
            net.point_mlp, {"features": grid.features}, "point_features", _shares
        ),
        "polar_pillars": Graph(net.compress, {"pooled": pooled}, "pillar_features", _shares),
        "polar_map": Graph(_Part(net, net.unet), {"pillars": plane}, "decoded", _shares),
        "polar_scores": Graph(_Part(net, net.score), {"decoded": decoded}, "scores", by_voxel),
    }


def _head_graph(model: AMVNet, batch: PointBatch, classes: int) -> Graph:
    head, count = model.point_head, len(batch.points)
    assert head is not None
    draw = torch.Generator().manual_seed(0)
    f, g = (torch.randn(count, classes, generator=draw).mul(3).softmax(dim=1) for _ in range(2))
    uncertain = torch.arange(0, count, 5)
    near = torch.randint(count, (len(uncertain), head.config.neighbours), generator=draw)
    point, rows = head_features(head.config, point_table(batch.points, f, g), uncertain, near)
    return Graph(head, {"point": point, "rows": rows}, "scores", _probabilities)


def _made_scan(segmenter: Segmenter) -> PointBatch:
    """Points all around the sensor, in and beyond the views, with rings."""
    rng = np.random.default_rng(0)
    view = segmenter.weights.model.polar_view
    azimuth, distance = (
        rng.uniform(-np.pi, np.pi, POINTS),
        rng.uniform(1, 1.2 * view.radius_max, POINTS),
    )
    height = rng.uniform(view.z_min, view.z_max, POINTS)
    xyz = np.stack([distance * np.cos(azimuth), distance * np.sin(azimuth), height], axis=1)
    points = np.column_stack([xyz, rng.random(POINTS)]).astype(np.float32)
    ring = rng.integers(0, segmenter.weights.model.range_view.height, POINTS)
    return PointBatch.of([Scan(points, ring=ring)]).to(segmenter.device)


def _probabilities(scores: Tensor) -> Tensor:
    return scores.softmax(dim=1)


def _shares(features: Tensor) -> Tensor:
    return features / features.abs().max().clamp_min(1)


def _write(graph: Graph, name: str, path: Path) -> dict[str, Any]:
    """Write one graph and compare it with torch; returns its description."""
    expected = graph.module(*graph.inputs.values())
    axes = None
    if name in DYNAMIC:
        axis = torch.export.Dim(DYNAMIC[name], min=1)
        axes = tuple({0: axis} for _ in graph.inputs)
    with quiet("torch.onnx"), one_line(name, "torch.onnx", "torch and onnxscript"):
        torch.onnx.export(
            *(graph.module, tuple(graph.inputs.values()), path),
            input_names=list(graph.inputs),
            output_names=[graph.output],
            opset_version=OPSET,
            dynamo=True,
            dynamic_shapes=axes,
            external_data=False,
            verbose=False,
        )
    strip(path)
    inputs, outputs, found = _run(path, graph)
    difference = _difference(graph, expected, found)
    if not difference <= LARGEST_DIFFERENCE:
        raise InputError(
            f"{name}: expected at most {LARGEST_DIFFERENCE:g} of difference between ONNX Runtime and torch, found "
            f"{difference:.2g}; use other versions of {', '.join(EXTRA)}"
        )
    said = {
        "file": path.name,
        "precision": "float32",
        "sha256": digest(path),
        "inputs": inputs,
        "outputs": outputs,
    }
    return {**said, "difference": difference}


def _run(path: Path, graph: Graph) -> tuple[list[dict[str, Any]], list[dict[str, Any]], Tensor]:
    """The inputs and outputs as the file has them, and what ONNX Runtime makes of the example."""
    import onnxruntime

    session = onnxruntime.InferenceSession(str(path), providers=["CPUExecutionProvider"])
    (found,) = session.run(None, {name: value.numpy() for name, value in graph.inputs.items()})
    inputs, outputs = (
        [{"name": one.name, "type": "float32", "shape": list(one.shape)} for one in some]
        for some in (session.get_inputs(), session.get_outputs())
    )
    return inputs, outputs, torch.from_numpy(found)


def _difference(graph: Graph, expected: Tensor, found: Tensor) -> float:
    if expected.shape != found.shape:
        return float("inf")
    return float((graph.compared(expected) - graph.compared(found)).abs().max())
