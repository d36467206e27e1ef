"""Scans, labels, uncertain points and errors on a Rerun timeline."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterable
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np

from amvnet.data.palette import UNCERTAIN, WRONG, class_colors
from amvnet.data.taxonomy import Taxonomy
from amvnet.errors import InputError
from amvnet.files import atomic_write
from amvnet.models.methods import title_of
from amvnet.viewing.frames import RIGHT, UNLABELLED, Frame

TIMELINE = "scan"
DOT = 1.2  # radius of a point on the screen, in Rerun's ui points
LARGE_DOT = 1.8  # the same, for an error or an uncertain point
BACKGROUND = (13, 17, 24)  # RGB in 0..255, behind the points


def check_rerun() -> Any:
    """Return the Rerun SDK.

    Raises:
        InputError: if it is not installed.
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
    """Check that Rerun can open a window.

    Raises:
        InputError: if Rerun is not installed, or there is no screen.
    """
    check_rerun()
    has_screen = os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")
    if sys.platform == "linux" and not has_screen:
        raise InputError(
            "expected a screen for a window, found none; write a file with --html or --save"
        )


def save_recording(path: Path | str, frames: Iterable[Frame], taxonomy: Taxonomy) -> Path:
    """Write a recording that Rerun opens; it appears whole or not at all.

    Args:
        path: the file, NAME.rrd.
        frames: the scans, at least one; each is a step of the timeline `scan`.

    Returns:
        The path that was written.

    Raises:
        InputError: if Rerun is not installed, or the file cannot be written.
    """
    stream = _new_stream()
    first, frames = _peek(frames)
    with atomic_write(path) as part:
        stream.save(part, default_blueprint=blueprint(first))
        try:
            log(stream, frames, taxonomy)
        finally:
            stream.disconnect()  # waits until everything is written

    return Path(path)


def open_window(frames: Iterable[Frame], taxonomy: Taxonomy) -> None:
    """Show scans in a Rerun window, each as soon as it is ready.

    Args:
        frames: the scans, at least one; each is a step of the timeline `scan`.

    Raises:
        InputError: if Rerun is not installed, or cannot open a window.
    """
    stream = _new_stream()
    first, frames = _peek(frames)

    # The viewer lies in the folder of this Python, which is on the path only if the environment is
    # activated.
    folders = [os.environ.get("PATH", ""), str(Path(sys.executable).parent)]
    os.environ["PATH"] = os.pathsep.join(folders)
    try:
        stream.spawn(default_blueprint=blueprint(first))
    except RuntimeError as error:
        reason = str(error).splitlines()[0]
        raise InputError(
            f"expected Rerun to open a window, found: {reason}; write a file with --save or --html"
        ) from None

    log(stream, frames, taxonomy)
    stream.disconnect()


def log(stream: Any, frames: Iterable[Frame], taxonomy: Taxonomy) -> None:
    """Log scans to a recording stream, each at its own step of the timeline.

    The entities are `points`, `truth`, `labels/METHOD`, `errors/METHOD` and `uncertain`. Those
    under `percent` hold the shares of errors and of uncertain points.
    """
    rerun = check_rerun()
    names = ("unlabelled", *taxonomy.classes)
    colors = (UNLABELLED, *class_colors(taxonomy.colors)[1:])
    classes = []
    for class_id, (name, color) in enumerate(zip(names, colors, strict=True)):
        classes.append(rerun.AnnotationInfo(id=class_id, label=name, color=color))
    context = rerun.AnnotationContext(classes)
    stream.log("/", context, rerun.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)

    for step, frame in enumerate(frames):
        stream.set_time(TIMELINE, sequence=step)
        stream.log("name", rerun.TextLog(frame.name))
        _log_points(stream, rerun, frame)
        _log_shares(stream, rerun, frame)


