"""Read point clouds from PLY files: the element `vertex`, ascii or binary in either byte order.

plyfile is not used: it allocates whatever memory a header claims, and is under the GPL.
"""

from __future__ import annotations

import os
from dataclasses import dataclass, field
from pathlib import Path
from typing import BinaryIO

import numpy as np

from amvnet.data.formats.cloud import Arrays, Names, check_point_count, reading, require_columns
from amvnet.data.formats.fields import Fields, read_header_line
from amvnet.errors import InputError

# NumPy types by PLY's type names; most types have two names.
TYPES = {
    **dict.fromkeys(("char", "int8"), "i1"),
    **dict.fromkeys(("uchar", "uint8", "bool"), "u1"),
    **dict.fromkeys(("short", "int16"), "i2"),
    **dict.fromkeys(("ushort", "uint16"), "u2"),
    **dict.fromkeys(("int", "int32"), "i4"),
    **dict.fromkeys(("uint", "uint32"), "u4"),
    **dict.fromkeys(("float", "float32"), "f4"),
    **dict.fromkeys(("double", "float64"), "f8"),
}
BYTE_ORDERS = {"ascii": "<", "binary_little_endian": "<", "binary_big_endian": ">"}
KIND = "a PLY file"
COMMENT = "comment "  # begins a line of the header
ADVICE = "write the file again"


@dataclass
class Element:
    """An element of a file, such as `vertex`, with `count` rows.

    The type of a list is "list", and the types of its length and of its items.
    """

    name: str
    count: int
    properties: list[str] = field(default_factory=list)
    types: list[str] = field(default_factory=list)

    def fields(self, order: str) -> Fields:
        """Return the fields of an element without lists, in the byte order "<" or ">"."""
        dtypes = [order + TYPES[kind] for kind in self.types]
        return Fields(self.properties, dtypes, [1] * len(dtypes))

    @property
    def has_lists(self) -> bool:
        """Whether the rows differ in length."""
        return any(kind.startswith("list ") for kind in self.types)

    def skip(self, file: BinaryIO, order: str) -> None:
        """Move a binary file to the end of the element, which begins at its position."""
        if not self.has_lists:
            file.seek(self.count * self.fields(order).record.itemsize, os.SEEK_CUR)
            return
        for _ in range(self.count):
            for kind in self.types:
                *of_list, item = kind.removeprefix("list ").split()
                length = 1
                for name in of_list:
                    dtype = np.dtype(order + TYPES[name])
                    length = int(np.frombuffer(file.read(dtype.itemsize), dtype)[0])
                    if length < 0:
                        raise ValueError(f"a list of {length} items")
                file.seek(length * np.dtype(TYPES[item]).itemsize, os.SEEK_CUR)


def read_columns(path: Path, wanted: Names) -> Arrays:
    """Read some properties of the vertices.

    Raises:
        InputError: if the file is not PLY, is truncated, or lacks vertices or a property.
    """
    with reading(path, KIND, ADVICE), path.open("rb") as file:
        encoding, elements = _read_header(file, path)
        index = [element.name for element in elements].index("vertex")
        before = elements[:index]
        vertex = elements[index]

        if vertex.has_lists:
            raise InputError(
                f"{path}: expected vertices without lists, found a list; write the points alone"
            )

        fields = vertex.fields(BYTE_ORDERS[encoding])
        chosen = require_columns(vertex.properties, path, wanted)
        if encoding == "ascii":
            # Each value, and each line before the vertices, takes at least one character. Another
            # character separates any two of them.
            lines = sum(element.count for element in before)
            least = 2 * (lines + vertex.count * sum(fields.counts)) - 1
            check_point_count(lines + vertex.count, path, least)
            for _ in range(lines):
                file.readline()
            return fields.read_text(file, vertex.count, chosen, path)

        for element in before:
            element.skip(file, BYTE_ORDERS[encoding])
        least = file.tell() + vertex.count * fields.record.itemsize
        check_point_count(vertex.count, path, least)
        return fields.read_binary(file, vertex.count, chosen)


def read_comments(path: Path) -> dict[str, list[str]]:
    """Return the comments of the header; raise InputError if it has no end."""
    comments = []
    with path.open("rb") as file:
        while (line := read_header_line(file, path, KIND, "end_header")) != "end_header":
            if line.startswith(COMMENT):
                comments.append(line.removeprefix(COMMENT))
    return {"comments": comments}


def _read_header(file: BinaryIO, path: Path) -> tuple[str, list[Element]]:
    encoding = ""
    elements: list[Element] = []

    words: list[str] = []
    while words != ["end_header"]:
        words = read_header_line(file, path, KIND, "end_header").split()
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
            elements[-1].types.append(" ".join(words[1:-1]))

    if encoding not in BYTE_ORDERS:
        raise InputError(
            f"{path}: expected the format {', '.join(BYTE_ORDERS)}, "
            f"found {encoding[:30]!a}; {ADVICE}"
        )
    return encoding, elements
