"""Read point clouds from PLY files: the element `vertex`, ascii or binary in either byte order.

plyfile is not used: it allocates whatever memory a header claims, and is under the GPL.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import BinaryIO

from amvnet.data.formats.cloud import Arrays, Names, check_point_count, reading, require_columns
from amvnet.data.formats.fields import Fields, read_header_line
from amvnet.errors import InputError

# NumPy types by PLY's type names; each type has two names.
TYPES = {
    **dict.fromkeys(("char", "int8"), "i1"),
    **dict.fromkeys(("uchar", "uint8"), "u1"),
    **dict.fromkeys(("short", "int16"), "i2"),
    **dict.fromkeys(("ushort", "uint16"), "u2"),
    **dict.fromkeys(("int", "int32"), "i4"),
    **dict.fromkeys(("uint", "uint32"), "u4"),
    **dict.fromkeys(("float", "float32"), "f4"),
    **dict.fromkeys(("double", "float64"), "f8"),
}
BYTE_ORDERS = {"ascii": "<", "binary_little_endian": "<", "binary_big_endian": ">"}
KIND = "a PLY file"
ADVICE = "write the file again"


@dataclass
class Element:
    """One element of a file, such as `vertex`.

    Attributes:
        name: the name of the element.
        count: the number of rows.
        properties: the names of the properties.
        types: the types of the properties; "list" for a list.
    """

    name: str
    count: int
    properties: list[str] = field(default_factory=list)
    types: list[str] = field(default_factory=list)

    def fields(self, order: str) -> Fields:
        """Return the fields of an element without lists, in the byte order "<" or ">"."""
        dtypes = [order + TYPES[kind] for kind in self.types]
        return Fields(self.properties, dtypes, [1] * len(dtypes))


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

        if any("list" in element.types for element in elements[: index + 1]):
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

        start = file.tell()
        for element in before:
            start += element.count * element.fields("<").record.itemsize
        check_point_count(vertex.count, path, start + vertex.count * fields.record.itemsize)
        file.seek(start)
        return fields.read_binary(file, vertex.count, chosen)


def _read_header(file: BinaryIO, path: Path) -> tuple[str, list[Element]]:
    """Return the encoding of a file and its elements."""
    encoding = ""
    elements: list[Element] = []

    words: list[str] = []
    while words != ["end_header"]:
        words = read_header_line(file, path, KIND, "end_header")
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
            elements[-1].types.append(words[1])

    if encoding not in BYTE_ORDERS:
        raise InputError(
            f"{path}: expected the format {', '.join(BYTE_ORDERS)}, "
            f"found {encoding[:30]!a}; {ADVICE}"
        )
    return encoding, elements
