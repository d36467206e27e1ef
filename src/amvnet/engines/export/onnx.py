"""Write trained networks as ONNX, check them, and describe how to use them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from amvnet.config.nested import to_dict
from amvnet.config.schema import ModelConfig
from amvnet.engines.base import build_model
from amvnet.engines.export.int8 import KEEPS_FIRST_LAYER, quantise
from amvnet.engines.export.onnx_files import digest, finish, quiet
from amvnet.errors import InputError, import_optional
from amvnet.files import Signature, atomic_write, publish, temporary_folder, write_json
from amvnet.models.amvnet import AMVNet
from amvnet.models.methods import MethodName, check_method, widest_method
from amvnet.models.point_head import head_features, point_table
from amvnet.models.polar_net import PolarNet
from amvnet.models.views.points import PointBatch
from amvnet.onnx_runner import DESCRIPTION, FORMAT, GRAPHS_BY_METHOD
from amvnet.progress import Progress, no_progress
from amvnet.scan import FARTHEST, Scan
from amvnet.weights.file import Weights, load
from amvnet.weights.verdict import Verdict

GRAPH = Signature("an ONNX graph", rb"\x08.\x12.(pytorch|onnx)")
DESCRIBED = Signature("a description of ONNX graphs", rb'\{\s*"format": ')
LIBRARIES = ("onnx", "onnxscript", "onnxruntime")  # what the extra `export` installs
# The lowest opset that PyTorch's exporter writes; ONNX Runtime 1.14 is the first to read it.
OPSET = 18
# The largest difference from torch, of probabilities or of features that `_shares` has scaled.
LARGEST_DIFFERENCE = 1e-4
LARGEST_WEIGHTS = 2**28  # the largest size of a tensor that is computed once, bytes
# The number of points of the artificial scan with which the graphs are traced and checked.
EXAMPLE_POINTS = 5000
# The names of the first axis, for graphs in which it may have any length.
DYNAMIC = {
    "polar_points": "points",
    "polar_pillars": "pillars",
    "polar_scores": "pillars",
    "point_head": "uncertain",
}


@dataclass(frozen=True)
class Graph:
    """One part of the method, to be exported.

    Attributes:
        compared: turns outputs into the values that are compared with torch: probabilities, or
            features that `_shares` has scaled.
    """

    module: nn.Module
    inputs: dict[str, Tensor]
    output: str
    compared: Callable[[Tensor], Tensor]


class _Part(nn.Module):
    """A part of a network as a module of its own, with the network's parameters."""

    def __init__(self, net: nn.Module, part: Callable[[Tensor], Tensor]) -> None:
        super().__init__()
        self.net = net
        self.part = part

    def forward(self, x: Tensor) -> Tensor:
        return self.part(x)


def export(
    weights: Weights | Path | str,
    out: Path | str,
    progress: Progress = no_progress,
    scans: Sequence[Scan] = (),
) -> dict[str, dict[str, Any]]:
    """Write the graphs and `amvnet.json` into a folder.

    Args:
        weights: trained weights, or the name or path of a weights file.
        scans: convert the convolutions to int8, calibrated with these scans, which are prepared for
            the networks (`calibration_scans`). Without scans, the graphs are in float32.

    Returns:
        The descriptions of the graphs, by name. The description of a graph in float32 has the
        largest `difference` from torch; in int8, it has the `agreement`, which is the share of the
        labels that stay.

    Raises:
        InputError: if a library is missing, the weights hold no network, a graph differs by
            more than `LARGEST_DIFFERENCE`, or int8 changes too many labels. The folder then stays
            unchanged.
    """
    check_libraries()
    loaded = weights if isinstance(weights, Weights) else load(weights)
    method = check_method(widest_method(loaded.parts), loaded.parts)

    # Write everything into a temporary folder first.
    out = Path(out)
    with temporary_folder(out) as temporary:
        description = _write_all(loaded, method, scans, temporary, progress)
        # After an interruption, the old description must not describe new graphs.
        (out / DESCRIPTION).unlink(missing_ok=True)
        graphs: dict[str, dict[str, Any]] = description["graphs"]
        for name in graphs:
            publish(temporary / f"{name}.onnx", out / f"{name}.onnx")

    with atomic_write(out / DESCRIPTION) as file:
        write_json(file, description)
    return graphs


def possible_files(out: Path) -> dict[Path, Signature]:
    """Return all files that `export` may write into a folder, with the signatures of its files."""
    graphs = {out / f"{name}.onnx": GRAPH for name in GRAPHS_BY_METHOD["amvnet"]}
    return {**graphs, out / DESCRIPTION: DESCRIBED}


