"""Scans, labels, uncertain points and errors on a time line of Rerun."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterable
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np

from amvnet.data.taxonomy import Taxonomy
from amvnet.errors import InputError
from amvnet.files import atomic_write
from amvnet.models.methods import title_of
from amvnet.viewing.frames import RIGHT, UNCERTAIN, UNLABELLED, WRONG, Frame

TIMELINE = "scan"
DOT, LARGE_DOT = 1.2, 1.8  # radius of points on the screen
GROUND = (13, 17, 24)


def check_rerun() -> Any:
    """The Rerun SDK.

    Raises:
        InputError: where it is not installed.
    """
    try:
        import rerun
    except ImportError:
        raise InputError(
            "expected rerun-sdk for a window or a recording, found none installed; "
            'pip install "amvnet[view]", or write a page for a browser with --html FILE'
        ) from None
    return rerun


def check_window() -> None:
    """Raises InputError where there is no Rerun, or no screen to open a window on."""
    check_rerun()
    if sys.platform == "linux" and not (
        os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")
    ):
        raise InputError(
            "expected a screen for a window, found none; write a file with --html or --save"
        )


def save_recording(path: Path | str, frames: Iterable[Frame], taxonomy: Taxonomy) -> Path:
    """Write a recording that Rerun opens; it appears whole or not at all.

    Args:
        path: the file, NAME.rrd.
        frames: the scans in their order, at least one; each is a step of the time line `scan`.
        taxonomy: names and colours of the classes.

    Raises:
        InputError: where Rerun is not installed, or the file cannot be written.
    """
    stream, first, frames = _stream(), *_first(frames)
    with atomic_write(path) as part:
        stream.save(part, default_blueprint=blueprint(first))
        try:
            log(stream, frames, taxonomy)
        finally:
            stream.disconnect()  # waits until all is written
    return Path(path)


def open_window(frames: Iterable[Frame], taxonomy: Taxonomy) -> None:
    """Show the same in a window of Rerun, scan by scan as they are made.

    Raises:
        InputError: where Rerun is not installed, or cannot open a window.
    """
    stream, first, frames = _stream(), *_first(frames)
    # Without an activated environment, the viewer beside this Python is not on the path.
    os.environ["PATH"] = os.pathsep.join(
        [os.environ.get("PATH", ""), str(Path(sys.executable).parent)]
    )
    try:
        stream.spawn(default_blueprint=blueprint(first))
    except RuntimeError as error:
        reason = str(error).splitlines()[0]
        raise InputError(
            f"expected a window of Rerun, found: {reason}; write a file with --save or --html"
        ) from None
    log(stream, frames, taxonomy)
    stream.disconnect()


def log(stream: Any, frames: Iterable[Frame], taxonomy: Taxonomy) -> None:
    """Log scans: `points`, `truth`, `labels/METHOD`, `errors/METHOD`, `uncertain`, and shares below `percent`."""
    rerun = check_rerun()
    colors = (UNLABELLED, *taxonomy.colors[1:])
    classes = zip(("unlabelled", *taxonomy.classes), colors, strict=True)
    context = [
        rerun.AnnotationInfo(id=i, label=name, color=color)
        for i, (name, color) in enumerate(classes)
    ]
    stream.log(
        "/", rerun.AnnotationContext(context), rerun.ViewCoordinates.RIGHT_HAND_Z_UP, static=True
    )
    for step, frame in enumerate(frames):
        stream.set_time(TIMELINE, sequence=step)
        stream.log("name", rerun.TextLog(frame.name))
        _log_points(stream, rerun, frame)
        _log_shares(stream, rerun, frame)


def blueprint(frame: Frame) -> Any:
    """Side by side what such a frame has: truth, labels, errors, uncertain points; a curve of their shares."""
    import rerun.blueprint as parts

    def space(name: str, *paths: str) -> Any:
        return parts.Spatial3DView(origin="/", contents=list(paths), name=name, background=GROUND)

    def tabs(views: list[Any]) -> Any:
        return parts.Tabs(*views, active_tab=len(views) - 1)

    titles = {method: title_of(method) for method in frame.labels}
    truth, doubts = frame.truth is not None, frame.uncertain is not None
    views = [space("truth", "/truth")] if truth else []
    if titles:
        views.append(tabs([space(title, f"/labels/{m}") for m, title in titles.items()]))
    if titles and truth:
        views.append(
            tabs([space(f"errors of {t}", "/points", f"/errors/{m}") for m, t in titles.items()])
        )
    if doubts:
        views.append(space("uncertain", "/points", "/uncertain"))
    grid = parts.Grid(*(views or [space("points", "/points")]))
    if not doubts and not (titles and truth):
        return parts.Blueprint(grid, collapse_panels=True)
    shares = parts.TimeSeriesView(origin="/percent", name="percent of the points")
    return parts.Blueprint(parts.Vertical(grid, shares, row_shares=[5, 1]), collapse_panels=True)


def _first(frames: Iterable[Frame]) -> tuple[Frame, Iterable[Frame]]:
    """The first frame, and all of them."""
    rest = iter(frames)
    first = next(rest)
    return first, chain([first], rest)


def _stream() -> Any:
    return check_rerun().RecordingStream("amvnet")


def _log_points(stream: Any, rerun: Any, frame: Frame) -> None:
    xyz = frame.points[frame.valid, :3]

    def points(chosen: np.ndarray | None = None, dot: float = DOT, **looks: Any) -> Any:
        places = xyz if chosen is None else frame.points[frame.valid & chosen, :3]
        return rerun.Points3D(places, radii=rerun.Radius.ui_points(dot), **looks)

    stream.log("points", points(colors=RIGHT if frame.labels else _by_height(xyz)))
    if frame.truth is not None:
        stream.log("truth", points(class_ids=frame.truth[frame.valid]))
    for method, ids in frame.labels.items():
        stream.log(f"labels/{method}", points(class_ids=ids[frame.valid]))
        if (errors := frame.errors(method)) is not None:
            stream.log(f"errors/{method}", points(errors, LARGE_DOT, colors=WRONG))
    if frame.uncertain is not None:
        stream.log("uncertain", points(frame.uncertain, LARGE_DOT, colors=UNCERTAIN))


def _log_shares(stream: Any, rerun: Any, frame: Frame) -> None:
    """Shares in percent: of the points that truth names, those taken for something else; of all, the uncertain."""
    for method in frame.labels:
        if (errors := frame.errors(method)) is not None and frame.truth is not None:
            stream.log(
                f"percent/wrong/{method}",
                rerun.Scalars(100 * errors.sum() / max((frame.truth > 0).sum(), 1)),
            )
    if frame.uncertain is not None:
        stream.log("percent/uncertain", rerun.Scalars(100 * frame.uncertain.mean()))


def _by_height(xyz: np.ndarray) -> np.ndarray:
    """(N, 3) uint8 colours."""
    from matplotlib import colormaps

    low, high = np.percentile(xyz[:, 2], (1, 99))
    share = np.clip((xyz[:, 2] - low) / max(high - low, 1e-6), 0, 1)
    return (colormaps["turbo"](share)[:, :3] * 255).astype(np.uint8)
