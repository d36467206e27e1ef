"""Make the tables that commands print."""

from __future__ import annotations

import platform
import re
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from importlib import metadata
from typing import Any

import torch
from rich.table import Table

from amvnet.config.recipes import load_recipe, recipe_names
from amvnet.data.check import Report
from amvnet.data.taxonomy import Taxonomy
from amvnet.errors import counted, installation
from amvnet.evaluation.metrics import OVERALL
from amvnet.inference.journal import Entry
from amvnet.inference.timing import MEAN, STAGES
from amvnet.models.methods import title_of
from amvnet.sensors.lidars import KNOWN_SENSORS
from amvnet.weights.file import built_in, load

MISSING = "not installed"
# What users need the extras for; `docs` and `test` are for developers.
EXTRAS = {
    "simulate": "amvnet demo, simulate and adapt",
    "formats": ".las, .laz and bags",
    "feather": ".feather",
    "drives": "poses of drives that have none",
    "export": "export, --engine onnx and int8",
    "fleet": "amvnet fleet",
    "hub": "weights on the Hugging Face hub",
}


def _table(title: str | None, texts: Iterable[str], numbers: Iterable[str]) -> Table:
    """Return an empty table, given the titles of its columns; numbers are aligned at the right."""
    table = Table(title=title, show_edge=False)
    for name in texts:
        table.add_column(name)
    for name in numbers:
        table.add_column(name, justify="right")
    return table


def evaluation_table(report: Mapping[str, Any], taxonomy: Taxonomy) -> Table:
    """Return the table of a report of `Evaluation`: a row for each class, a column for each method.

    The overall figures and the mIoU by distance follow below the classes.
    """
    methods = report["methods"]
    title = f"{report['dataset']}: {counted(report['scans'], 'scan')}, {report['points']:,} points"
    if "tau" in report:
        title += f", tau: {report['tau']}"
    table = _table(title, ["IoU in %"], map(title_of, methods))
    for name in taxonomy.classes:
        table.add_row(name, *[_percent(method["iou"][name]) for method in methods.values()])
    table.add_section()
    for key, row_title in OVERALL.items():
        table.add_row(row_title, *[_percent(method[key]) for method in methods.values()])
    table.add_section()
    # Each row is a range of distances, and has the figures of all methods.
    for row in zip(*[method["by_distance"] for method in methods.values()], strict=True):
        row_title = f"mIoU, {row[0]['from_m']:.0f} to {row[0]['to_m']:.0f} m"
        table.add_row(row_title, *[_percent(figure["miou"]) for figure in row])

    if report["uncertain_fraction"] is not None:
        table.caption = f"uncertain points: {report['uncertain_fraction']:.1%}"
    return table


def contents_table(report: Report) -> Table:
    """Return the table of the points and the scans of each class in a dataset."""
    splits = {name: split for name, split in report.splits.items() if split.scans}
    columns = []
    for name in splits:
        columns += [f"{name}: points", "in %", "scans"]
    table = _table(report.spec, ["class"], columns)
    names = ("ignored", *report.taxonomy.classes)
    for train_id in (*range(1, len(names)), 0):  # ignored points last
        cells = []
        for split in splits.values():
            points = int(split.points[train_id])
            share = _percent(points / max(int(split.points.sum()), 1))
            cells += [f"{points:,}", share, str(split.scans_with[train_id])]
        table.add_row(names[train_id], *cells)

    table.add_section()
    totals = []
    for split in splits.values():
        totals += [f"{int(split.points.sum()):,}", "", str(len(split.scans))]
    table.add_row("all", *totals)
    return table


def labelled_table(entries: Sequence[Entry], taxonomy: Taxonomy) -> Table:
    """Return the table of the points of each class in the labels of some scans, most first."""
    totals = Counter[str]()
    for entry in entries:
        totals.update(dict(zip(taxonomy.names, entry.counts, strict=False)))
        totals["own car (no label)"] += entry.own
    table = _table(None, ["class"], ["points", "in %"])
    for name, points in totals.most_common():
        if points:
            table.add_row(name, f"{points:,}", _percent(points / totals.total()))
    return table


def unknown_table(report: Report) -> Table:
    """Return the table of the ids that belong to no class and are not ignored."""
    table = _table("ids of no class", [], ["id", "points", "scans"])
    table.add_column("for example", overflow="fold")
    for raw_id, entry in report.unknown.items():
        table.add_row(str(raw_id), f"{entry.points:,}", str(entry.scans), str(entry.example))
    return table