def _write_all(
    weights: Weights, method: MethodName, scans: Sequence[Scan], folder: Path, progress: Progress
) -> dict[str, Any]:
    """Write the graphs of a method, in int8 if there are scans; return what `amvnet.json` says."""
    written: dict[str, dict[str, Any]] = {}
    with torch.no_grad():
        graphs = _graphs(weights, method)
        convolutions = [name for name in graphs if scans and name in KEEPS_FIRST_LAYER]
        total = len(graphs) + len(convolutions)
        for name, graph in graphs.items():
            progress(len(written), total)
            written[name] = _write(graph, name, folder / f"{name}.onnx")

    description = describe_export(weights, method, written)
    write_json(folder / DESCRIPTION, description)  # the calibration reads it to run the graphs
    progress(len(graphs), total)

    for count, (name, changes) in enumerate(quantise(folder, convolutions, scans), len(graphs) + 1):
        del written[name]["difference"]
        written[name] |= changes
        progress(count, total)
    return description


def check_libraries() -> None:
    """Raise InputError if a library of the extra `export` is not installed."""
    for name in LIBRARIES:
        import_optional(name, "export")


def describe_export(weights: Weights, method: MethodName, graphs: dict[str, Any]) -> dict[str, Any]:
    """Return everything that a program needs to use the graphs, for JSON."""
    model = weights.model
    taxonomy = weights.taxonomy
    classes = []
    rows = zip(("ignored", *taxonomy.classes), taxonomy.train_to_raw, taxonomy.colors, strict=True)
    for train_id, (name, raw, color) in enumerate(rows):
        classes.append({"id": train_id, "name": name, "raw_id": raw, "color": list(color)})

    verdict = Verdict.of(method, 0, weights.usual_uncertain_at(None))
    description = {
        "format": FORMAT,
        "made_by": f"amvnet {version('amvnet')}, torch {torch.__version__}",
        "method": method,
        "sensor": weights.sensor,
        "points": {"columns": ["x", "y", "z", "intensity"], "farthest": FARTHEST},
        "expects": weights.expects.to_dict(),
        "doubt": {"usual": verdict.usual, "unusual_odds": verdict.unusual_odds},
        "range_view": to_dict(model.range_view),
        "range_channels": ["x", "y", "z", "intensity", "range", "mask"],
        "polar_view": to_dict(model.polar_view),
        "polar_features": [
            "radius - centre",
            "angle - centre",
            "z - centre",
            "radius",
            "angle",
            "z",
            "x",
            "y",
            "intensity",
        ],
        "assertion": {"name": "disagreement", **to_dict(model.assertion)},
    }
    if "point_head" in graphs:
        head = model.point_head
        description["point_head"] = {
            "neighbours": head.neighbours,
            "position_scale": head.position_scale,
            "cell": head.cell,
        }

    described = {"taxonomy": taxonomy.name, "classes": classes, "opset": OPSET, "graphs": graphs}
    return description | described


def _graphs(weights: Weights, method: MethodName) -> dict[str, Graph]:
    """Return the graphs of a method, with example inputs from an artificial scan."""
    model = build_model(weights, method).requires_grad_(False)
    classes = weights.taxonomy.size
    batch = _artificial_scan(weights.model)

    graphs = {}
    if method != "bev":
        image = model.range_view.project(batch).image.contiguous()
        graphs["range_net"] = Graph(model.range_net, {"image": image}, "scores", _probabilities)
    if method != "rv":
        graphs |= _polar_graphs(model, batch, classes)
    if model.point_head is not None and method == "amvnet":
        graphs["point_head"] = _head_graph(model, batch, classes)
    assert tuple(graphs) == GRAPHS_BY_METHOD[method]
    return graphs


def _polar_graphs(model: AMVNet, batch: PointBatch, classes: int) -> dict[str, Graph]:
    """Return the graphs of the bird's-eye-view network; points are pooled between the first two."""
    net = model.polar_net
    assert isinstance(net, PolarNet)
    grid = model.polar_view.project(batch)
    pooled = grid.pool(net.point_mlp(grid.features))
    pillars = grid.to_map(net.compress(pooled)).contiguous()
    decoded = grid.at_pillars(net.unet(pillars))

    def by_voxel(scores: Tensor) -> Tensor:  # (M, Z * K) -> (M, Z, K)
        voxels: Tensor = scores.unflatten(1, (-1, classes))
        return voxels.softmax(dim=2)

    return {
        "polar_points": Graph(
            net.point_mlp, {"features": grid.features}, "point_features", _shares
        ),
        "polar_pillars": Graph(net.compress, {"pooled": pooled}, "pillar_features", _shares),
        "polar_map": Graph(_Part(net, net.unet), {"pillars": pillars}, "decoded", _shares),
        "polar_scores": Graph(_Part(net, net.score), {"decoded": decoded}, "scores", by_voxel),
    }


