"""Read the scans of any supported file, as they are in it."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import overload

from amvnet.errors import InputError
from amvnet.inference.inputs import InputScan, ScanOptions, open_inputs
from amvnet.scan import Scan


class Scans(Sequence[Scan]):
    """The scans of a file, a bag, a folder or a dataset; each is read when it is asked for."""

    def __init__(self, path: Path | str, scans: Sequence[InputScan]) -> None:
        self.path = path
        self._scans = scans

    def __len__(self) -> int:
        return len(self._scans)

    @overload
    def __getitem__(self, index: int) -> Scan: ...

    @overload
    def __getitem__(self, index: slice) -> Scans: ...

    def __getitem__(self, index: int | slice) -> Scan | Scans:
        if isinstance(index, slice):
            return Scans(self.path, self._scans[index])
        return self._scans[index].load(labels=True).scan

    def __repr__(self) -> str:
        return f"<Scans of {self.path}: {len(self)}>"


def read(path: Path | str, topic: str | None = None) -> Scan:
    """Read the only scan of a file.

    Its points are as they are in the file, with intensities scaled to [0, 1]. To segment it as
    `amvnet predict` does, give the path to a `Segmenter`, which adapts the scan to its weights.

    Args:
        path: a scan file of any supported format, or a bag.
        topic: of bags; None means the only topic with scans.

    Raises:
        InputError: if the file is missing, broken, of another format, or holds several scans.
    """
    scans = read_all(path, topic)
    if len(scans) > 1:
        raise InputError(
            f"{path}: expected one scan, found {len(scans)}; read them with amvnet.read_all"
        )
    return scans[0]


def read_all(path: Path | str, topic: str | None = None) -> Scans:
    """Return the scans of a file, a bag, a folder of these, or a dataset, with their labels if any.

    Args:
        path: as INPUT of `amvnet predict`.
        topic: of bags; None means the only topic with scans.

    Returns:
        A sequence that reads each scan when it is asked for, as `read` does.

    Raises:
        InputError: if there is no scan.
    """
    return Scans(path, open_inputs([str(path)], ScanOptions(topic=topic)).scans)
