"""Read the tables of numbers that lie next to the code."""

import tomllib
from pathlib import Path
from typing import Any


def read_table(path: Path) -> dict[str, dict[str, Any]]:
    """Return the rows of a TOML file by name; arrays become tuples."""
    table = tomllib.loads(path.read_text(encoding="utf-8"))
    for row in table.values():
        row.update({column: _without_lists(value) for column, value in row.items()})
    return table


def _without_lists(value: Any) -> Any:
    return tuple(map(_without_lists, value)) if isinstance(value, list) else value