def blueprint(frame: Frame) -> Any:
    """Return a layout with views of all that this frame has; the others are taken to have the same.

    Ground truth, labels, errors and uncertain points lie side by side, above a curve of the shares
    of errors and uncertain points. The labels of several methods share a place, as tabs; so do
    their errors.
    """
    import rerun.blueprint as rrb

    has_errors = len(frame.labels) > 0 and frame.truth is not None
    has_uncertain = frame.uncertain is not None
    labels = []
    errors = []
    for method in frame.labels:
        title = title_of(method)
        labels.append(_view(title, f"/labels/{method}"))
        errors.append(_view(f"errors of {title}", "/points", f"/errors/{method}"))

    views = []
    if frame.truth is not None:
        views.append(_view("truth", "/truth"))
    if labels:
        views.append(_tabs(labels))
    if has_errors:
        views.append(_tabs(errors))
    if has_uncertain:
        views.append(_view("uncertain", "/points", "/uncertain"))
    if not views:
        views.append(_view("points", "/points"))

    layout = rrb.Grid(*views)
    if has_errors or has_uncertain:
        shares = rrb.TimeSeriesView(origin="/percent", name="percent of the points")
        layout = rrb.Vertical(layout, shares, row_shares=[5, 1])
    return rrb.Blueprint(layout, collapse_panels=True)


def _view(name: str, *paths: str) -> Any:
    """Return a 3D view of the entities at these paths."""
    import rerun.blueprint as rrb

    return rrb.Spatial3DView(origin="/", contents=list(paths), name=name, background=BACKGROUND)


def _tabs(views: list[Any]) -> Any:
    """Return views as tabs, the last one in front."""
    import rerun.blueprint as rrb

    return rrb.Tabs(*views, active_tab=len(views) - 1)


def _peek(frames: Iterable[Frame]) -> tuple[Frame, Iterable[Frame]]:
    """Return the first frame, and an iterable of all frames, including the first."""
    iterator = iter(frames)
    first = next(iterator)
    return first, chain([first], iterator)


def _new_stream() -> Any:
    return check_rerun().RecordingStream("amvnet")


def _log_points(stream: Any, rerun: Any, frame: Frame) -> None:
    dot = rerun.Radius.ui_points(DOT)
    large_dot = rerun.Radius.ui_points(LARGE_DOT)
    xyz = frame.points[frame.valid, :3]

    colors = RIGHT if frame.labels else _height_colors(xyz)
    stream.log("points", rerun.Points3D(xyz, radii=dot, colors=colors))
    if frame.truth is not None:
        class_ids = frame.truth[frame.valid]
        stream.log("truth", rerun.Points3D(xyz, radii=dot, class_ids=class_ids))

    for method, ids in frame.labels.items():
        class_ids = ids[frame.valid]
        stream.log(f"labels/{method}", rerun.Points3D(xyz, radii=dot, class_ids=class_ids))
        errors = frame.errors(method)
        if errors is not None:
            wrong = frame.points[frame.valid & errors, :3]
            stream.log(f"errors/{method}", rerun.Points3D(wrong, radii=large_dot, colors=WRONG))

    if frame.uncertain is not None:
        uncertain = frame.points[frame.valid & frame.uncertain, :3]
        stream.log("uncertain", rerun.Points3D(uncertain, radii=large_dot, colors=UNCERTAIN))


def _log_shares(stream: Any, rerun: Any, frame: Frame) -> None:
    """Log how many percent of the labelled points are wrong, and of all points uncertain."""
    for method in frame.labels:
        errors = frame.errors(method)
        if errors is not None and frame.truth is not None:
            scored = max((frame.truth > 0).sum(), 1)
            stream.log(f"percent/wrong/{method}", rerun.Scalars(100 * errors.sum() / scored))

    if frame.uncertain is not None:
        stream.log("percent/uncertain", rerun.Scalars(100 * frame.uncertain.mean()))


def _height_colors(xyz: np.ndarray) -> np.ndarray:
    """Return (N, 3) uint8 colours of (N, 3) points by their height."""
    from matplotlib import colormaps

    z = xyz[:, 2]
    low, high = np.percentile(z, (1, 99))
    share = np.clip((z - low) / max(high - low, 1e-6), 0, 1)
    return (colormaps["turbo"](share)[:, :3] * 255).astype(np.uint8)
