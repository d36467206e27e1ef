"""Write the table of results of docs/results.json into the pages that show it.

    python docs/results.py

Each page has the table between the lines `<!-- results -->` and `<!-- end of results -->`:
README.md and docs/index.md the rows that are marked `readme`, docs/log.md all of them. Change
a figure in docs/results.json only, and run this. A test compares the pages with the file, also the
outputs of commands in them.
"""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[1]
FIGURES = ROOT / "docs/results.json"
SHORT = ("README.md", "docs/index.md")  # pages with the rows for the first screen
LONG = ("docs/log.md",)
METHODS = ("rv", "bev", "ensemble", "amvnet")
REGION = re.compile(r"(<!-- results -->\n).*?(<!-- end of results -->)", re.S)


def rows() -> list[dict[str, Any]]:
    """Return the rows of the file."""
    read = json.loads(FIGURES.read_text(encoding="utf-8"))["rows"]
    assert isinstance(read, list)
    return read


def table(chosen: list[dict[str, Any]]) -> str:
    """Return rows as a table in Markdown, the best method of each in bold."""
    lines = [
        "| Scans | Weights | RV | BEV | Ensemble | AMVNet | Uncertain |",
        "|---|---|---|---|---|---|---|",
    ]
    for row in chosen:
        best = max(row[method] for method in METHODS)
        cells = [row["scans"], f"`{row['weights']}`"]
        for method in METHODS:
            text = f"{row[method]:.1f}"
            cells.append(f"**{text}**" if row[method] == best else text)
        cells.append(f"{row['uncertain']:g} %" if "uncertain" in row else "")
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines)


def filled(page: str, text: str) -> str:
    """Return the text of a page with the present table."""
    chosen = rows() if page in LONG else [row for row in rows() if row.get("readme")]
    filled_text, count = REGION.subn(lambda match: f"{match[1]}{table(chosen)}\n{match[2]}", text)
    assert count == 1, f"{page}: expected one pair of markers, found {count}"
    return filled_text


def main() -> None:
    for page in (*SHORT, *LONG):
        path = ROOT / page
        path.write_text(filled(page, path.read_text(encoding="utf-8")), encoding="utf-8")


if __name__ == "__main__":
    main()
