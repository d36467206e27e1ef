"""Draw a scan from above: truth, predictions, errors and uncertain points in one PNG."""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from amvnet.data.taxonomy import UNCERTAIN_COLOR, WRONG_COLOR, Color, Taxonomy, class_colors
from amvnet.files import Signature, atomic_write

REACH = 50.0  # distance that is shown on each side of the sensor, metres
PANEL = 4.6  # width and height of a panel, inches
DOTS_PER_INCH = 130
ENTRIES = 3  # number of entries in a line of the legend, for each column of panels
LEGEND_LINE = 0.2  # height of a line of the legend, inches
LEGEND_MARGIN = 0.5  # margin of the legend, inches
DOT = 1.1  # area of a drawn point, square typographic points

PICTURE = Signature("a picture by Matplotlib", rb"\x89PNG.*Matplotlib")
IGNORED: Color = (204, 204, 204)
PLAIN = (0.75, 0.75, 0.75)  # colour of points that are not marked, RGB in [0, 1]


@dataclass(frozen=True)
class _Panel:
    """One view of the scan: colours (N, 3) in [0, 1]; points `on_top` are drawn over others."""

    title: str
    colors: np.ndarray
    on_top: np.ndarray


@dataclass(frozen=True)
class TopView:
    """The content of a drawing of N points from above.

    Attributes:
        points: (N, 3 or more) x, y, z in metres.
        predictions: (N,) train ids by title.
        truth: (N,) train ids of the ground truth.
        uncertain: (N,) bool, the uncertain points; None if they are unknown.
    """

    points: np.ndarray
    taxonomy: Taxonomy
    predictions: Mapping[str, np.ndarray]
    truth: np.ndarray
    title: str
    uncertain: np.ndarray | None = None


def draw_scan(path: Path, view: TopView) -> Path:
    """Draw one scan from above, x to the right and y up, `REACH` to each side; return the path.

    The first row shows the truth and each prediction. Below each prediction are its errors: wrong
    points are red, all others grey. Below the truth are the uncertain points. The legend has the
    classes that appear. The PNG appears whole or not at all.
    """
    from matplotlib.figure import Figure

    grid = _grid(view)
    entries = _legend_entries(view)
    columns = len(grid[0])
    legend_lines = math.ceil(len(entries) / (ENTRIES * columns))
    height = len(grid) * PANEL + LEGEND_LINE * legend_lines + LEGEND_MARGIN
    figure = Figure(figsize=(columns * PANEL, height), layout="constrained")

    panels = itertools.chain.from_iterable(grid)
    for number, panel in enumerate(panels, start=1):
        if panel is not None:
            _draw_panel(figure.add_subplot(len(grid), columns, number), view.points, panel)
    figure.suptitle(view.title, fontsize=13)
    _draw_legend(figure, entries, columns)

    with atomic_write(path) as part:
        figure.savefig(part, format="png", dpi=DOTS_PER_INCH)
    return path


def _grid(view: TopView) -> list[list[_Panel | None]]:
    """Return the rows of panels. Cells of the grid that are None stay empty.

    The first column shows the truth, and each other column a prediction.
    """
    palette = np.asarray([IGNORED, *class_colors(view.taxonomy)[1:]]) / 255.0
    labelled = view.truth > 0

    first_row: list[_Panel | None] = [_Panel("truth", palette[view.truth], labelled)]
    second_row: list[_Panel | None] = [None]
    if view.uncertain is not None:
        total = len(view.uncertain)
        second_row = [_highlight("uncertain", view.uncertain, total, UNCERTAIN_COLOR)]

    for title, ids in view.predictions.items():
        wrong = (ids != view.truth) & labelled
        first_row.append(_Panel(title, palette[ids], ids > 0))
        second_row.append(_highlight(f"errors of {title}", wrong, labelled.sum(), WRONG_COLOR))
    return [first_row, second_row]


def _highlight(title: str, mask: np.ndarray, total: int, color: Color) -> _Panel:
    """Return a panel with the points of a mask in one colour and all others in grey.

    The title also states the number of points in the mask as a share of `total`.
    """
    share = np.count_nonzero(mask) / max(total, 1)
    colors = np.where(mask[:, None], np.divide(color, 255), PLAIN)
    return _Panel(f"{title} ({share:.1%})", colors, mask)


def _legend_entries(view: TopView) -> list[tuple[str, Color]]:
    """Return names and colours of the classes that appear, and of wrong and uncertain points."""
    class_ids = np.unique([view.truth, *view.predictions.values()]).tolist()

    colors = class_colors(view.taxonomy)
    names = view.taxonomy.names
    entries = [(names[class_id], colors[class_id]) for class_id in class_ids if class_id > 0]
    entries.append(("wrong", WRONG_COLOR))
    if view.uncertain is not None:
        entries.append(("uncertain", UNCERTAIN_COLOR))
    if 0 in class_ids:
        entries.append(("ignored", IGNORED))
    return entries


def _draw_panel(axes: Any, points: np.ndarray, panel: _Panel) -> None:
    inside = (np.abs(points[:, :2]) <= REACH).all(axis=1)
    xyz = points[inside, :3]

    # Higher points hide lower ones, and the points on top hide all others.
    order = np.argsort(xyz[:, 2], kind="stable")
    order = order[np.argsort(panel.on_top[inside][order], kind="stable")]

    x, y, _ = xyz[order].T
    axes.scatter(x, y, c=panel.colors[inside][order], s=DOT, linewidths=0, rasterized=True)
    axes.plot(0, 0, marker="+", color="black", markersize=7)

    axes.set(xlim=(-REACH, REACH), ylim=(-REACH, REACH), aspect="equal")
    axes.set_title(panel.title, fontsize=11)
    axes.set_xlabel("x (m)", fontsize=8)
    axes.set_ylabel("y (m)", fontsize=8)
    axes.tick_params(labelsize=8)


def _draw_legend(figure: Any, entries: Sequence[tuple[str, Color]], columns: int) -> None:
    from matplotlib.patches import Patch

    handles = []
    for name, (red, green, blue) in entries:
        color = (red / 255, green / 255, blue / 255)
        handles.append(Patch(facecolor=color, edgecolor="0.5", label=name))
    figure.legend(
        handles=handles,
        loc="outside lower center",
        ncols=min(len(entries), ENTRIES * columns),
        frameon=False,
        fontsize=9,
    )
