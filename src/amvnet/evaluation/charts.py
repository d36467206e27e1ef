"""Write the figures (PNG) and tables of the paper's section 4.4, and all their numbers (CSV)."""

from __future__ import annotations

import csv
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from amvnet.evaluation.analysis import BINS, Analysis, SweptRow
from amvnet.evaluation.metrics import metrics
from amvnet.evaluation.top_view import PICTURE
from amvnet.files import Signature, atomic_write
from amvnet.models.methods import title_of

SIZE = (6.0, 3.6)  # width and height of a figure, inches
DOTS_PER_INCH = 160
MAX_MARKED = 20  # only sweeps of at most as many values have markers, which overlap in longer ones
Cell = str | float | int | None  # a cell of a table, or None for an empty cell


# Matplotlib's styles for the methods' curves.
STYLES = {
    "rv": {"marker": "o", "linestyle": ":"},
    "bev": {"marker": "s", "linestyle": "--"},
    "ensemble": {"marker": "^", "linestyle": "-."},
    "amvnet": {"marker": "D", "linestyle": "-"},
}


TABLE = Signature("a table of analyze", rb"[^\n]*%")
FIGURES = ("similarity", "distance", "tau")  # the figures of `write_all`; each has a table
TABLES = ("classes", "methods")  # the tables of `write_all` that have no figure


def files_of(out: Path, figures: Sequence[str], tables: Sequence[str]) -> dict[Path, Signature]:
    """Return the files of some figures, of their tables, and of some other tables in a folder."""
    files = {out / f"{name}.csv": TABLE for name in (*figures, *tables)}
    return files | {out / f"{name}.png": PICTURE for name in figures}


def write_all(analysis: Analysis, dataset: str, out: Path) -> list[Path]:
    """Write Figures 5, 6 and 8a and Tables 3 and 4 of the paper; return the files."""
    return [
        *_write_similarity(analysis, dataset, out / "similarity"),
        *_write_distance(analysis, dataset, out / "distance"),
        *write_sweep(analysis.sweep(), "tau", analysis.tau, dataset, out / "tau"),
        *_write_classes(analysis, out / "classes"),
        *_write_methods(analysis, out / "methods"),
    ]


def write_sweep(
    rows: Sequence[SweptRow], name: str, used: float, dataset: str, path: Path
) -> list[Path]:
    """Write Figure 8 of the paper: mIoU and share of uncertain points; return the files.

    `used` is the value of the parameter in the weights; `path` has no ending.
    """
    values, shares, mious, _ = zip(*rows, strict=True)

    figure, axes = _figure(f"{name} on {dataset}")
    marker = "" if len(rows) > MAX_MARKED else "o"
    miou_line = axes.plot(values, mious, color="black", marker=marker, label="mIoU")
    axes.set(xlabel=name, ylabel="mIoU (%)")
    axes.axvline(used, color="0.6", linewidth=0.8, linestyle=":")

    share_axes = axes.twinx()
    share_style = {"color": "tab:orange", "linestyle": "--", "marker": marker}
    share_line = share_axes.plot(values, shares, label="uncertain points", **share_style)
    share_axes.set_ylabel("uncertain points (%)")
    share_axes.set_ylim(bottom=0)

    axes.legend(handles=[*miou_line, *share_line], frameon=False, loc="upper left")
    return _write(path, (name, "uncertain %", "mIoU %", "accuracy %"), rows, figure)


def write_ablation(rows: Sequence[tuple[bool, bool, dict[str, Any]]], path: Path) -> list[Path]:
    """Write Table 5 of the paper, the ablation of the range-view network; return the files.

    A row says whether the network has the GRU and whether it was trained with class weights, and
    has its metrics. The path has no ending.
    """
    table: list[Sequence[Cell]] = []
    for gru, weighted, network_metrics in rows:
        miou = _percent(network_metrics["miou"])
        accuracy = _percent(network_metrics["accuracy"])
        table.append(("yes" if gru else "no", "yes" if weighted else "no", miou, accuracy))

    return _write(path, ("GRU", "class weights", "mIoU %", "accuracy %"), table)


