"""Write the tables of docs/results.json into the pages that show them.

    python docs/results.py

Each page has its table between the lines `<!-- results -->` and `<!-- end of results -->`. Change
figures only in docs/results.json, and run this. A test compares the tables of the pages, and the
outputs of commands on them, with the file.
"""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[1]
FIGURES = ROOT / "docs/results.json"
PRINTED_METHODS = ("rv", "bev", "plain", "ensemble", "amvnet", "drive")
REGION = re.compile(r"(<!-- results -->\n).*?(<!-- end of results -->)", re.S)


def read() -> dict[str, list[dict[str, Any]]]:
    """Return the rows of the file, for the built-in weights and for fine-tuning."""
    figures = json.loads(FIGURES.read_text(encoding="utf-8"))
    assert isinstance(figures, dict)
    return figures


def first_screen() -> str:
    """Return the table of the rows that are marked `readme`."""
    return table([row for row in read()["rows"] if row.get("readme")])


def everything() -> str:
    """Return the table of all rows."""
    return table(read()["rows"])


def finetuning() -> str:
    """Return the table of fine-tuning."""
    lines = [
        "| Labelled scans | Tested on | Zero-shot | Fine-tuned, with simulated streets |",
        "|---|---|---|---|",
    ]
    for row in read()["finetuning"]:
        cells = [row["labelled"], row["tested"]]
        for miou, accuracy in (row["before"], row["after"]):
            cells.append(f"{miou:.1f} ({accuracy:.1f})")
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines)


# The table of each page.
PAGES = {
    "README.md": first_screen,
    "docs/index.md": first_screen,
    "docs/log.md": everything,
    "docs/finetuning.md": finetuning,
}


def table(rows: list[dict[str, Any]]) -> str:
    """Return rows as a table in Markdown; the best method of each row is in bold."""
    lines = [
        "| Scans | Weights | RV | BEV | Plain ensemble | Ensemble | AMVNet | Drive | Uncertain |",
        "|---|---|---|---|---|---|---|---|---|",
    ]
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
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines)


def filled(page: str, text: str) -> str:
    """Return the text of a page with the present table."""
    new = PAGES[page]()
    filled_text, count = REGION.subn(lambda match: f"{match[1]}{new}\n{match[2]}", text)
    if count != 1:
        raise ValueError(f"{page}: expected one pair of markers, found {count}")
    return filled_text


def main() -> None:
    for page in PAGES:
        path = ROOT / page
        path.write_text(filled(page, path.read_text(encoding="utf-8")), encoding="utf-8")


if __name__ == "__main__":
    main()
