"""The classes of labelled points, as the file of these points names them.

Each class is a line of JSON, such as `amvnet class {"id": 10, "name": "car", "color": [...]}`: a
comment of PLY and PCD, and a record of LAS.
"""

from __future__ import annotations

import json
from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path

from amvnet.data.formats.registry import read_comments
from amvnet.data.taxonomy import TAXONOMIES, Taxonomy
from amvnet.errors import InputError

CLASSES = "amvnet classes "  # begins the line with the name of the classes
CLASS = "amvnet class "  # begins the line of a class; the first one is of points without a class
LONGEST = 60_000  # the longest legend that a header holds, bytes


def legend_of(taxonomy: Taxonomy) -> list[str]:
    """Return the lines of ASCII that name the classes, or none if they are too long."""
    lines = [CLASSES + json.dumps(taxonomy.name)]
    entries = zip(taxonomy.train_to_raw, taxonomy.names, taxonomy.colors, strict=True)
    for raw, name, color in entries:
        lines.append(CLASS + json.dumps({"id": raw, "name": name, "color": color}))
    return lines if sum(map(len, lines)) <= LONGEST else []


def read_legend(path: Path) -> Taxonomy | None:
    """Return the classes that a file of labelled points names; None if it names none.

    A broken file names none: whoever reads its points gets the error.
    """
    with suppress(InputError):
        return _parse(read_comments(path))
    return None


def _parse(comments: Iterable[str]) -> Taxonomy | None:
    name = ""
    entries = []
    with suppress(ValueError, KeyError, TypeError, RecursionError):  # comments of a stranger
        for comment in comments:
            if comment.startswith(CLASSES):
                name = json.loads(comment.removeprefix(CLASSES))
            elif comment.startswith(CLASS):
                values = json.loads(comment.removeprefix(CLASS))
                entries.append((values["id"], values["name"], values["color"]))
    if not entries:
        return None

    raw_ids, names, colors = zip(*entries, strict=True)
    known = TAXONOMIES.get(str(name))
    if known is not None and (known.names, known.train_to_raw) == (names, raw_ids):
        return known
    return Taxonomy.from_dict(
        {
            "name": name,
            "classes": names[1:],
            "colors": colors,
            "raw_to_train": [(raw, ids) for ids, raw in enumerate(raw_ids)],
            "train_to_raw": raw_ids,
            "splits": {},
            "counts_absent": False,
        }
    )
