"""Read scans from text files, with a line of numbers for each point."""

from __future__ import annotations

import re
from dataclasses import dataclass
from io import StringIO
from itertools import islice
from pathlib import Path

import numpy as np

from amvnet.data.formats import cloud
from amvnet.data.formats.rows import UNKNOWN, RowLayout, describe, name_columns, named_cloud
from amvnet.errors import InputError

HEAD = 65_536  # the size of the head of a file, which must hold the first points, bytes
MAX_COLUMNS = 200  # largest number of columns of a line that are considered
CHECKED_LINES = 20  # the number of lines that are checked to have the same columns
UNNAMED_COLUMNS = 7  # the number of columns that are read if they have no names
COMMENTS = ("#", "//", "%")  # the marks that begin a comment
# Numbers are ASCII; comments and names of columns may be in any encoding.
ENCODING = "utf-8-sig"
CONTROL = re.compile(r"[\x00-\x08\x0e-\x1f]")
# The separators of values, in the order in which they are tried. None stands for white space.
SEPARATORS = (";", ",", None)
# The names of coordinates in other programs, such as "Points:0" in ParaView and VeloView.
POINTS_NAME = re.compile(r"points?(?:_m_xyz)?[:_](\d)")
FIRST_RETURN = re.compile(r"([xyz])1")  # a coordinate of the first return: ouster-cli has "X1 (m)"
UNITS = re.compile(r"[\[(].*$")  # a unit after a name, as in "x [m]"
EXPECTED = "lines of numbers"
ADVICE = "write a line x y z intensity per point"


@dataclass(frozen=True)
class TextTable:
    """The layout of a text file.

    Attributes:
        separator: the text between the values of a line; None for white space.
        skipped: the number of lines before the first point.
        names: the names of the columns; empty if the file has none.
    """

    separator: str | None
    skipped: int
    count: int
    names: tuple[str, ...] = ()


def read_text_cloud(path: Path, layout: RowLayout = UNKNOWN) -> cloud.Cloud:
    """Read a point from each line.

    If a line before the points names the columns, they are found by their names. Otherwise they are
    x, y, z and intensity, followed by the ring if its values can be rings. Values are separated by
    white space, commas or semicolons.

    Args:
        layout: the names of the columns, if the user states them; its types are not used.

    Raises:
        InputError: if there are no lines of three or more numbers, or a later line does not have
            the same columns.
    """
    with cloud.reading(path, EXPECTED, ADVICE):
        table = _require_table(path)
        names = layout.columns or table.names

        if names:
            indices = sorted(cloud.find_columns(names).values())
            if max(indices) >= table.count:
                raise InputError(
                    f"{path}: expected {len(names)} columns ({','.join(names)}), "
                    f"found {table.count}; correct the names of the columns"
                )
            values = _read_values(path, table, indices)
            return named_cloud(list(values.T), [names[index] for index in indices], str(path))

        values = _read_values(path, table, range(min(table.count, UNNAMED_COLUMNS)))
        names = name_columns(values)
        more = "_" * (table.count - len(names))
        note = describe([*names, *more]) if table.count > 4 else ""
        return named_cloud(list(values.T), names, str(path), note)


def read_columns(path: Path, wanted: cloud.Names) -> cloud.Arrays:
    """Read some columns of all points as float64; columns without names are named "0", "1", ..."""
    with cloud.reading(path, EXPECTED, ADVICE):
        table = _require_table(path)
        names = table.names or tuple(map(str, range(table.count)))
        chosen = cloud.require_columns(names, path, wanted)
        values = _read_values(path, table, list(chosen.values()))
        return dict(zip(chosen, values.T, strict=True))


def _require_table(path: Path) -> TextTable:
    head = read_head(path)
    table = find_table(head)
    if table is None and find_comma_table(head) is not None:
        raise InputError(
            f"{path}: expected numbers with decimal points, found decimal commas; write 1.5 for 1,5"
        )
    if table is None:
        raise InputError(f"{path}: expected lines of numbers x y z ..., found other text; {ADVICE}")
    return table