def timing_table(report: Mapping[str, Any]) -> Table:
    """Return the table of the time of each stage, given a report of `time_runs`."""
    points = report["points"]
    title = (
        f"{report['engine']} on {report['device']} in {report['precision']}, "
        f"{counted(report['threads'], 'thread')}: {points:,} points, "
        f"{report['uncertain'] / points:.1%} of them uncertain"
    )
    table = _table(title, ["stage"], ["ms", "quartiles", "share"])
    stages = report["stages_ms"]
    total = report["all_ms"]
    for stage in STAGES:
        share = f"{stages[stage]['median'] / total['median']:.1%}"
        table.add_row(stage, *_times(stages[stage]), share)
    table.add_section()

    fusion = report["fusion_share"]
    quartiles = f"{fusion['low']:.1%} to {fusion['high']:.1%}"
    table.add_row("all", *_times(total))
    table.add_row("fusion", "", quartiles, f"{fusion['median']:.1%}")
    table.add_row("ensemble instead of it", *_times(stages[MEAN]))

    table.caption = f"peak memory {report['peak_memory_mib']:,.0f} MiB"
    return table


def _times(spread: Mapping[str, float]) -> tuple[str, str]:
    """Return the texts of the median and of the range between the quartiles, milliseconds."""
    return f"{spread['median']:.1f}", f"{spread['low']:.1f} to {spread['high']:.1f}"


def weights_table() -> Table:
    """Return the table of the built-in weights."""
    table = Table(title="weights", show_edge=False)
    table.add_column("--weights", no_wrap=True)
    for name in ("sensor", "classes", "range image", "mIoU in %"):
        table.add_column(name)
    for name in built_in():
        weights = load(name)
        image = weights.model.range_view
        miou = weights.metrics.get("point_head", {}).get("val/miou")
        table.add_row(
            name,
            weights.sensor,
            f"{weights.taxonomy.size} of {weights.taxonomy.name}",
            f"{image.height} x {image.width}",
            _percent(miou),
        )
    table.caption = "mIoU of AMVNet in the validation of its training"
    return table


def recipes_table() -> Table:
    """Return the table of the built-in recipes."""
    table = Table(title="recipes", show_edge=False)
    table.add_column("amvnet train", no_wrap=True)
    for name in ("classes", "epochs", "range image"):
        table.add_column(name)
    for name in recipe_names():
        recipe = load_recipe(name)
        epochs = [f"{stage} {getattr(recipe.training, stage).epochs}" for stage in recipe.stages]
        image = recipe.model.range_view
        table.add_row(
            name,
            "of --data" if recipe.from_init else recipe.taxonomy,
            ", ".join(epochs),
            "of --init" if recipe.from_init else f"{image.height} x {image.width}",
        )
    return table


def sensors_table() -> Table:
    """Return the table of the sensors that are known by name."""
    table = _table("sensors", ["--sensor"], ["lasers", "up to", "down to"])
    for name, sensor in KNOWN_SENSORS.items():
        table.add_row(
            name, str(sensor.beams), f"{sensor.fov_up:+g} degrees", f"{sensor.fov_down:+g} degrees"
        )
    table.caption = "amvnet simulate makes scans of each of them"
    return table


def installation_table() -> Table:
    """Return the table of the installation: versions and devices."""
    table = Table(title="AMVNet", show_header=False, show_edge=False)
    for name in ("amvnet", *_required("")):
        table.add_row(name, _version(name))
    table.add_row("python", platform.python_version())

    devices = ["cpu"]
    for index in range(torch.cuda.device_count()):
        devices.append(torch.cuda.get_device_name(index))
    table.add_row("devices", ", ".join(devices))
    table.add_row("threads", str(torch.get_num_threads()))
    return table


def extras_table() -> Table:
    """Return the table of the extras: what they are for, and what installs those that miss."""
    table = Table(title="extras", show_edge=False)
    for name in ("extra", "for", "installed"):
        table.add_column(name, overflow="fold")
    for extra, purpose in EXTRAS.items():
        is_installed = all(_version(name) != MISSING for name in _required(extra))
        found = "yes" if is_installed else f"no: {installation(extra)}"
        table.add_row(extra, purpose, found)
    return table


def _required(extra: str) -> list[str]:
    """Return the packages that an extra needs, or without an extra those that are always needed."""
    names = []
    for line in metadata.requires("amvnet") or ():
        of_extra = re.search(r"extra == ['\"](.+?)['\"]", line)
        if (of_extra[1] if of_extra else "") == extra:
            names.append(re.split(r"[^\w.-]", line)[0])
    return list(dict.fromkeys(names))  # each package once


def _version(name: str) -> str:
    try:
        return metadata.version(name)
    except metadata.PackageNotFoundError:
        return MISSING


def _percent(value: float | None) -> str:
    """Return the text of a share as a percentage, or a dash if there is no value."""
    return "–" if value is None else f"{100 * value:.1f}"
