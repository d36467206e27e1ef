"""The verb that opens scans to look at: in Rerun, or as a page for a browser."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from amvnet.cli.console import progress, say
from amvnet.cli.options import parse_names
from amvnet.errors import InputError

if TYPE_CHECKING:
    from amvnet.viewing.frames import Frames


def view(
    inputs: list[str],
    labels: Path | None = None,
    weights: str | None = None,
    html: Path | None = None,
    save: Path | None = None,
    scans: int = 5,
    sequences: str | None = None,
    taxonomy: str | None = None,
    device: str = "cpu",
) -> None:
    """Look at scans, labels, uncertain points and errors in 3D: in a window of Rerun, or in a browser.

    Args:
        inputs: data sets, scan files, or folders of scans.
        labels: a folder of labels as predict writes them, or the label file of one scan.
        weights: instead, a weights file, or the name of a built-in one: the labels of every method are shown.
        html: write a page for a browser instead of opening a window.
        save: write a recording of Rerun instead of opening a window.
        scans: at most so many, evenly spaced.
        sequences: of data sets, which sequences or scenes, with commas; default: all.
        taxonomy: the classes of labels without a data set: semantickitti, nuscenes or a YAML file.
        device: cpu, cuda, cuda:1, ...
    """
    from amvnet.files import make_folder
    from amvnet.inference.methods import widest_method
    from amvnet.inference.segmenter import Segmenter
    from amvnet.viewing.frames import choose_frames
    from amvnet.viewing.rerun_log import check_rerun, check_window
    from amvnet.weights.file import load

    if labels is not None and weights is not None:
        raise InputError("expected --labels or --weights, found both; give one of them")
    if save is not None:
        check_rerun()
    elif html is None:
        check_window()
    for path in (html, save):  # so that nothing is segmented in vain
        if path is not None:
            make_folder(path.parent)
    segmenter = None
    if weights is not None:
        given = load(weights)
        segmenter = Segmenter(given, device, widest_method(given))
    chosen = choose_frames(inputs, scans, segmenter, labels, taxonomy, parse_names(sequences))
    _show(chosen, _title(inputs, weights), html, save)


def _show(chosen: Frames, title: str, html: Path | None, save: Path | None) -> None:
    """Make the frames once, for all that was asked for."""
    from amvnet.viewing.page import write_page
    from amvnet.viewing.rerun_log import open_window, save_recording

    with progress("looking") as step:
        made = chosen.each(step)
        frames = list(made) if html is not None and save is not None else made
        if save is not None:
            save_recording(save, frames, chosen.taxonomy)
        if html is not None:
            write_page(html, frames, chosen.taxonomy, title)
        if save is None and html is None:
            open_window(frames, chosen.taxonomy)
    if save is not None:
        say(f"{len(chosen)} scans in {save}; open it with: rerun {save}")
    if html is not None:
        say(f"{len(chosen)} scans in {html}; open it in a browser")


def _title(inputs: list[str], weights: str | None) -> str:
    """Of a page: the first input, and what labelled it."""
    more = f" and {len(inputs) - 1} more" if len(inputs) > 1 else ""
    return (
        Path(inputs[0]).resolve().name
        + more
        + ("" if weights is None else f" · {Path(weights).name}")
    )
