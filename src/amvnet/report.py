"""The tables that a person reads: of an evaluation, and of a weights file."""

from __future__ import annotations

import platform
from collections.abc import Iterator, Mapping
from importlib import metadata
from typing import Any

import torch
from rich.table import Table

from amvnet.bench import FUSION, Timing
from amvnet.data.labels import Taxonomy
from amvnet.recipes import recipe_names
from amvnet.weights import Weights, built_in

TITLES = {
    "rv": "RV",
    "bev": "BEV",
    "arithmetic": "arithmetic mean",
    "maximum": "maximum",
    "ensemble": "ensemble",
    "amvnet": "AMVNet",
}
PACKAGES = ("amvnet", "torch", "lightning", "numpy", "scipy", "safetensors", "trimesh", "embreex", "laspy", "rosbags")
OVERALL = {"miou": "mIoU", "miou_present": "mIoU, classes present", "accuracy": "accuracy", "fwiou": "fwIoU"}


def evaluation_table(report: Mapping[str, Any], taxonomy: Taxonomy) -> Table:
    """One table of an `Evaluation.report`: a row per class, a column per method, the overall figures below."""
    methods = report["methods"]
    table = Table(title=f"{report['dataset']}: {report['scans']} scans, {report['points']:,} points", show_edge=False)
    table.add_column("IoU in %")
    for name in methods:
        table.add_column(TITLES.get(name, name), justify="right")
    for row in _rows(methods, taxonomy):
        if row is None:
            table.add_section()
        else:
            table.add_row(*row)
    if report["uncertain_fraction"] is not None:
        table.caption = f"uncertain points: {report['uncertain_fraction']:.1%}"
    return table


def _rows(methods: Mapping[str, Any], taxonomy: Taxonomy) -> Iterator[list[str] | None]:
    for name in taxonomy.classes:
        yield [name, *(_percent(m["iou"][name]) for m in methods.values())]
    yield None
    for key, title in OVERALL.items():
        yield [title, *(_percent(m[key]) for m in methods.values())]
    yield None
    bins = [m["by_distance"] for m in methods.values()]
    for same in zip(*bins, strict=True):
        yield [f"mIoU, {same[0]['from_m']:.0f} to {same[0]['to_m']:.0f} m", *(_percent(b["miou"]) for b in same)]


def weights_table(weights: Weights, name: str) -> Table:
    """What a weights file is: classes, views, and each part with how it was trained and what it reached."""
    table = Table(title=name, show_header=False, show_edge=False)
    view, grid = weights.model.range_view, weights.model.polar_view
    table.add_row(
        "classes", f"{weights.taxonomy.size} of {weights.taxonomy.name}: {', '.join(weights.taxonomy.classes)}"
    )
    table.add_row("sensor", weights.sensor or "not said")
    field = "by ring" if view.rows == "ring" else f"{view.fov_up:+g} to {view.fov_down:+g} degrees"
    table.add_row("range view", f"{view.height} x {view.width}, {field}")
    table.add_row(
        "polar view",
        f"{grid.radial} x {grid.angular} x {grid.vertical}, {grid.radius_min:g} to {grid.radius_max:g} m, "
        f"height {grid.z_min:g} to {grid.z_max:g} m",
    )
    assertion = weights.model.assertion
    table.add_row("uncertain points", f"{assertion.name}, threshold {assertion.threshold:g}")
    for part in weights.parts:
        table.add_section()
        count = sum(v.numel() for v in weights.part(part).values())
        table.add_row(part, f"{count:,} values")
        for key, value in {**weights.training.get(part, {}), **weights.metrics.get(part, {})}.items():
            table.add_row(f"  {key}", _plain(value))
    return table


def timing_table(timing: Timing) -> Table:
    """Time per stage of one scan, in all, and the fusion's share of it."""
    seconds, total = timing.seconds, sum(timing.seconds.values())
    share = f"{timing.uncertain / timing.points:.1%} of them uncertain"
    table = Table(title=f"{timing.points:,} points, {share}", show_edge=False)
    for title in ("stage", "ms", "share"):
        table.add_column(title, justify="left" if title == "stage" else "right")
    for stage, value in seconds.items():
        table.add_row(stage, f"{1e3 * value:.1f}", f"{value / total:.1%}")
    table.add_section()
    table.add_row("all", f"{1e3 * total:.1f}", "")
    fusion = sum(seconds[stage] for stage in FUSION)
    table.add_row("fusion", f"{1e3 * fusion:.1f}", f"{fusion / total:.1%}")
    return table


def installation_table() -> Table:
    """What is installed: versions, devices, built-in weights and recipes."""
    table = Table(title="AMVNet", show_header=False, show_edge=False)
    for name in PACKAGES:
        table.add_row(name, _version(name))
    table.add_row("python", platform.python_version())
    gpus = [torch.cuda.get_device_name(i) for i in range(torch.cuda.device_count())]
    table.add_row("devices", ", ".join(["cpu", *gpus]))
    table.add_row("threads", str(torch.get_num_threads()))
    table.add_row("weights", ", ".join(built_in()) or "none")
    table.add_row("recipes", ", ".join(recipe_names()))
    return table


def _version(name: str) -> str:
    try:
        return metadata.version(name)
    except metadata.PackageNotFoundError:
        return "not installed"


def _plain(value: Any) -> str:
    if isinstance(value, Mapping):
        return ", ".join(f"{k} {v}" for k, v in value.items())
    if isinstance(value, list):
        return ", ".join(map(str, value))
    return f"{value:.4g}" if isinstance(value, float) else str(value)


def _percent(value: float | None) -> str:
    return "–" if value is None else f"{100 * value:.1f}"
