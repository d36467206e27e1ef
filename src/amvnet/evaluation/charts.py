"""The paper's figures and tables of an analysis, each as PNG, CSV and Markdown."""

from __future__ import annotations

import csv
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from amvnet.evaluation.analysis import BINS, Analysis, Swept
from amvnet.evaluation.metrics import metrics
from amvnet.files import atomic_write

SIZE = (6.0, 3.6)  # inches
DOTS_PER_INCH = 160
# Title, marker and line of each method.
STYLES = {
    "rv": ("RV", "o", ":"),
    "bev": ("BEV", "s", "--"),
    "ensemble": ("ensemble", "^", "-."),
    "amvnet": ("AMVNet", "D", "-"),
}
Row = Sequence[str | float | int | None]


def write_all(found: Analysis, dataset: str, out: Path) -> list[Path]:
    """Histogram, mIoU by distance, sweep of tau, and Tables 3 and 4; returns the files.

    Args:
        dataset: what the user named the data, for the titles.
    """
    return [
        *_similarity(found, dataset, out / "similarity"),
        *_distance(found, dataset, out / "distance"),
        *write_sweep(found.sweep(), "tau", found.tau, dataset, out / "tau"),
        *_classes(found, out / "classes"),
        *_methods(found, out / "methods"),
    ]


def write_sweep(
    swept: Sequence[Swept], name: str, used: float, dataset: str, path: Path
) -> list[Path]:
    """Figure 8 of the paper: what a parameter does to mIoU, and to the share of uncertain points."""
    figure, axes = _figure(f"{name} on {dataset}")
    values = [one.value for one in swept]
    marker = "" if len(swept) > 20 else "o"
    axes.plot(values, [100 * one.miou for one in swept], color="black", marker=marker, label="mIoU")
    axes.set(xlabel=name, ylabel="mIoU (%)")
    axes.axvline(used, color="0.6", linewidth=0.8, linestyle=":")
    share = axes.twinx()
    shares = [100 * one.uncertain for one in swept]
    share.plot(
        values, shares, color="tab:orange", linestyle="--", marker=marker, label="uncertain points"
    )
    share.set_ylabel("uncertain points (%)")
    share.set_ylim(bottom=0)
    lines = [*axes.get_lines()[:1], *share.get_lines()]
    axes.legend(lines, [line.get_label() for line in lines], frameon=False, loc="upper left")
    rows = [(one.value, 100 * one.uncertain, 100 * one.miou, 100 * one.accuracy) for one in swept]
    return _write(path, (name, "uncertain %", "mIoU %", "accuracy %"), rows, figure)


def write_ablation(rows: Sequence[tuple[bool, bool, dict[str, Any]]], path: Path) -> list[Path]:
    """Table 5 of the paper."""
    table = [("yes" if gru else "no", "yes" if weighted else "no", _percent(found["miou"]), _percent(found["accuracy"]))
             for gru, weighted, found in rows]  # fmt: skip
    return _write(path, ("GRU", "class weights", "mIoU %", "accuracy %"), table)


def _similarity(found: Analysis, dataset: str, path: Path) -> list[Path]:
    """Figure 5 of the paper: how often the networks agree how much, on a logarithmic scale."""
    figure, axes = _figure(f"agreement of the two networks on {dataset}")
    edges = np.arange(BINS + 1) / BINS
    axes.stairs(np.maximum(found.points, 0.5), edges, fill=True, color="0.55")
    axes.axvline(
        found.tau, color="black", linewidth=0.8, linestyle=":", label=f"tau = {found.tau:g}"
    )
    axes.set(
        xlabel="cosine similarity of the two scores", ylabel="points", yscale="log", xlim=(0, 1)
    )
    axes.legend(frameon=False, loc="upper left")
    total = max(found.points.sum(), 1)
    rows = [
        (edges[i], edges[i + 1], int(n), 100 * float(n / total)) for i, n in enumerate(found.points)
    ]
    return _write(path, ("above", "up to", "points", "points %"), rows, figure)


