"""Point clouds in PLY files: the element `vertex`, ascii or binary of either byte order.

We do not use plyfile: it allocates whatever a header claims, and is under the GPL.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import BinaryIO

import numpy as np

from amvnet.data.formats.cloud import (
    Cloud,
    check_point_count,
    make_cloud,
    reading,
    require_columns,
)
from amvnet.data.formats.pcd import HEADER, Arrays, read_rows, read_text
from amvnet.errors import InputError

TYPES = {
    "char": "i1",
    "uchar": "u1",
    "short": "i2",
    "ushort": "u2",
    "int": "i4",
    "uint": "u4",
    "float": "f4",
    "double": "f8",
    "int8": "i1",
    "uint8": "u1",
    "int16": "i2",
    "uint16": "u2",
    "int32": "i4",
    "uint32": "u4",
    "float32": "f4",
    "float64": "f8",
}
BYTE_ORDERS = {"ascii": "<", "binary_little_endian": "<", "binary_big_endian": ">"}
ADVICE = "write the file again"


@dataclass
class Element:
    """One element of a file, such as `vertex`.

    Attributes:
        name: its name.
        count: how many rows it has.
        properties: the names of its properties.
        dtypes: the NumPy types of its properties, without byte order; empty for a list.
    """

    name: str
    count: int
    properties: list[str] = field(default_factory=list)
    dtypes: list[str] = field(default_factory=list)

    @property
    def sizes(self) -> list[int]:
        """Bytes of each property; only if none is a list."""
        return [int(dtype[1:]) for dtype in self.dtypes]

    @property
    def row(self) -> int:
        """Bytes of one row; only if no property is a list."""
        return sum(self.sizes)


@dataclass(frozen=True)
class Layout:
    """The layout of the data up to the last vertex.

    Attributes:
        before: the elements before the vertices.
        vertex: the vertices.
        order: the byte order, "<" or ">".
    """

    before: list[Element]
    vertex: Element
    order: str


def read_ply(path: Path) -> Cloud:
    """Read the vertices.

    Raises:
        InputError: if the file is not PLY, is truncated, or has no vertices with x, y, z.
    """
    return make_cloud(read_vertices(path, partial(require_columns, path=path)), str(path))


def read_vertices(path: Path, choose: Callable[[Sequence[str]], dict[str, int]]) -> Arrays:
    """Read some properties of the vertices.

    Args:
        choose: returns the index of each property to read, given the names of all.

    Returns:
        The (N,) values of each property, by the keys of `choose`.

    Raises:
        InputError: as `read_ply`.
    """
    with reading(path, "a PLY file", ADVICE), path.open("rb") as file:
        encoding, elements = _read_header(file, path)
        vertex_index = [element.name for element in elements].index("vertex")
        layout = Layout(elements[:vertex_index], elements[vertex_index], BYTE_ORDERS[encoding])

        if any("" in element.dtypes for element in elements[: vertex_index + 1]):
            raise InputError(
                f"{path}: expected vertices without lists, found a list; write the points alone"
            )

        columns = choose(layout.vertex.properties)
        read_columns = _read_ascii if encoding == "ascii" else _read_binary
        return read_columns(file, layout, columns, path)


def _read_header(file: BinaryIO, path: Path) -> tuple[str, list[Element]]:
    """Return the encoding of a file and its elements."""
    encoding = ""
    elements: list[Element] = []

    words = _read_words(file, path)
    while words != ["end_header"]:
        keyword = words[0] if words else ""
        if keyword == "format":
            encoding = words[1]
        elif keyword == "element":
            element = Element(words[1], int(words[2]))
            if element.count < 0:
                raise ValueError(f"element {element.name} of {element.count} rows")
            elements.append(element)
        elif keyword == "property":
            elements[-1].properties.append(words[-1])
            elements[-1].dtypes.append("" if words[1] == "list" else TYPES[words[1]])
        words = _read_words(file, path)

    if encoding not in BYTE_ORDERS:
        raise InputError(
            f"{path}: expected the format {', '.join(BYTE_ORDERS)}, "
            f"found {encoding[:30]!a}; {ADVICE}"
        )
    return encoding, elements


def _read_words(file: BinaryIO, path: Path) -> list[str]:
    """Return the words of the next line of the header."""
    line = file.readline(HEADER)
    if not line or file.tell() > HEADER:
        raise InputError(
            f"{path}: expected the header of a PLY file, found no end_header; {ADVICE}"
        )
    return line.decode("latin-1").split()  # comments may be in any language


def _read_ascii(file: BinaryIO, layout: Layout, columns: dict[str, int], path: Path) -> Arrays:
    vertex = layout.vertex
    lines_before = sum(element.count for element in layout.before)

    # Each value, and each line before the vertices, takes at least one digit and, but for the
    # last, a separator.
    values = lines_before + vertex.count * len(vertex.properties)
    check_point_count(lines_before + vertex.count, path, 2 * values - 1)
    for _ in range(lines_before):
        file.readline()

    positions = {}
    for key, index in columns.items():
        positions[key] = (index, layout.order + vertex.dtypes[index])
    return read_text(file, vertex.count, positions, path)


def _read_binary(file: BinaryIO, layout: Layout, columns: dict[str, int], path: Path) -> Arrays:
    vertex = layout.vertex
    bytes_before = sum(element.count * element.row for element in layout.before)
    end = file.tell() + bytes_before + vertex.count * vertex.row
    check_point_count(vertex.count, path, end)
    file.seek(bytes_before, 1)

    offsets = np.cumsum([0, *vertex.sizes]).tolist()
    positions = {}
    for key, index in columns.items():
        positions[key] = (layout.order + vertex.dtypes[index], offsets[index])
    return read_rows(file, vertex.count, vertex.row, positions)