def _write_similarity(analysis: Analysis, dataset: str, path: Path) -> list[Path]:
    """Draw Figure 5 of the paper: a histogram of the networks' similarity."""
    edges = np.arange(BINS + 1) / BINS
    total = max(analysis.points.sum(), 1)
    rows: list[Sequence[Cell]] = []
    for (low, high), count in zip(pairwise(edges), analysis.points, strict=True):
        rows.append((low, high, int(count), 100 * float(count / total)))

    figure, axes = _figure(f"agreement of the two networks on {dataset}")
    # Empty bins are drawn as half a point, because a logarithmic axis has no 0.
    axes.stairs(np.maximum(analysis.points, 0.5), edges, fill=True, color="0.55")
    label = f"tau = {analysis.tau:g}"
    axes.axvline(analysis.tau, color="black", linewidth=0.8, linestyle=":", label=label)
    axes.set(xlabel="cosine similarity of the two scores", xlim=(0, 1))
    axes.set(ylabel="points", yscale="log")
    axes.legend(frameon=False, loc="upper left")

    return _write(path, ("above", "up to", "points", "points %"), rows, figure)


def _write_distance(analysis: Analysis, dataset: str, path: Path) -> list[Path]:
    """Draw Figure 6 of the paper: the mIoU by distance, over the classes that are present."""
    methods = analysis.evaluation.report(dataset)["methods"]
    table: list[list[Cell]] = []
    middles = []
    for extent in methods["amvnet"]["by_distance"]:
        table.append([extent["from_m"], extent["to_m"]])
        middles.append((extent["from_m"] + extent["to_m"]) / 2)

    columns = ["from m", "to m"]
    figure, axes = _figure(f"mIoU by distance on {dataset}")
    for method, style in STYLES.items():
        title = title_of(method)
        columns.append(f"{title} %")
        mious = []
        for row, extent in zip(table, methods[method]["by_distance"], strict=True):
            miou = _percent(extent["miou_present"])
            row.append(miou)
            mious.append(np.nan if miou is None else miou)

        axes.plot(middles, mious, label=title, color="black", markersize=4, **style)

    axes.set(xlabel="distance from the sensor (m)", ylabel="mIoU, classes present (%)")
    axes.legend(frameon=False)
    return _write(path, columns, table, figure)


def _write_classes(analysis: Analysis, path: Path) -> list[Path]:
    """Write Table 3 of the paper: IoU by class."""
    rows: list[list[Cell]] = [
        [name] for name in (*analysis.evaluation.taxonomy.classes, "mIoU", "fwIoU")
    ]
    columns = ["IoU %"]
    for method in STYLES:
        columns.append(title_of(method))
        figures = metrics(analysis.evaluation.matrices[method][0], analysis.evaluation.taxonomy)
        values = (*figures["iou"].values(), figures["miou"], figures["fwiou"])
        for row, value in zip(rows, values, strict=True):
            row.append(_percent(value))

    return _write(path, columns, rows)


def _write_methods(analysis: Analysis, path: Path) -> list[Path]:
    """Write Table 4 of the paper: the networks, the ensembles and AMVNet."""
    rows: list[Sequence[Cell]] = []
    for method, matrices in analysis.evaluation.matrices.items():
        figures = metrics(matrices[0], analysis.evaluation.taxonomy)
        row: list[Cell] = ["geometric mean" if method == "ensemble" else title_of(method)]
        for key in ("miou", "miou_present", "accuracy", "fwiou"):
            row.append(_percent(figures[key]))
        rows.append(row)

    columns = ("method", "mIoU %", "mIoU % of the classes present", "accuracy %", "fwIoU %")
    return _write(path, columns, rows)


def _percent(value: float | None) -> float | None:
    return None if value is None else 100 * value


def _figure(title: str) -> tuple[Any, Any]:
    from matplotlib.figure import Figure

    figure = Figure(figsize=SIZE, layout="constrained")
    axes = figure.add_subplot()
    axes.set_title(title, fontsize=10)
    axes.spines["top"].set_visible(False)
    return figure, axes


def _write(
    path: Path, columns: Sequence[str], rows: Sequence[Sequence[Cell]], figure: Any = None
) -> list[Path]:
    csv_path = path.with_suffix(".csv")
    with atomic_write(csv_path) as part, part.open("w", newline="") as file:
        csv.writer(file).writerows([columns, *rows])
    if figure is None:
        return [csv_path]

    png_path = path.with_suffix(".png")
    with atomic_write(png_path) as part:
        figure.savefig(part, format="png", dpi=DOTS_PER_INCH, facecolor="white")
    return [csv_path, png_path]
