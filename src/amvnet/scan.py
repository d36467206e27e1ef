"""Define a LiDAR scan, which every part of the package takes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from amvnet.errors import InputError, reason_of, shown

# The largest absolute value of a valid coordinate, metres. No LiDAR sees that far, and the squares
# of much larger numbers overflow.
FARTHEST = 10_000.0


@dataclass(frozen=True, repr=False)
class Scan:
    """The points of one turn of a LiDAR, in the sensor's frame.

    Attributes:
        points: (N, 4) float32: x, y, z in metres and intensity in [0, 1]. A row is a lost return if
            a coordinate is not finite or exceeds `FARTHEST`, or if the point is at the origin,
            where sensors put lost returns. It keeps its place and gets the id 0. An intensity that
            is not finite is missing.
        labels: (N,) uint8 train ids (0 = ignored, 1..K), or None if there are no labels.
        ring: (N,) int64 index of the laser (0 = lowest, -1 = unknown), or None if the format has
            no lasers.
        row: (N,) int64 row of each point in the range image of some weights (0 = top, -1 =
            unknown), or None. The range view computes rows that are unknown.
        source: (N,) int64 index of the dataset that each point comes from (0 = the first),
            or None. A training on several datasets sets it.
        own: (N,) bool: whether a point is of the car's own body, or None if none is known to be.
            Such points are not valid.
        name: the origin of the scan, for messages.
        to_file: (4, 4) moves points that were normalised back into the frame of their file, in
            metres; None if the points lie in this frame.
        file_xyz: (N, 3) the unchanged coordinates of the scan's file; None if there is none.
        assumed: what was assumed of the sensor when the scan was normalised; empty if it was not.

    Raises:
        InputError: if the shapes do not fit each other.
    """

    points: np.ndarray
    labels: np.ndarray | None = None
    ring: np.ndarray | None = None
    name: str = ""
    row: np.ndarray | None = None
    source: np.ndarray | None = None
    own: np.ndarray | None = None
    to_file: NDArray[np.float64] | None = None
    file_xyz: NDArray[np.floating] | None = None
    assumed: str = ""

    def __post_init__(self) -> None:
        if self.points.ndim != 2 or self.points.shape[1] != 4:
            raise InputError(
                f"{self.name or 'scan'}: expected points of shape (N, 4) with columns x, y, z, "
                f"intensity, found {self.points.shape}; reorder or pad the columns"
            )

        self._check_count("labels", self.labels)
        self._check_count("ring indices", self.ring)
        self._check_count("rows", self.row)
        self._check_count("sources", self.source)
        self._check_count("flags of own points", self.own)

    def _check_count(self, kind: str, values: np.ndarray | None) -> None:
        if values is None or values.shape == (len(self.points),):
            return

        count = values.shape[0] if values.ndim else "one number"
        raise InputError(
            f"{self.name or 'scan'}: expected {len(self.points)} {kind}, one per point, "
            f"found {count}; give the file that belongs to this scan"
        )

    def __len__(self) -> int:
        return len(self.points)

    def __repr__(self) -> str:
        title = f"Scan {self.name}" if self.name else "Scan"
        parts = [f"{len(self):,} points"]
        if self.labels is not None:
            parts.append("labels")
        if self.ring is not None:
            parts.append("rings")
        if self.row is not None:
            parts.append("rows")
        return f"<{title}: {', '.join(parts)}>"

    def select(self, which: np.ndarray) -> Scan:
        """Return the scan with some of the points: (N,) bool, or (M,) indices."""
        return replace(
            self,
            points=self.points[which],
            labels=None if self.labels is None else self.labels[which],
            ring=None if self.ring is None else self.ring[which],
            row=None if self.row is None else self.row[which],
            source=None if self.source is None else self.source[which],
            own=None if self.own is None else self.own[which],
            file_xyz=None if self.file_xyz is None else self.file_xyz[which],
        )

    @property
    def valid(self) -> np.ndarray:
        """(N,) bool: whether networks see a point and label it.

        It is at finite coordinates within `FARTHEST`, not at the origin, and not of the car itself.
        """
        # Comparisons with NaN are false.
        if np.abs(self.points).max(initial=0) < FARTHEST:
            valid = np.ones(len(self.points), dtype=bool)
        else:
            # Contiguous columns: a reduction over rows of four takes ten times as long.
            valid = (np.abs(self.points.T[:3], order="C") < FARTHEST).all(axis=0)

        valid[at_origin(self.points)] = False
        return valid if self.own is None else valid & ~self.own


def at_origin(xyz: NDArray[np.floating]) -> NDArray[np.intp]:
    """Return the (M,) indices of the points at 0, 0, 0, given (N, 3 or more) coordinates."""
    on_axis = np.flatnonzero(xyz[:, 0] == 0)  # so few that the other coordinates take no time
    indices: NDArray[np.intp] = on_axis[(xyz[on_axis, 1] == 0) & (xyz[on_axis, 2] == 0)]
    return indices


def yaw_rotation(yaw: float) -> np.ndarray:
    """Return the (2, 2) matrix that rotates x, y by `yaw` radians, counter-clockwise."""
    cos = np.cos(yaw)
    sin = np.sin(yaw)
    return np.array([[cos, -sin], [sin, cos]])


def turned(scan: Scan, yaw: float) -> Scan:
    """Return a scan whose points are rotated about z by `yaw` radians, counter-clockwise."""
    points = scan.points.copy()
    points[:, :2] = points[:, :2] @ yaw_rotation(yaw).T
    return replace(scan, points=points)


def check_scan(scan: Scan) -> Scan:
    """Return the scan; raise InputError if it has no valid point."""
    if not scan.valid.any():
        problem = "none finite" if len(scan) else "none"
        raise InputError(
            f"{scan.name or 'scan'}: expected points to segment, found {problem}; "
            "leave the scan out"
        )
    return scan


class TensorLike(Protocol):
    """The part of torch's tensors that `as_array` uses."""

    def detach(self) -> Any:
        """Return the tensor without its gradient."""


class TableLike(Protocol):
    """The part of pandas' tables that `as_array` uses."""

    def to_records(self, *, index: bool) -> Any:
        """Return the rows as an array of records."""


AnyArray = np.ndarray | Sequence[Any] | TensorLike | TableLike  # the arguments of `as_array`


def as_array(values: AnyArray, expected: str) -> np.ndarray:
    """Return numbers from any library as a NumPy array.

    Args:
        values: an array, which may have named fields or a mask; a tensor on any device; a table of
            pandas; or nested lists of numbers. Masked values become NaN.
        expected: the expected content, for messages, such as "points of shape (N, 4)".

    Raises:
        InputError: if the values are not numbers, or the lists differ in length.
    """
    numbers: Any = values
    try:
        if hasattr(values, "detach"):
            numbers = values.detach().cpu()
            if numbers.element_size() < 4:
                numbers = numbers.float()  # NumPy has no bfloat16
        elif hasattr(values, "to_records"):
            numbers = values.to_records(index=False)
        elif isinstance(values, np.ma.MaskedArray) and values.dtype.names is None:
            numbers = np.ma.filled(values.astype(np.float64), np.nan)
        array = np.asarray(numbers)
    except (TypeError, ValueError, RuntimeError) as error:  # torch raises the last one
        raise InputError(
            f"expected {expected}, found a {type(values).__name__} "
            f"({reason_of(error)[:60]}); give one array"
        ) from None

    if array.dtype.names is None and array.dtype.kind not in "fiu":
        found = f"values of {array.dtype}" if array.ndim else shown(values)
        raise InputError(f"expected {expected}, found {found}; give an array of numbers")
    return array
