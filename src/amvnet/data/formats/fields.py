"""Read records of numbers with named fields from PCD and PLY files, in text or in binary."""

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

HEADER = 65_536  # the longest header of a file, bytes


@dataclass(frozen=True)
class Fields:
    """The fields of a record, in order; several may have the same name.

    `dtypes` has the byte order, `counts` the number of values of each field.
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
        """Read the first value of the chosen fields in at most `count` records."""
        records = np.fromfile(file, self.record, count)
        return {key: records[str(index)][:, 0] for key, index in chosen.items()}

    def read_text(self, file: BinaryIO, count: int, chosen: dict[str, int], path: Path) -> Arrays:
        """Read the chosen fields of the next `count` lines.

        Raises:
            InputError: if there are fewer lines.
        """
        positions = list(accumulate(self.counts, initial=0))
        columns = [positions[index] for index in chosen.values()]
        table = np.zeros((0, len(columns)))
        lines = islice(filter(bytes.strip, file), count)
        for first in lines:  # at most one pass; without lines, NumPy would warn
            table = np.loadtxt(chain([first], lines), usecols=columns, comments=None, ndmin=2)

        if len(table) < count:
            raise InputError(
                f"{path}: expected {count} lines of points, found {len(table)}; copy the file again"
            )

        arrays = {}
        with np.errstate(invalid="ignore"):
            for (key, index), values in zip(chosen.items(), table.T, strict=True):
                # Integers cannot hold NaN and infinity; a column with these stays float64.
                is_finite = np.isfinite(values).all()
                arrays[key] = values.astype(self.dtypes[index]) if is_finite else values
        return arrays


def read_header_line(file: BinaryIO, path: Path, kind: str, end: str) -> str:
    """Return the next line of a header, which ends with the line `end`.

    Raises:
        InputError: if the file ends first, or the header is too long.
    """
    line = file.readline(HEADER)
    if not line or file.tell() > HEADER:
        raise InputError(
            f"{path}: expected the header of {kind}, found no {end}; write the file again"
        )
    return line.decode("latin-1").strip()  # comments may be in any encoding
