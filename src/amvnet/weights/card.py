"""The model card of a weights file, as Markdown.

It says what the weights are, how to use them, what they were trained on and how well they score.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

import yaml

from amvnet.models.methods import widest_method
from amvnet.weights.file import Weights

TITLES = {
    "range_net": "Range-view network",
    "polar_net": "Bird's-eye-view network",
    "point_head": "Point head",
}
LISTED = 12  # longest list that is printed in full
DEEPEST = 6  # levels of a value that are printed
# Columns of the table: key of the validation metric, and title.
METRICS = {"val/miou": "mIoU", "val/miou_present": "mIoU, classes present", "val/acc": "accuracy"}
# Keys of the training record that describe the data, and their titles.
DATA = {"scans": "scans", "sequences": "sequences", "validated_on": "validated on"}
OURS = "apache-2.0"  # licence of the built-in weights, and of the package
NO_LICENCE = (
    "The file names no licence. Weights may be bound by the terms of the data that they were "
    "trained on: SemanticKITTI's and nuScenes' do not allow commercial use."
)


def model_card(weights: Weights, name: str, licence: str | None = None) -> str:
    """Return the card of a weights file, without the metadata of `front_matter`.

    Args:
        name: the name by which `amvnet.load` finds the weights.
        licence: the licence that their owner grants; None if it is not stated.
    """
    taxonomy = weights.taxonomy
    classes = f"{taxonomy.size} of {taxonomy.name}: {', '.join(taxonomy.classes)}."
    sections = [
        f"# {name}\n\n{_summary(weights)}",
        f"## How to use\n\n{_usage(weights, name)}",
        f"## Classes\n\n{classes}",
        f"## Sizes\n\n{_list(_sizes(weights))}",
        f"## Metrics\n\n{_metrics(weights)}",
    ]
    for part in weights.parts:
        sections.append(f"## Training: {part}\n\n{_training(weights, part)}")

    terms = NO_LICENCE if licence is None else f"{licence}, as the owner of the weights says."
    sections.append(f"## Licence\n\n{terms}")
    return "\n\n".join(sections) + "\n"


def front_matter(weights: Weights, licence: str | None = None) -> str:
    """Return the YAML at the top of a card, from which the hub reads its metadata."""
    metadata = {
        "library_name": "amvnet",
        "tags": ["lidar", "point-cloud", "semantic-segmentation", weights.taxonomy.name],
    }

    if licence is not None:
        metadata["license"] = licence

    return f"---\n{yaml.safe_dump(metadata, sort_keys=False)}---\n\n"


def _summary(weights: Weights) -> str:
    sensor = f" of the sensor {weights.sensor}" if weights.sensor else ""
    parts = []
    for part in weights.parts:
        parts.append(f"{TITLES[part].lower()} (`{part}`)")

    return (
        f"LiDAR semantic segmentation (AMVNet, arXiv 2012.04934) for scans{sensor}. "
        f"In this file: {', '.join(parts) or 'nothing'}."
    )


def _usage(weights: Weights, name: str) -> str:
    """Return a few lines of Python that use the weights."""
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


def _sizes(weights: Weights) -> list[tuple[str, str]]:
    """Return titles and texts: the size and extent of each view, and the assertion."""
    model = weights.model
    rows = []
    if "range_net" in weights.parts:
        view = model.range_view
        field_of_view = f"{view.fov_up:+g} to {view.fov_down:+g} degrees"
        if view.rows == "ring":
            field_of_view = "by ring"
        rows.append(("range view", f"{view.height} x {view.width}, {field_of_view}"))

    if "polar_net" in weights.parts:
        grid = model.polar_view
        cells = f"{grid.radial} x {grid.angular} x {grid.vertical}"
        radius = f"{grid.radius_min:g} to {grid.radius_max:g} m"
        height = f"height {grid.z_min:g} to {grid.z_max:g} m"
        rows.append(("polar view", f"{cells}, {radius}, {height}"))

    rows.append(("uncertain points", f"disagreement at {model.assertion.threshold:g}"))
    return rows


def _metrics(weights: Weights) -> str:
    """Return a table of the validation metrics in percent, one row per part.

    The row of a network is that network alone; the row of the head is the whole method.
    """
    lines = [f"| | {' | '.join(METRICS.values())} |", "|---" * (len(METRICS) + 1) + "|"]
    for part in weights.parts:
        metrics = weights.metrics.get(part, {})
        cells = [TITLES[part]]
        for key in METRICS:
            cells.append(_percent(metrics.get(key)))
        lines.append(f"| {' | '.join(cells)} |")

    return 'In percent, on the scans listed below as "validated on":\n\n' + "\n".join(lines)


def _percent(value: Any) -> str:
    return f"{100 * value:.1f}" if isinstance(value, float) else "–"


def _training(weights: Weights, part: str) -> str:
    """Return a list of a part's size, its training data and its training settings."""
    count = 0
    for tensor in weights.part(part).values():
        count += tensor.numel()

    rows = [("values", f"{count:,}")]
    # The data come first, then the settings in their own order.
    record = weights.training.get(part, {})
    for key, title in DATA.items():
        if key in record:
            rows.append((title, _plain(record[key])))
    for key, value in record.items():
        if key not in DATA:
            rows.append((key, _plain(value)))

    return _list(rows)


def _list(rows: Iterable[tuple[str, str]]) -> str:
    return "\n".join(f"- {key}: {value}" for key, value in rows)


def _plain(value: Any, depth: int = 0) -> str:
    """Return a value of the training record as text; long lists and deep values are abridged."""
    if isinstance(value, Mapping | list) and depth == DEEPEST:
        return "..."
    if isinstance(value, Mapping):
        items = [f"{key} {_plain(item, depth + 1)}" for key, item in value.items()]
        return ", ".join(items)
    if isinstance(value, list):
        if len(value) > LISTED:
            ends = [_plain(item, depth + 1) for item in (value[0], value[-1])]
            return f"{len(value)}, from {ends[0]} to {ends[1]}"
        return ", ".join(_plain(item, depth + 1) for item in value)

    return f"{value:.4g}" if isinstance(value, float) else str(value)
