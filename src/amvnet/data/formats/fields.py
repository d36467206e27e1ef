"""Records of numbers with named fields, as PCD and PLY have them: in text and in binary."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import accumulate, chain, islice
from pathlib import Path
from typing import BinaryIO

import numpy as np

from amvnet.data.formats.cloud import Arrays
from amvnet.errors import InputError

HEADER = 65_536  # bytes of the longest header of a file


@dataclass(frozen=True)
class Fields:
    """The fields of a record, in order.

    Attributes:
        names: of the fields; several fields may have the same name.
        dtypes: NumPy types of the fields, with the byte order.
        counts: numbers of values of the fields.
    """

    names: Sequence[str]
    dtypes: Sequence[str]
    counts: Sequence[int]

    @cached_property
    def record(self) -> np.dtype:
        """The NumPy type of a record, with the fields "0", "1", ..."""
        fields = []
        for index, (dtype, count) in enumerate(zip(self.dtypes, self.counts, strict=True)):
            fields.append((str(index), dtype, (count,)))
        return np.dtype(fields)

    def read_binary(self, file: BinaryIO, count: int, chosen: dict[str, int]) -> Arrays:
        """Read the first value of chosen fields, by their index, of at most `count` records."""
        records = np.fromfile(file, self.record, count)
        return {key: records[str(index)][:, 0] for key, index in chosen.items()}

    def read_text(self, file: BinaryIO, count: int, chosen: dict[str, int], path: Path) -> Arrays:
        """Read fields of the next lines; raise InputError if some are missing."""
        positions = list(accumulate(self.counts, initial=0))
        columns = [positions[index] for index in chosen.values()]
        table = np.zeros((0, len(columns)))
        lines = islice(filter(bytes.strip, file), count)
        for first in lines:  # at most once; NumPy would warn if there were no lines
            table = np.loadtxt(chain([first], lines), usecols=columns, comments=None, ndmin=2)

        if len(table) < count:
            raise InputError(
                f"{path}: expected {count} lines of points, found {len(table)}; copy the file again"
            )

        arrays = {}
        with np.errstate(invalid="ignore"):
            for (key, index), values in zip(chosen.items(), table.T, strict=True):
                # A column with NaN or infinity stays float64, because integers cannot hold these.
                is_finite = np.isfinite(values).all()
                arrays[key] = values.astype(self.dtypes[index]) if is_finite else values
        return arrays


def read_header_line(file: BinaryIO, path: Path, kind: str, end: str) -> list[str]:
    """Return the words of the next line of a header.

    Args:
        kind: what the file is, such as "a PCD file".
        end: the line that ends its header.

    Raises:
        InputError: if the file ends first, or the header is too long.
    """
    line = file.readline(HEADER)
    if not line or file.tell() > HEADER:
        raise InputError(
            f"{path}: expected the header of {kind}, found no {end}; write the file again"
        )
    return line.decode("latin-1").split()  # comments may be in any encoding
