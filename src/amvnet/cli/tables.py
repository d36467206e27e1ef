"""The tables that a person reads: of an evaluation, of times, and of what is installed."""

from __future__ import annotations

import platform
from collections.abc import Iterator, Mapping
from importlib import metadata
from typing import Any

import torch
from rich.table import Table

from amvnet.config.recipes import recipe_names
from amvnet.data.taxonomy import Taxonomy
from amvnet.inference.timing import MEAN, STAGES
from amvnet.models.methods import title_of
from amvnet.weights.file import built_in

PACKAGES = (
    "amvnet",
    "torch",
    "lightning",
    "numpy",
    "scipy",
    "safetensors",
    "trimesh",
    "embreex",
    "laspy",
    "rosbags",
    "huggingface_hub",
)
OVERALL = {
    "miou": "mIoU",
    "miou_present": "mIoU, classes present",
    "accuracy": "accuracy",
    "fwiou": "fwIoU",
}


def evaluation_table(report: Mapping[str, Any], taxonomy: Taxonomy) -> Table:
    """One table of an `Evaluation.report`: a row per class, a column per method, the overall figures below."""
    methods = report["methods"]
    table = Table(
        title=f"{report['dataset']}: {report['scans']} scans, {report['points']:,} points",
        show_edge=False,
    )
    table.add_column("IoU in %")
    for name in methods:
        table.add_column(title_of(name), justify="right")
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
        yield [
            f"mIoU, {same[0]['from_m']:.0f} to {same[0]['to_m']:.0f} m",
            *(_percent(b["miou"]) for b in same),
        ]


def timing_table(report: Mapping[str, Any]) -> Table:
    """One table of `bench.time_jobs`: time per stage, the fusion's share, and the networks' speed."""
    points, uncertain = report["points"], report["uncertain"]
    title = f"{report['engine']} on {report['device']}, {report['threads']} threads: {points:,} points, "
    table = Table(title=title + f"{uncertain / points:.1%} of them uncertain", show_edge=False)
    for name in ("stage", "ms", "half of the runs", "share", "GFLOP", "of the limit"):
        table.add_column(name, justify="left" if name == "stage" else "right")
    stages, total = report["stages_ms"], report["all_ms"]
    for stage in STAGES:
        share = f"{stages[stage]['median'] / total['median']:.1%}"
        table.add_row(stage, *_times(stages[stage]), share, *_speed(report["networks"].get(stage)))
    table.add_section()
    fusion = report["fusion_share"]
    table.add_row("all", *_times(total), f"{report['all_over_networks']['median']:.2f} x networks")
    table.add_row(
        "fusion", "", f"{fusion['low']:.1%} to {fusion['high']:.1%}", f"{fusion['median']:.1%}"
    )
    table.add_row("ensemble instead of it", *_times(stages[MEAN]))
    limits = ", ".join(
        f"{value:,.0f} GFLOP/s in {name}" for name, value in report["limit_gflop_per_s"].items()
    )
    table.caption = (
        f"limit, a large matrix product: {limits}; peak memory {report['peak_memory_mib']:,.0f} MiB"
    )
    return table


def _times(spread: Mapping[str, float]) -> tuple[str, str]:
    return f"{spread['median']:.1f}", f"{spread['low']:.1f} to {spread['high']:.1f}"


def _speed(network: Mapping[str, float] | None) -> tuple[str, ...]:
    return (
        () if network is None else (f"{network['gflop']:.1f}", f"{network['share_of_limit']:.0%}")
    )


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


def _percent(value: float | None) -> str:
    return "–" if value is None else f"{100 * value:.1f}"
