"""One LiDAR scan as every part of the package sees it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from amvnet.errors import InputError

FARTHEST = 10_000.0  # metres: no LiDAR sees so far, and squares of much larger numbers overflow


@dataclass(frozen=True)
class Scan:
    """The points of one turn of a LiDAR, in the sensor's frame.

    Attributes:
        points: (N, 4) float32: x, y, z in metres and intensity in [0, 1]. A row with a
            non-finite coordinate, or one farther than any LiDAR sees, is a return that was lost: it keeps its
            place and gets id 0.
        labels: (N,) uint8 train ids (0 = ignored, 1..K), or None where nothing is labelled.
        ring: (N,) int64 index of the laser (0 = lowest), or None where the format has none.
        name: where the scan comes from, for messages.

    Raises:
        InputError: where the shapes do not fit each other.
    """

    points: np.ndarray
    labels: np.ndarray | None = None
    ring: np.ndarray | None = None
    name: str = ""

    def __post_init__(self) -> None:
        if self.points.ndim != 2 or self.points.shape[1] != 4:
            raise InputError(
                f"{self.name or 'scan'}: expected points of shape (N, 4) with columns x, y, z, intensity, "
                f"found {self.points.shape}; reorder or pad the columns"
            )
        for kind, values in (("labels", self.labels), ("ring indices", self.ring)):
            if values is not None and values.shape != (len(self.points),):
                raise InputError(
                    f"{self.name or 'scan'}: expected {len(self.points)} {kind}, one per point, "
                    f"found {values.shape[0] if values.ndim else 'one number'}; give the file that belongs to this scan"
                )

    def __len__(self) -> int:
        return len(self.points)

    @property
    def valid(self) -> np.ndarray:
        """(N,) bool: the points whose four values are all finite, and nearer than `FARTHEST` along each axis."""
        # Column by column: a reduction over rows of four takes ten times as long. NaN is below nothing.
        x, y, z, intensity = np.abs(self.points.T)
        return (x < FARTHEST) & (y < FARTHEST) & (z < FARTHEST) & (intensity < np.inf)
