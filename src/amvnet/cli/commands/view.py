"""The command `view`."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from amvnet.cli.console import progress, report
from amvnet.cli.options import ScanChoice, SensorChoice, load_segmenter, map_to, open_inputs
from amvnet.config.bounds import Count
from amvnet.engines.compute import Compute
from amvnet.errors import InputError, counted
from amvnet.models.methods import widest_method


def view(
    inputs: list[str],
    /,
    choice: ScanChoice,
    sensor_choice: SensorChoice,
    compute: Compute,
    labels: Path | None = None,
    weights: str | None = None,
    html: Path | None = None,
    scans: Count = 5,
    taxonomy: Literal["semantickitti", "nuscenes"] | None = None,
    classes: str | None = None,
    overwrite: bool = False,
) -> None:
    """Look at scans, labels, uncertain points and errors in 3D, in a browser.

    Args:
        inputs: datasets, scan files, bags, folders of these, or patterns such as 'drive/*.bin'.
        choice: which scans of the inputs to show.
        sensor_choice: what is known about the sensor of scan files.
        compute: where and how the networks are computed.
        labels: a folder of labels as predict writes them, in any of its formats, or the label file
            of a single scan.
        weights: a weights file, the name of built-in weights, or auto, for the built-in weights
            that suit the lasers, instead of labels. The page then shows the labels of every method.
        html: the page to write, which gets the ending .html if it has none; default: a temporary
            page, which opens in the browser.
        scans: largest number of scans; they are evenly spaced in the inputs.
        taxonomy: the classes of labels that belong to no dataset.
        classes: the classes to show: coarse, lidog, or a YAML file, as predict took it to write the
            labels. It maps the classes of the data and of the weights to them.
        overwrite: replace the page if it exists.
    """
    from amvnet.data.recordings import evenly_spaced
    from amvnet.data.taxonomy import TAXONOMIES
    from amvnet.files import check_outputs, make_folder
    from amvnet.sensors.normalise import Normaliser
    from amvnet.viewing.page import PAGE, open_page, page_name, place_for_page, write_page
    from amvnet.viewing.shown_scans import check_labels, show_scans

    if labels is not None and weights is not None:
        raise InputError("expected --labels or --weights, found both; give one of them")
    if taxonomy is not None and weights is not None:
        raise InputError(
            "expected no --taxonomy together with --weights, which define their classes; "
            "leave it out"
        )
    if taxonomy is not None and classes is not None:
        raise InputError("expected --taxonomy or --classes, found both; give one of them")
    # Check the page's place before any scan is segmented, so that no time is wasted.
    if html is not None:
        html = page_name(html)
        also_read = [*inputs, labels, weights, classes, sensor_choice.sensor]
        check_outputs({html: PAGE}, also_read, overwrite)
        make_folder(html.parent)

    named = None if taxonomy is None else TAXONOMIES[taxonomy]
    segmenter = None
    if weights is None:
        found = choice.find(inputs, sensor_choice)
        found_scans, shown_classes = found.scans(
            named, Normaliser(None, found.reading.sensor, report)
        )
        mapping = map_to(classes)
    else:
        found, weights, loaded = open_inputs(inputs, choice, sensor_choice, weights)
        mapping = map_to(classes, loaded.taxonomy, *found.taxonomies)
        shown_classes = loaded.taxonomy
        if mapping is None:
            found_scans = found.for_weights(loaded, report)
        else:  # the data may have other classes than the weights
            normaliser = Normaliser(loaded.expects, found.reading.sensor, report)
            found_scans, _ = found.scans(normaliser=normaliser)
        segmenter = load_segmenter(loaded, widest_method(loaded.parts), compute)
    if labels is not None:
        check_labels(labels, len(found_scans), mapping)
    if mapping is not None:
        shown_classes = mapping.target
    chosen = evenly_spaced(found_scans, scans)
    with place_for_page(html) as page, progress("looking") as step:
        shown = show_scans(chosen, segmenter, labels, step, mapping)
        write_page(page, shown, shown_classes, _title(inputs, weights))
    part = f"{len(chosen)} of " if len(chosen) < len(found_scans) else ""
    report(f"{part}{counted(len(found_scans), 'scan')} in {page}; open it in a browser")
    if html is None:
        open_page(page)


def _title(inputs: list[str], weights: str | None) -> str:
    """Return the title of a page: the name of the first input, and of the weights if any label."""
    title = Path(inputs[0]).resolve().name
    if len(inputs) > 1:
        title += f" and {len(inputs) - 1} more"
    if weights is not None:
        title += f" · {Path(weights).name}"
    return title
