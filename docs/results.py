"""Write the tables of docs/results.json into the pages that show them.

    python docs/results.py

Each table stands between the lines `<!-- NAME -->` and `<!-- end of NAME -->`. Change figures only
in docs/results.json, and run this. A test compares the tables of the pages, and the outputs of
commands on them, with the file.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[1]
FIGURES = ROOT / "docs/results.json"
PAGES = (
    "README.md",
    "docs/results.md",
    "docs/log.md",
    "docs/evaluation.md",
    "docs/finetuning.md",
)
PRINTED_METHODS = ("rv", "bev", "ensemble", "amvnet", "drive")
# The seven classes of the map `lidog`, in its order.
SEVEN = ("vehicle", "person", "road", "sidewalk", "terrain", "man-made", "vegetation")
TRUSTED = 60.0  # the least IoU of a class that can be trusted, percent
CHECKED = 30.0  # the least IoU of a class whose points are worth checking, percent
FEWEST_PLACES = 3  # a class in fewer places is not trusted, whatever its IoU


def read() -> dict[str, Any]:
    """Return the figures of the file."""
    figures = json.loads(FIGURES.read_text(encoding="utf-8"))
    assert isinstance(figures, dict)
    return figures


def main_rows() -> str:
    """Return the table of the rows that are marked `readme`, with all methods."""
    return table([row for row in read()["rows"] if row.get("readme")])


def everything() -> str:
    """Return the table of all rows, each followed by its accuracy and its seven classes."""
    rows = []
    for row in read()["rows"]:
        rows.append(row)
        for key, title in (("accuracy", "accuracy"), ("seven", "seven classes")):
            if key in row:
                rows.append({"scans": f"the same, {title}", "weights": row["weights"], **row[key]})
    return table(rows)


def hidden() -> str:
    """Return the table of the scans that decided nothing about the weights, for new users."""
    titles = ("Scans", "Points with the right label", "mIoU, seven classes", "mIoU, all classes")
    lines = []
    for row in read()["rows"]:
        if row.get("hidden"):
            seven = f"{row['seven']['amvnet']:.1f}" if "seven" in row else ""
            scans = row["scans"].replace(", hidden", "")
            right = f"{row['accuracy']['amvnet']:.1f} %"
            lines.append([scans, right, seven, f"{row['amvnet']:.1f}"])
    return markdown(titles, lines)


def trust() -> str:
    """Return the table that says which classes can be trusted on real scans."""
    datasets = read()["classes"]
    bands: dict[str, list[str]] = {
        f"**Trust**: IoU over {TRUSTED:g}": [],
        f"**Check**: {CHECKED:g} to {TRUSTED:g}": [],
        f"**Do not rely on**: under {CHECKED:g}, or in fewer than three places": [],
    }
    for classes in datasets.values():
        chosen: list[list[str]] = [[], [], []]
        for name, (iou, places) in sorted(classes.items(), key=lambda item: -item[1][0]):
            is_rare = places < FEWEST_PLACES
            band = 2 if is_rare or iou < CHECKED else 1 if iou < TRUSTED else 0
            chosen[band].append(f"{name.replace('_', ' ')} {iou:.0f}")
        for cells, names in zip(bands.values(), chosen, strict=True):
            cells.append(", ".join(names))

    return markdown(["", *datasets], [[title, *cells] for title, cells in bands.items()])


def seven_classes() -> str:
    """Return the table of the IoU of AMVNet in each of the seven classes."""
    lines = []
    for row in read()["rows"]:
        if "seven_classes" in row:
            figures = [*row["seven_classes"], row["seven"]["amvnet"]]
            lines.append([row["scans"], *(f"{iou:.1f}" for iou in figures)])
    return markdown(["Scans", *SEVEN, "mean"], lines)


def finetuning() -> str:
    """Return the table of fine-tuning."""
    lines = []
    for row in read()["finetuning"]:
        pairs = (row["before"], row["after"])
        scores = [f"{miou:.1f} ({accuracy:.1f})" for miou, accuracy in pairs]
        lines.append([row["labelled"], row["tested"], *scores])
    titles = ("Labelled scans", "Tested on", "Zero-shot", "Fine-tuned, with simulated streets")
    return markdown(titles, lines)


def table(rows: list[dict[str, Any]]) -> str:
    """Return rows as a table in Markdown; the best method of each row is in bold."""
    methods = ("RV", "BEV", "Ensemble", "AMVNet", "Drive")
    lines = []
    for row in rows:
        best = max(row[method] for method in PRINTED_METHODS if method in row)
        cells = [row["scans"], f"`{row['weights']}`"]
        for method in PRINTED_METHODS:
            if method not in row:
                cells.append("")
                continue
            text = f"{row[method]:.1f}"
            cells.append(f"**{text}**" if row[method] == best else text)
        cells.append(f"{row['uncertain']:g} %" if "uncertain" in row else "")
        lines.append(cells)
    return markdown(["Scans", "Weights", *methods, "Uncertain"], lines)


def markdown(titles: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Return a table in Markdown, given the titles of its columns."""
    header, *lines = (f"| {' | '.join(cells)} |" for cells in (titles, *rows))
    return "\n".join([header, "|---" * len(titles) + "|", *lines])


TABLES = {
    "results": main_rows,
    "all results": everything,
    "hidden scans": hidden,
    "trust": trust,
    "seven classes": seven_classes,
    "results of fine-tuning": finetuning,
}


def filled(text: str) -> str:
    """Return the text of a page with the present tables."""
    for name, write in TABLES.items():
        region = re.compile(rf"(<!-- {name} -->\n).*?(<!-- end of {name} -->)", re.S)
        text = region.sub(rf"\g<1>{write()}\n\g<2>", text)
    return text


def main() -> None:
    for page in PAGES:
        path = ROOT / page
        path.write_text(filled(path.read_text(encoding="utf-8")), encoding="utf-8")


if __name__ == "__main__":
    main()
