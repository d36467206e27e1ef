"""The points of one or more scans as the views and networks take them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import accumulate

import numpy as np
import torch
from torch import Tensor

from amvnet.scan import Scan


def occurring(count: int, *indices: Tensor) -> tuple[Tensor, list[Tensor]]:
    """Which of 0..count - 1 occur in some tensors of indices, ascending (M,), and the tensors as places among these.

    As `unique`, without a sort.
    """
    seen = torch.zeros(count, dtype=torch.bool, device=indices[0].device)
    for some in indices:
        seen[some.flatten()] = True
    place = seen.cumsum(0) - 1
    return seen.nonzero()[:, 0], [place[some] for some in indices]


@dataclass(frozen=True)
class PointBatch:
    """The points of B scans, one after the other.

    Attributes:
        points: (P, 4) float32: x, y, z in metres, intensity in [0, 1]; all finite.
        scan: (P,) int64: which of the B scans a point belongs to; ascending.
        count: B.
        ring: (P,) int64: index of the laser, or None.
        names: of the scans.
        sizes: points of each scan, where the processor knows them: it need not ask a GPU then.
    """

    points: Tensor
    scan: Tensor
    count: int
    ring: Tensor | None = None
    names: tuple[str, ...] = ()
    sizes: tuple[int, ...] = ()

    def to(self, where: torch.device | torch.dtype | str) -> PointBatch:
        """On a device, or with points of a floating-point type; from pinned memory to a GPU without waiting."""
        if isinstance(where, torch.dtype):
            return replace(self, points=self.points.to(where))
        to_gpu = (
            torch.device(where).type == "cuda"
        )  # the other way, what comes could be read before it is there
        return self._each(lambda values: values.to(where, non_blocking=to_gpu))

    def pin_memory(self) -> PointBatch:
        """In memory that a GPU copies from by itself; torch's loaders call it, too."""
        return self._each(Tensor.pin_memory)

    def _each(self, move: Callable[[Tensor], Tensor]) -> PointBatch:
        ring = None if self.ring is None else move(self.ring)
        return replace(self, points=move(self.points), scan=move(self.scan), ring=ring)

    def slices(self) -> list[slice]:
        """Where each scan's points stand."""
        sizes = self.sizes or torch.bincount(self.scan, minlength=self.count).tolist()
        ends = list(accumulate(sizes))
        return [slice(end - size, end) for size, end in zip(sizes, ends, strict=True)]

    @classmethod
    def of(cls, scans: Sequence[Scan]) -> PointBatch:
        """The valid points of some scans (`Scan.valid`), in order."""
        kept = [scan.valid for scan in scans]
        points = np.concatenate([s.points[k] for s, k in zip(scans, kept, strict=True)]).astype(
            np.float32, copy=False
        )
        sizes = tuple(int(k.sum()) for k in kept)
        index = np.repeat(np.arange(len(scans)), sizes)
        rings = [s.ring[k] for s, k in zip(scans, kept, strict=True) if s.ring is not None]
        ring = (
            torch.from_numpy(np.concatenate(rings).astype(np.int64))
            if len(rings) == len(scans)
            else None
        )
        names = tuple(scan.name for scan in scans)
        return cls(
            torch.from_numpy(points), torch.from_numpy(index), len(scans), ring, names, sizes
        )
