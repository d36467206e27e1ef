"""The verb `view`."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING

from amvnet.cli.console import progress, say
from amvnet.cli.options import ComputeChoice, ScanChoice, SensorChoice
from amvnet.errors import InputError
from amvnet.models.methods import widest_method
from amvnet.progress import counted

if TYPE_CHECKING:
    from amvnet.viewing.frames import Frame, Frames


def view(
    inputs: list[str],
    choice: ScanChoice,
    known: SensorChoice,
    compute: ComputeChoice,
    labels: Path | None = None,
    weights: str | None = None,
    html: Path | None = None,
    save: Path | None = None,
    scans: int = 5,
    taxonomy: str | None = None,
) -> None:
    """Look at scans, labels, uncertain points and errors in 3D: in Rerun, or in a browser.

    Args:
        inputs: datasets, scan files, bags, folders of these, or patterns such as 'drive/*.bin'.
        choice: which scans of the inputs.
        known: what is known of the sensor of scan files.
        compute: where and how the networks are computed.
        labels: a folder of labels as predict writes them, in any of its formats, or the label file
            of one scan.
        weights: instead, a weights file, or the name of a built-in one: the labels of every method
            are shown.
        html: write a page for a browser instead of opening a window.
        save: write a recording of Rerun instead of opening a window.
        scans: at most this many, evenly spaced.
        taxonomy: the classes of labels without a dataset: semantickitti, nuscenes or a YAML file.
    """
    from amvnet.files import make_folder
    from amvnet.viewing.frames import LabelSource, choose_frames
    from amvnet.viewing.rerun_log import check_rerun, check_window
    from amvnet.weights.file import load

    if labels is not None and weights is not None:
        raise InputError("expected --labels or --weights, found both; give one of them")
    sensor = known.parse()
    if save is not None:
        check_rerun()
    elif html is None:
        check_window()
    # Before any scan is segmented, so that no time is wasted if a folder cannot be made.
    for path in (html, save):
        if path is not None:
            make_folder(path.parent)

    segmenter = None
    if weights is not None:
        loaded = load(weights)
        segmenter = compute.segmenter(loaded, widest_method(loaded.parts))
    source = LabelSource(segmenter, labels, taxonomy)
    frames = choose_frames(inputs, scans, source, choice.parse(), sensor=sensor, say=say)
    _show(frames, _title(inputs, weights), html, save)


def _show(chosen: Frames, title: str, html: Path | None, save: Path | None) -> None:
    """Make the frames once, and show them in every way that was asked for."""
    from amvnet.viewing.page import write_page
    from amvnet.viewing.rerun_log import open_window, save_recording

    with progress("looking") as step:
        frames: Iterable[Frame] = chosen.each(step)
        if html is not None and save is not None:  # they are read twice
            frames = list(frames)
        if save is None and html is None:
            open_window(frames, chosen.taxonomy)
        if save is not None:
            save_recording(save, frames, chosen.taxonomy)
        if html is not None:
            write_page(html, frames, chosen.taxonomy, title)

    if save is not None:
        say(f"{counted(len(chosen), 'scan')} in {save}; open it with: rerun {save}")
    if html is not None:
        say(f"{counted(len(chosen), 'scan')} in {html}; open it in a browser")


def _title(inputs: list[str], weights: str | None) -> str:
    """Return the title of a page: the first input, and what labelled it."""
    title = Path(inputs[0]).resolve().name
    if len(inputs) > 1:
        title += f" and {len(inputs) - 1} more"
    if weights is not None:
        title += f" · {Path(weights).name}"
    return title
