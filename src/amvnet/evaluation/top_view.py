"""A scan from above: truth, predictions, errors and doubts side by side in one PNG."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from amvnet.data.taxonomy import Taxonomy
from amvnet.errors import InputError
from amvnet.files import atomic_write

REACH = 50.0  # metres from the sensor to each side
PANEL = 4.6  # inches, width and height of one panel
DOTS_PER_INCH = 130
ENTRIES = 3  # of the legend, below each column of panels
DOT = 1.1  # area of a point in square typographic points

Color = tuple[float, float, float]
IGNORED: Color = (0.8, 0.8, 0.8)
PLAIN: Color = (0.75, 0.75, 0.75)
WRONG: Color = (0.9, 0.0, 0.0)
UNCERTAIN: Color = (0.93, 0.5, 0.0)
GROUND, INK, LINES = "white", "black", "0.6"


@dataclass(frozen=True)
class _Panel:
    """One view: a title, (N, 3) colours in [0, 1] and (N,) bool, the points to draw on top."""

    title: str
    colors: np.ndarray
    on_top: np.ndarray


def draw_scan(
    path: Path | str,
    points: np.ndarray,
    taxonomy: Taxonomy,
    panels: Mapping[str, np.ndarray],
    truth: np.ndarray | None = None,
    uncertain: np.ndarray | None = None,
    title: str = "",
    reach: float = REACH,
    marked: str = "uncertain",
) -> Path:
    """Draw one scan from above, x to the right and y up, 50 m (`reach`) to each side.

    The first row has the truth and each prediction. Below a prediction are its errors (correct
    grey, wrong red; ignored points count as neither), below the truth the uncertain points.
    The legend has the classes that appear. The file appears whole or not at all.

    Args:
        path: the PNG to write.
        others: as of `scan_figure`.

    Returns:
        The path that was written.

    Raises:
        InputError: where there is nothing to draw, or an array is not one value per point.
    """
    path = Path(path)
    try:
        figure = scan_figure(points, taxonomy, panels, truth, uncertain, title, reach, marked)
    except InputError as error:
        raise InputError(f"{path}: {error}") from None
    with atomic_write(path) as part:
        figure.savefig(part, format="png", dpi=DOTS_PER_INCH, facecolor=GROUND)
    return path


def scan_figure(
    points: np.ndarray,
    taxonomy: Taxonomy,
    panels: Mapping[str, np.ndarray],
    truth: np.ndarray | None = None,
    uncertain: np.ndarray | None = None,
    title: str = "",
    reach: float = REACH,
    marked: str = "uncertain",
) -> Any:
    """The Matplotlib figure that `draw_scan` writes.

    Args:
        points: (N, 3 or more) x, y, z in metres.
        taxonomy: names and colours of the classes.
        panels: title -> (N,) train ids of a prediction; may be empty where there is a truth.
        truth: (N,) train ids, or None.
        uncertain: (N,) bool, or None.
        title: a line above all panels.
        reach: metres that are shown to each side.
        marked: what the points of `uncertain` are.

    Raises:
        InputError: where there is nothing to draw, or an array is not one value per point.
    """
    _check(len(points), panels, truth, uncertain)
    rows = _rows(taxonomy, panels, truth, uncertain, marked)
    seen = np.unique(np.concatenate([*panels.values(), *([] if truth is None else [truth])]))
    errors = truth is not None and bool(panels)
    return _figure(
        points,
        rows,
        _entries(taxonomy, seen, errors, marked if uncertain is not None else ""),
        title,
        reach,
    )


def _check(
    count: int,
    panels: Mapping[str, np.ndarray],
    truth: np.ndarray | None,
    uncertain: np.ndarray | None,
) -> None:
    if not panels and truth is None:
        raise InputError("expected a prediction or a truth to draw, found neither; give one")
    for name, values in {**panels, "truth": truth, "uncertain": uncertain}.items():
        if values is not None and np.shape(values) != (count,):
            raise InputError(
                f"expected {count} values for {name!r}, one per point, found {np.shape(values)}; "
                "give those of this scan"
            )


def _rows(
    taxonomy: Taxonomy,
    panels: Mapping[str, np.ndarray],
    truth: np.ndarray | None,
    uncertain: np.ndarray | None,
    marked: str,
) -> list[list[_Panel | None]]:
    """The grid: one column per prediction, after one for the truth; None leaves a place free."""
    palette = np.asarray(taxonomy.colors) / 255.0
    palette[0] = IGNORED
    shown = [_Panel(name, palette[ids], ids > 0) for name, ids in panels.items()]
    doubts = [] if uncertain is None else [_chosen(marked, uncertain, len(uncertain), UNCERTAIN)]
    if truth is None:
        return [[*shown, *doubts]]
    known = truth > 0
    errors = [
        _chosen(f"errors of {n}", (ids != truth) & known, known.sum(), WRONG)
        for n, ids in panels.items()
    ]
    first: list[_Panel | None] = [_Panel("truth", palette[truth], known), *shown]
    second: list[_Panel | None] = [doubts[0] if doubts else None, *errors]
    return [first, second] if doubts or errors else [first]


def _chosen(title: str, chosen: np.ndarray, count: int, color: Color) -> _Panel:
    """A panel of chosen points in one colour and all others in grey, with their share of `count`."""
    share = np.count_nonzero(chosen) / max(count, 1)
    return _Panel(f"{title} ({share:.1%})", np.where(chosen[:, None], color, PLAIN), chosen)


def _entries(
    taxonomy: Taxonomy, seen: np.ndarray, errors: bool, marked: str
) -> list[tuple[str, Color]]:
    """(name, colour) of the legend: the classes that appear, then what the other panels show."""
    palette = [(r / 255, g / 255, b / 255) for r, g, b in taxonomy.colors]
    entries = [(taxonomy.classes[c - 1], palette[c]) for c in seen.tolist() if c]
    extras = {
        "ignored": (0 in seen, IGNORED),
        "wrong": (errors, WRONG),
        marked: (bool(marked), UNCERTAIN),
    }
    return entries + [(name, color) for name, (appears, color) in extras.items() if appears]


def _figure(
    points: np.ndarray,
    rows: list[list[_Panel | None]],
    entries: list[tuple[str, Color]],
    title: str,
    reach: float,
) -> Any:
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    columns = len(rows[0])
    legend = 0.2 * -(-len(entries) // (ENTRIES * columns)) + 0.5  # inches
    size = (columns * PANEL, len(rows) * PANEL + legend)
    figure = Figure(figsize=size, facecolor=GROUND, layout="constrained")
    FigureCanvasAgg(figure)
    for place, panel in enumerate((panel for row in rows for panel in row), start=1):
        if panel is not None:
            _draw(figure.add_subplot(len(rows), columns, place), points, panel, reach)
    if title:
        figure.suptitle(title, color=INK, fontsize=13)
    _legend(figure, entries, columns)
    return figure


def _draw(axes: Any, points: np.ndarray, panel: _Panel, reach: float) -> None:
    inside = (np.abs(points[:, :2]) <= reach).all(axis=1)
    order = np.argsort(points[inside, 2], kind="stable")  # what is higher hides what is below
    order = order[np.argsort(panel.on_top[inside][order], kind="stable")]
    xy, colors = points[inside, :2][order], panel.colors[inside][order]
    axes.scatter(
        xy[:, 0],
        xy[:, 1],
        c=colors,
        s=DOT * REACH / reach,
        marker="o",
        linewidths=0,
        rasterized=True,
    )
    axes.plot(0, 0, marker="+", color=INK, markersize=7)
    axes.set(xlim=(-reach, reach), ylim=(-reach, reach), aspect="equal", facecolor=GROUND)
    axes.set_title(panel.title, color=INK, fontsize=11)
    axes.set_xlabel("x (m)", color=INK, fontsize=8)
    axes.set_ylabel("y (m)", color=INK, fontsize=8)
    axes.tick_params(colors=INK, labelsize=8)
    for spine in axes.spines.values():
        spine.set_color(LINES)


def _legend(figure: Any, entries: list[tuple[str, Color]], columns: int) -> None:
    from matplotlib.patches import Patch

    handles = [
        Patch(facecolor=color, edgecolor="0.5", linewidth=0.5, label=name)
        for name, color in entries
    ]
    figure.legend(
        handles=handles,
        loc="outside lower center",
        ncols=min(len(handles), ENTRIES * columns),
        frameon=False,
        labelcolor=INK,
        fontsize=9,
    )
