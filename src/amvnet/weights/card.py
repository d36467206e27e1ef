"""The card of a weights file: what it is, what it was trained on, what it reaches, and how to use it, as Markdown."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import yaml

from amvnet.weights.file import Weights

TITLES = {
    "range_net": "Range-view network",
    "polar_net": "Bird's-eye-view network",
    "point_head": "Point head",
}
LISTED = 12  # names that are listed in full
METRICS = {"val/miou": "mIoU", "val/miou_present": "mIoU, classes present", "val/acc": "accuracy"}
DATA = {"scans": "scans", "sequences": "sequences", "validated_on": "validated on"}
OURS = "apache-2.0"  # of the built-in weights, as of the package
NO_LICENCE = (
    "The file names no licence. Weights may be bound by the terms of the data that they were trained on: "
    "SemanticKITTI's and nuScenes' do not allow commercial use."
)


def model_card(weights: Weights, name: str, licence: str | None = None) -> str:
    """Markdown for people.

    Args:
        name: by which `amvnet.load` finds the weights.
        licence: under which they may be used, as their owner says.
    """
    said = NO_LICENCE if licence is None else f"{licence}, as the owner of the weights says."
    sections = [
        f"# {name}\n\n{_summary(weights)}",
        "## How to use\n\n" + _use(weights, name),
        f"## Classes\n\n{weights.taxonomy.size} of {weights.taxonomy.name}: {', '.join(weights.taxonomy.classes)}.",
        "## Sizes\n\n" + _list(_sizes(weights)),
        f"## Metrics\n\n{_metrics(weights)}",
        *(f"## Training: {part}\n\n{_training(weights, part)}" for part in weights.parts),
        f"## Licence\n\n{said}",
    ]
    return "\n\n".join(sections) + "\n"


def front_matter(weights: Weights, licence: str | None = None) -> str:
    """What the hub reads of a card, before the Markdown."""
    known = {
        "library_name": "amvnet",
        "tags": ["lidar", "point-cloud", "semantic-segmentation", weights.taxonomy.name],
        **({} if licence is None else {"license": licence}),
    }
    return f"---\n{yaml.safe_dump(known, sort_keys=False)}---\n\n"


def _summary(weights: Weights) -> str:
    parts = ", ".join(f"{TITLES[part].lower()} (`{part}`)" for part in weights.parts) or "nothing"
    sensor = f" of the sensor {weights.sensor}" if weights.sensor else ""
    return f"LiDAR semantic segmentation (AMVNet, arXiv 2012.04934) for scans{sensor}. In this file: {parts}."


def _use(weights: Weights, name: str) -> str:
    if weights.parts == ("point_head",):
        call = f'labels = amvnet.fuse(points, f, g, head="{name}")  # f, g: the two models\' class probabilities'
    else:
        method = "" if "point_head" in weights.parts else f', method="{_method(weights.parts)}"'
        call = f'segmenter = amvnet.load("{name}"{method})\nresult = segmenter(points)'
    lines = "import amvnet\n\n" + call
    return (
        f"```python\n{lines}\n```\n\n`points` is (N, 4): x, y, z in metres and intensity in [0, 1]."
    )


def _method(parts: Sequence[str]) -> str:
    """The most that networks without a head can do."""
    return "ensemble" if len(parts) > 1 else "rv" if "range_net" in parts else "bev"


def _sizes(weights: Weights) -> Iterator[tuple[str, str]]:
    model, parts = weights.model, weights.parts
    if "range_net" in parts:
        view = model.range_view
        field = (
            "by ring" if view.rows == "ring" else f"{view.fov_up:+g} to {view.fov_down:+g} degrees"
        )
        yield "range view", f"{view.height} x {view.width}, {field}"
    if "polar_net" in parts:
        grid = model.polar_view
        yield (
            "polar view",
            f"{grid.radial} x {grid.angular} x {grid.vertical}, {grid.radius_min:g} to {grid.radius_max:g} m, "
            f"height {grid.z_min:g} to {grid.z_max:g} m",
        )
    yield "uncertain points", f"{model.assertion.name}, threshold {model.assertion.threshold:g}"


def _metrics(weights: Weights) -> str:
    """Of validation, in percent: of each network alone, and of the whole method with the head."""
    rows = ["| | " + " | ".join(METRICS.values()) + " |", "|---" * (len(METRICS) + 1) + "|"]
    for part in weights.parts:
        reached = weights.metrics.get(part, {})
        shown = [
            f"{100 * reached[key]:.1f}" if isinstance(reached.get(key), float) else "–"
            for key in METRICS
        ]
        rows.append(f"| {TITLES[part]} | {' | '.join(shown)} |")
    return "On the scans named below as validated on, %:\n\n" + "\n".join(rows)


def _training(weights: Weights, part: str) -> str:
    """What a part learnt from, and how."""
    known, count = (
        weights.training.get(part, {}),
        sum(v.numel() for v in weights.part(part).values()),
    )
    data = [(title, known[key]) for key, title in DATA.items() if key in known]
    rest = [(key, value) for key, value in known.items() if key not in DATA]
    return _list(
        [("values", f"{count:,}"), *((key, _plain(value)) for key, value in (*data, *rest))]
    )


def _list(rows: Iterator[tuple[str, str]] | Sequence[tuple[str, str]]) -> str:
    return "\n".join(f"- {key}: {value}" for key, value in rows)


def _plain(value: Any) -> str:
    if isinstance(value, Mapping):
        return ", ".join(f"{k} {_plain(v)}" for k, v in value.items())
    if isinstance(value, list):
        names = [str(one) for one in value]
        return (
            ", ".join(names)
            if len(names) <= LISTED
            else f"{len(names)}, from {names[0]} to {names[-1]}"
        )
    return f"{value:.4g}" if isinstance(value, float) else str(value)
