"""Write the model card of a weights file, as Markdown.

The card says what the weights are, how to use them, how they were trained and how well they score.
"""

from __future__ import annotations

import reprlib
from itertools import islice

import yaml

from amvnet.config.nested import flat
from amvnet.config.schema import PART_OF
from amvnet.models.methods import widest_method
from amvnet.weights.file import Weights

TITLES = {part.name: part.title for part in PART_OF.values()}
# The columns of the table of metrics: their titles, by the key of the validation metric.
METRICS = {"val/miou": "mIoU", "val/miou_present": "mIoU, classes present", "val/acc": "accuracy"}
MAX_SETTINGS = 100  # largest number of settings that the card lists of a part's training
LONGEST_CELL = 300  # largest number of characters in a cell of a table
BUILT_IN_LICENCE = "apache-2.0"  # the licence of the built-in weights
NO_LICENCE = (
    "The file names no licence. Weights may be bound by the terms of the data that they were "
    "trained on: SemanticKITTI's and nuScenes' do not allow commercial use."
)


def model_card(weights: Weights, name: str, licence: str | None = None) -> str:
    """Return the card of a weights file, without the metadata of `front_matter`.

    `name` is what `amvnet.load` takes; `licence` is what the owner of the weights grants, if known.
    """
    abridged = reprlib.Repr()
    abridged.maxdict = 40
    abridged.maxlist = 12

    taxonomy = weights.taxonomy
    classes = f"{taxonomy.size} of {taxonomy.name}: {', '.join(taxonomy.classes)}."
    sections = [
        f"# {name}\n\n{_summary(weights)}",
        f"## How to use\n\n{_usage(weights, name)}",
        f"## Classes\n\n{classes}",
        f"## Sizes\n\n{_sizes(weights)}",
        f"## Metrics\n\n{_metrics(weights)}",
    ]
    for part in weights.parts:
        lines = [f"## Training: {part}\n", "| Setting | Value |", "|---|---|"]
        for key, value in islice(flat(weights.training.get(part, {}), depth=3), MAX_SETTINGS):
            text = value if isinstance(value, str) else abridged.repr(value)
            lines.append(f"| {_cell(key)} | {_cell(text)} |")
        sections.append("\n".join(lines))

    terms = NO_LICENCE if licence is None else f"{licence}, as the owner of the weights says."
    sections.append(f"## Licence\n\n{terms}")
    return "\n\n".join(sections) + "\n"


def _cell(text: str) -> str:
    """Shorten a text and remove what would end the cell of a table."""
    return " ".join(text[:LONGEST_CELL].split()).replace("|", "\\|")


def front_matter(weights: Weights, licence: str | None = None) -> str:
    """Return the YAML at the top of a card; the hub reads its metadata from it."""
    metadata = {
        "library_name": "amvnet",
        "tags": ["lidar", "point-cloud", "semantic-segmentation", weights.taxonomy.name],
    }

    if licence is not None:
        metadata["license"] = licence

    return f"---\n{yaml.safe_dump(metadata, sort_keys=False)}---\n\n"


def _summary(weights: Weights) -> str:
    sensor = f" of the sensor {weights.sensor}" if weights.sensor else ""
    parts = [f"{TITLES[part].lower()} (`{part}`)" for part in weights.parts]
    return (
        f"LiDAR semantic segmentation (AMVNet, arXiv 2012.04934) for scans{sensor}. "
        f"In this file: {', '.join(parts) or 'nothing'}."
    )


def _usage(weights: Weights, name: str) -> str:
    if weights.parts == ("point_head",):
        call = (
            f'labels = amvnet.fuse(points, f, g, head="{name}")'
            "  # f, g: the two models' class probabilities"
        )
    else:
        method = ""
        if "point_head" not in weights.parts:
            method = f', method="{widest_method(weights.parts)}"'
        call = f'segmenter = amvnet.load("{name}"{method})\nresult = segmenter(points)'

    return (
        f"```python\nimport amvnet\n\n{call}\n```\n\n"
        "`points` is (N, 4): x, y, z in metres and intensity in [0, 1]."
    )


def _sizes(weights: Weights) -> str:
    image = weights.model.range_view
    grid = weights.model.polar_view
    return (
        f"- range view: {image.height} x {image.width}\n"
        f"- polar view: {grid.radial} x {grid.angular} x {grid.vertical}\n"
        f"- tau: {weights.model.assertion.threshold:g}"
    )


def _metrics(weights: Weights) -> str:
    """Return a table of the validation metrics in percent, one row per part.

    The row of a network scores this network alone; the row of the head scores the whole method.
    """
    lines = [f"| | {' | '.join(METRICS.values())} |", "|---" * (len(METRICS) + 1) + "|"]
    for part in weights.parts:
        metrics = weights.metrics.get(part, {})
        cells = [TITLES[part]]
        for key in METRICS:
            value = metrics.get(key)
            cells.append(f"{100 * value:.1f}" if isinstance(value, float) else "–")
        lines.append(f"| {' | '.join(cells)} |")

    return "In percent, on the scans that are listed below as validated_on:\n\n" + "\n".join(lines)
