"""Scans of surveying instruments in E57 files, by pye57."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import closing
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from amvnet.data.formats.cloud import Cloud, check_point_count, reading
from amvnet.data.formats.series import Decode, ScanSeries
from amvnet.errors import InputError

CARTESIAN = ("cartesianX", "cartesianY", "cartesianZ")
SPHERICAL = ("sphericalRange", "sphericalAzimuth", "sphericalElevation")
INVALID = ("cartesianInvalidState", "sphericalInvalidState")  # not 0: a lost point
EXPECTED = "an E57 file"
ADVICE = "write the file again"


def open_e57(path: Path) -> ScanSeries:
    """Open the scans of an E57 file, each in the frame of the instrument at its place.

    Raises:
        InputError: if the file is broken or has no scan.
    """
    with reading(path, EXPECTED, ADVICE), closing(_open(path)) as file:
        count = int(file.scan_count)
    if not count:
        raise InputError(f"{path}: expected scans, found none; {ADVICE}")

    def scans() -> Iterator[Decode]:
        for index in range(count):
            yield partial(_read_scan, path, index)

    return ScanSeries(path, count, scans, ADVICE)


def _read_scan(path: Path, index: int, name: str) -> Cloud:
    """Read the scan at this index. Points that were not measured become NaN."""
    with closing(_open(path)) as file:
        # Each number takes a bit at least, in a constant column nothing: only a scan of equal
        # points is smaller.
        check_point_count(int(file.get_header(index).point_count), name)
        fields = file.read_scan_raw(index, ignore_unsupported_fields=True)
    return Cloud(_coordinates(fields, name), fields.get("intensity"), None, name)


def _open(path: Path) -> Any:
    import pye57

    return pye57.E57(str(path))


def _coordinates(fields: dict[str, np.ndarray], name: str) -> np.ndarray:
    """Return (N, 3) coordinates, NaN where nothing was measured."""
    if set(CARTESIAN) <= set(fields):
        xyz = np.column_stack([fields[key] for key in CARTESIAN])
    elif set(SPHERICAL) <= set(fields):
        distance, azimuth, elevation = (fields[key] for key in SPHERICAL)
        level = distance * np.cos(elevation)
        height = distance * np.sin(elevation)
        xyz = np.column_stack([level * np.cos(azimuth), level * np.sin(azimuth), height])
    else:
        raise InputError(
            f"{name}: expected Cartesian or spherical coordinates, "
            f"found {', '.join(fields)[:200]!a}; {ADVICE}"
        )

    xyz = xyz.astype(np.float64)
    for key in INVALID:
        if key in fields:
            xyz[fields[key] != 0] = np.nan
    return xyz