def _distance(found: Analysis, dataset: str, path: Path) -> list[Path]:
    """Figure 6 of the paper: mIoU over the classes present, by distance from the sensor."""
    figure, axes = _figure(f"mIoU by distance on {dataset}")
    report = found.evaluation.report(dataset)["methods"]
    bins = report["amvnet"]["by_distance"]
    middles = [(one["from_m"] + one["to_m"]) / 2 for one in bins]
    for name, (title, marker, line) in STYLES.items():
        values = [_percent(one["miou_present"]) for one in report[name]["by_distance"]]
        shown = [np.nan if value is None else value for value in values]
        axes.plot(
            middles, shown, label=title, marker=marker, linestyle=line, color="black", markersize=4
        )
    axes.set(xlabel="distance from the sensor (m)", ylabel="mIoU, classes present (%)")
    axes.legend(frameon=False)
    rows = [
        (
            one["from_m"],
            one["to_m"],
            *(_percent(report[name]["by_distance"][i]["miou_present"]) for name in STYLES),
        )
        for i, one in enumerate(bins)
    ]
    return _write(
        path, ("from m", "to m", *(f"{title} %" for title, _, _ in STYLES.values())), rows, figure
    )


def _classes(found: Analysis, path: Path) -> list[Path]:
    """Table 3 of the paper: IoU by class."""
    by_method = {
        name: metrics(found.evaluation.matrices[name][0], found.taxonomy) for name in STYLES
    }
    rows: list[Row] = [
        (c, *(_percent(m["iou"][c]) for m in by_method.values())) for c in found.taxonomy.classes
    ]
    rows.append(("mIoU", *(_percent(m["miou"]) for m in by_method.values())))
    rows.append(("fwIoU", *(_percent(m["fwiou"]) for m in by_method.values())))
    return _write(path, ("IoU %", *(title for title, _, _ in STYLES.values())), rows)


def _methods(found: Analysis, path: Path) -> list[Path]:
    """Table 4 of the paper: the networks, the ensembles and AMVNet."""
    titles = {name: title for name, (title, _, _) in STYLES.items()} | {
        "arithmetic": "arithmetic mean",
        "ensemble": "geometric mean",
    }
    rows = []
    for name, matrices in found.evaluation.matrices.items():
        reached = metrics(matrices[0], found.taxonomy)
        figures = (_percent(reached[key]) for key in ("miou", "miou_present", "accuracy", "fwiou"))
        rows.append((titles.get(name, name), *figures))
    return _write(
        path, ("method", "mIoU %", "mIoU % of the classes present", "accuracy %", "fwIoU %"), rows
    )


def _percent(value: float | None) -> float | None:
    return None if value is None else 100 * value


def _figure(title: str) -> tuple[Any, Any]:
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=SIZE, layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.add_subplot()
    axes.set_title(title, fontsize=10)
    axes.spines["top"].set_visible(False)
    return figure, axes


def _write(path: Path, heads: Sequence[str], rows: Sequence[Row], figure: Any = None) -> list[Path]:
    """The same rows as CSV and as Markdown, and the figure where there is one."""
    files = [path.with_suffix(".csv"), path.with_suffix(".md")]
    with atomic_write(files[0]) as part, part.open("w", newline="") as file:
        csv.writer(file).writerows([heads, *rows])
    cells = [heads, ["---"] * len(heads), *([_shown(value) for value in row] for row in rows)]
    with atomic_write(files[1]) as part:
        part.write_text("".join(f"| {' | '.join(row)} |\n" for row in cells))
    if figure is not None:
        files.append(path.with_suffix(".png"))
        with atomic_write(files[-1]) as part:
            figure.savefig(part, format="png", dpi=DOTS_PER_INCH, facecolor="white")
    return files


def _shown(value: str | float | int | None) -> str:
    if value is None:
        return "–"
    return f"{value:.2f}" if isinstance(value, float) else str(value)