def _head_graph(model: AMVNet, batch: PointBatch, classes: int) -> Graph:
    head = model.point_head
    assert head is not None
    count = len(batch.points)
    generator = torch.Generator().manual_seed(0)
    f = torch.randn(count, classes, generator=generator).mul(3).softmax(dim=1)
    g = torch.randn(count, classes, generator=generator).mul(3).softmax(dim=1)
    uncertain = torch.arange(0, count, 5)
    # For an example, random points serve as neighbours.
    shape = (len(uncertain), head.config.neighbours)
    near = torch.randint(count, shape, generator=generator)

    table = point_table(batch.points, f, g)
    point, rows = head_features(head.config, table, uncertain, near)
    return Graph(head, {"point": point, "rows": rows}, "scores", _probabilities)


def _artificial_scan(model: ModelConfig) -> PointBatch:
    """Return random points all around the sensor, inside and outside the views, with rings."""
    rng = np.random.default_rng(0)
    view = model.polar_view
    azimuth = rng.uniform(-np.pi, np.pi, EXAMPLE_POINTS)
    distance = rng.uniform(1, 1.2 * view.radius_max, EXAMPLE_POINTS)
    height = rng.uniform(view.z_min, view.z_max, EXAMPLE_POINTS)
    xyz = np.stack([distance * np.cos(azimuth), distance * np.sin(azimuth), height], axis=1)
    points = np.column_stack([xyz, rng.random(EXAMPLE_POINTS)]).astype(np.float32)
    ring = rng.integers(0, model.range_view.height, EXAMPLE_POINTS)

    return PointBatch.of([Scan(points, ring=ring)])


def _probabilities(scores: Tensor) -> Tensor:
    return scores.softmax(dim=1)


def _shares(features: Tensor) -> Tensor:
    """Divide features by the largest magnitude; leave them unchanged if it is below 1."""
    return features / features.abs().max().clamp_min(1)


def _write(graph: Graph, name: str, path: Path) -> dict[str, Any]:
    """Write one graph and compare it with torch; return its description."""
    expected = graph.module(*graph.inputs.values())
    _convert(graph, name, path)
    inputs, outputs, actual = _run(path, graph)
    difference = _difference(graph, expected, actual)
    if not difference <= LARGEST_DIFFERENCE:  # also if it is NaN
        raise InputError(
            f"{name}: expected a difference of at most {LARGEST_DIFFERENCE:g} between ONNX Runtime "
            f"and torch, found {difference:.2g}; use other versions of {', '.join(LIBRARIES)}"
        )
    return {
        "file": path.name,
        "precision": "float32",
        "sha256": digest(path),
        "inputs": inputs,
        "outputs": outputs,
        "difference": difference,
    }


def _convert(graph: Graph, name: str, path: Path) -> None:
    """Write one graph to a file of ONNX."""
    from onnxscript.optimizer import optimize

    axes = None
    if name in DYNAMIC:
        axis = torch.export.Dim(DYNAMIC[name], min=1)
        axes = tuple({0: axis} for _ in graph.inputs)

    with quiet("torch.onnx"):
        program = torch.onnx.export(
            graph.module,
            tuple(graph.inputs.values()),
            input_names=list(graph.inputs),
            output_names=[graph.output],
            opset_version=OPSET,
            dynamo=True,
            dynamic_shapes=axes,
            verbose=False,
        )
        assert program is not None
        # Compute weights that are sums of other weights (`convolve_joined`) only once, in
        # spite of their size: by default, only small tensors count as constants.
        optimize(program.model, input_size_limit=LARGEST_WEIGHTS, output_size_limit=LARGEST_WEIGHTS)
        program.save(path, external_data=False)
    finish(path)


def _run(path: Path, graph: Graph) -> tuple[list[dict[str, Any]], list[dict[str, Any]], Tensor]:
    """Run a graph on its example; return descriptions of its inputs and outputs, and the result."""
    import onnxruntime

    session = onnxruntime.InferenceSession(str(path), providers=["CPUExecutionProvider"])
    feed = {name: value.numpy() for name, value in graph.inputs.items()}
    (result,) = session.run(None, feed)
    inputs = _describe_values(session.get_inputs())
    outputs = _describe_values(session.get_outputs())
    return inputs, outputs, torch.from_numpy(result)


def _describe_values(values: Sequence[Any]) -> list[dict[str, Any]]:
    return [{"name": value.name, "type": "float32", "shape": list(value.shape)} for value in values]


def _difference(graph: Graph, expected: Tensor, actual: Tensor) -> float:
    """Return the largest difference between compared values; infinity if the shapes differ."""
    if expected.shape != actual.shape:
        return float("inf")
    return float((graph.compared(expected) - graph.compared(actual)).abs().max())