def read_head(path: Path) -> bytes:
    """Return the beginning of a file, in which `find_table` looks for points."""
    with path.open("rb") as file:
        return file.read(HEAD)


def find_table(head: bytes) -> TextTable | None:
    """Return the layout of a text, given its head; None if it has no points."""
    lines = StringIO(_decode(head), newline=None).readlines()
    for separator in SEPARATORS:
        table = _match(lines, separator)
        if table is not None:
            return table
    return None


def find_comma_table(head: bytes) -> TextTable | None:
    """Return the layout of a text, given its head, if its commas are decimal points; else None."""
    return find_table(head.replace(b",", b"."))


def _decode(head: bytes) -> str:
    """Return the complete lines of the head of a text file; an empty text if it is binary."""
    text = head.decode(ENCODING, errors="replace")
    if len(head) == HEAD:
        text = text[: text.rfind("\n") + 1]
    return "" if CONTROL.search(text) else text


def _match(lines: list[str], separator: str | None) -> TextTable | None:
    """Return the layout of a text if this separator separates its numbers, else None."""
    names: tuple[str, ...] = ()
    for skipped, line in enumerate(lines):
        values = _split(line, separator)
        if _are_numbers(values, names):
            points = list(filter(str.strip, lines[skipped : skipped + CHECKED_LINES]))
            # A header has fewer lines than there are points. Other text may end in a line of
            # numbers.
            if len(points) < min(skipped, CHECKED_LINES):
                return None
            for point in points:
                row = _split(point, separator)
                if len(row) != len(values) or not _are_numbers(row, names):
                    return None

            if len(names) != len(values):
                names = ()
            return TextTable(separator, skipped, len(values), names)

        candidates = tuple(map(_clean_name, _split(_uncomment(line), separator)))
        if {"x", "y", "z"} <= set(cloud.find_columns(candidates)):
            names = candidates
    return None


def _split(line: str, separator: str | None) -> list[str]:
    """Return the values of a line. A separator at the end of the line adds no empty value."""
    return line.strip().removesuffix(separator or "").split(separator, MAX_COLUMNS)


def _uncomment(line: str) -> str:
    """Return a line without the marks of a comment at its beginning."""
    stripped = line.strip()
    for mark in COMMENTS:
        stripped = stripped.removeprefix(mark)
    return stripped


def _clean_name(name: str) -> str:
    """Return the name of a column without quotes and units, such as "x" for "Points:0"."""
    bare = UNITS.sub("", name.strip().strip("\"'").strip()).rstrip().lower()
    first = FIRST_RETURN.fullmatch(bare)
    if first:
        return first[1]
    match = POINTS_NAME.fullmatch(bare)
    return "xyz"[int(match[1])] if match and int(match[1]) < 3 else bare


def _are_numbers(values: list[str], names: tuple[str, ...]) -> bool:
    """Return whether the values of a line are numbers.

    If the line has the columns `names`, only the values of known columns must be numbers.
    """
    if len(values) < 3:
        return False
    if len(names) == len(values):
        values = [values[index] for index in cloud.find_columns(names).values()]

    try:
        for value in values:
            float(value.strip().strip('"'))
    except ValueError:
        return False
    return True


def _read_values(path: Path, table: TextTable, indices: range | list[int]) -> np.ndarray:
    """Return some columns of all points as (N, columns) float64."""
    with path.open(encoding=ENCODING, errors="replace") as file:
        values = np.loadtxt(
            islice(file, table.skipped, None),
            delimiter=table.separator,
            usecols=list(indices),
            max_rows=cloud.MAX_POINTS + 1,
            comments="#",
            quotechar='"',
            ndmin=2,
        )
    cloud.check_point_count(len(values), path)

    return values
