"""Point clouds in PLY files: the element `vertex`, ascii or binary of either byte order.

Own code, as plyfile allocates what a header claims, and is under the GPL.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

import numpy as np

from amvnet.data.formats.cloud import (
    Cloud,
    check_point_count,
    make_cloud,
    refusing,
    require_columns,
)
from amvnet.data.formats.pcd import HEADER, read_rows, read_text
from amvnet.errors import InputError

TYPES = {
    "char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4",
    "float": "f4", "double": "f8", "int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4",
    "uint32": "u4", "float32": "f4", "float64": "f8",
}  # fmt: skip
ORDERS = {"ascii": "<", "binary_little_endian": "<", "binary_big_endian": ">"}
ADVICE = "write the file again"


@dataclass
class Element:
    """One element: how many there are, and names and types of its properties; a list's type is empty."""

    name: str
    count: int
    properties: list[tuple[str, str]]

    @property
    def row(self) -> int:
        """Bytes of one."""
        return sum(int(dtype[1:]) for _, dtype in self.properties)


def read_ply(path: Path) -> Cloud:
    """Read the vertices.

    Raises:
        InputError: where it is no such file, truncated, or has no vertices with x, y, z.
    """
    with refusing(path, "a PLY file", ADVICE), path.open("rb") as file:
        encoding, elements = _read_header(file, path)
        before = [element.name for element in elements].index("vertex")
        vertex = elements[before]
        if any(not dtype for element in elements[: before + 1] for _, dtype in element.properties):
            raise InputError(
                f"{path}: expected vertices without lists, found a list; write the points alone"
            )
        wanted = require_columns([name for name, _ in vertex.properties], path)
        read = _read_text if encoding == "ascii" else _read_binary
        return make_cloud(
            read(file, elements[:before], vertex, wanted, ORDERS[encoding], path), str(path)
        )


def _read_header(file: BinaryIO, path: Path) -> tuple[str, list[Element]]:
    encoding, elements = "", list[Element]()
    while (words := _line(file, path)) != ["end_header"]:
        if words[:1] == ["format"]:
            encoding = words[1]
        elif words[:1] == ["element"]:
            elements.append(Element(words[1], int(words[2]), []))
        elif words[:1] == ["property"]:
            elements[-1].properties.append(
                (words[-1], "" if words[1] == "list" else TYPES[words[1]])
            )
    if encoding not in ORDERS or any(element.count < 0 for element in elements):
        raise InputError(
            f"{path}: expected the format {', '.join(ORDERS)}, found {encoding[:30]!a}; {ADVICE}"
        )
    return encoding, elements


def _line(file: BinaryIO, path: Path) -> list[str]:
    line = file.readline(HEADER)
    if not line or file.tell() > HEADER:
        raise InputError(
            f"{path}: expected the header of a PLY file, found no end_header; {ADVICE}"
        )
    return line.decode("latin-1").split()  # comments may be in any language


def _read_text(
    file: BinaryIO,
    before: list[Element],
    vertex: Element,
    wanted: dict[str, int],
    order: str,
    path: Path,
) -> dict[str, np.ndarray]:
    skipped = sum(element.count for element in before)
    least = 2 * (skipped + vertex.count * len(vertex.properties)) - 1
    check_point_count(skipped + vertex.count, path, least)
    for _ in range(skipped):
        file.readline()
    columns = {key: (place, order + vertex.properties[place][1]) for key, place in wanted.items()}
    return read_text(file, vertex.count, columns, path)


def _read_binary(
    file: BinaryIO,
    before: list[Element],
    vertex: Element,
    wanted: dict[str, int],
    order: str,
    path: Path,
) -> dict[str, np.ndarray]:
    skipped = sum(element.count * element.row for element in before)
    check_point_count(vertex.count, path, file.tell() + skipped + vertex.count * vertex.row)
    file.seek(skipped, 1)
    ends = np.cumsum([0, *(int(dtype[1:]) for _, dtype in vertex.properties)]).tolist()
    columns = {
        key: (order + vertex.properties[place][1], ends[place]) for key, place in wanted.items()
    }
    return read_rows(file, vertex.count, vertex.row, columns)
