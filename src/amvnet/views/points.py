"""The points of one or more scans as the views and networks take them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from amvnet.scan import Scan


@dataclass(frozen=True)
class PointBatch:
    """The points of B scans, one after the other.

    Attributes:
        points: (P, 4) float32: x, y, z in metres, intensity in [0, 1]; all finite.
        scan: (P,) int64: which of the B scans a point belongs to; ascending.
        count: B.
        ring: (P,) int64: index of the laser, or None.
        names: of the scans.
    """

    points: Tensor
    scan: Tensor
    count: int
    ring: Tensor | None = None
    names: tuple[str, ...] = ()

    def to(self, where: torch.device | torch.dtype | str) -> PointBatch:
        """On a device, or with points of a floating-point type."""
        if isinstance(where, torch.dtype):
            return replace(self, points=self.points.to(where))
        ring = None if self.ring is None else self.ring.to(where)
        return PointBatch(self.points.to(where), self.scan.to(where), self.count, ring, self.names)

    def slices(self) -> list[slice]:
        """Where each scan's points stand."""
        ends = torch.bincount(self.scan, minlength=self.count).cumsum(0).tolist()
        return [slice(start, end) for start, end in zip([0, *ends[:-1]], ends, strict=True)]

    @classmethod
    def of(cls, scans: Sequence[Scan]) -> PointBatch:
        """The valid points of some scans (`Scan.valid`), in order."""
        kept = [scan.valid for scan in scans]
        points = np.concatenate([s.points[k] for s, k in zip(scans, kept, strict=True)]).astype(np.float32, copy=False)
        index = np.repeat(np.arange(len(scans)), [k.sum() for k in kept])
        rings = [s.ring[k] for s, k in zip(scans, kept, strict=True) if s.ring is not None]
        ring = torch.from_numpy(np.concatenate(rings).astype(np.int64)) if len(rings) == len(scans) else None
        names = tuple(scan.name for scan in scans)
        return cls(torch.from_numpy(points), torch.from_numpy(index), len(scans), ring, names)
