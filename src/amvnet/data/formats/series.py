"""The scans of one file, in order of time."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

from amvnet.data.formats.cloud import Cloud, reading
from amvnet.errors import InputError

Decode = Callable[[str], Cloud]  # reads one scan, given its name for messages


class ScanSeries:
    """The scans of one file. One at a time is in memory.

    Args:
        count: how many scans it claims to have.
        scans: yields what reads each scan, in order.
        advice: what to do if a scan is broken.
        topic: where the scans are in the file, for messages; empty if there is no other place.
    """

    def __init__(
        self,
        path: Path,
        count: int,
        scans: Callable[[], Iterator[Decode]],
        advice: str,
        topic: str = "",
    ) -> None:
        self._place = f"{path} ({topic}, " if topic else f"{path} ("
        self._count = count
        self._scans = scans
        self._advice = advice

        # For reading in order without a seek: the index of the next scan, and those from there on.
        self._next = 0
        self._rest: Iterator[Decode] = iter(())

    def __len__(self) -> int:
        return self._count

    def read(self, index: int) -> Cloud:
        """Read the scan at this index, from 0. In order is fastest.

        Raises:
            InputError: if it is broken, or the file ends before it.
        """
        if index != self._next or self._next == 0:
            self._next = 0
            self._rest = self._scans()

        name = f"{self._place}{index})"
        with reading(name, "a scan", self._advice):
            for decode in self._rest:
                self._next += 1
                if self._next > index:
                    if self._next == self._count:
                        self._rest = iter(())  # closes the file
                    return decode(name)

        raise InputError(
            f"{name}: expected {self._count} scans, found {self._next}; {self._advice}"
        )
