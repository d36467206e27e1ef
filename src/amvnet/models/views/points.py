"""The points of one or more scans in the form that the views and networks take."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import accumulate

import numpy as np
import torch
from torch import Tensor

from amvnet.scan import Scan


def occurring(count: int, *indices: Tensor) -> tuple[Tensor, list[Tensor]]:
    """Find which of the indices 0..count - 1 occur in any of the tensors `indices`.

    This does what `torch.unique` does, without a sort.

    Returns:
        The indices that occur (M,), ascending, and the tensors `indices` as indices into these.
    """
    occurs = torch.zeros(count, dtype=torch.bool, device=indices[0].device)
    for index in indices:
        occurs[index.flatten()] = True

    rank = occurs.cumsum(0) - 1  # position of an index among those that occur
    return occurs.nonzero()[:, 0], [rank[index] for index in indices]


@dataclass(frozen=True)
class PointBatch:
    """The points of B scans, one scan after the other.

    Attributes:
        points: (P, 4) float32: x, y, z in metres, intensity in [0, 1]; all finite.
        scan: (P,) int64: the scan that each point belongs to, 0..B - 1; ascending.
        count: B.
        ring: (P,) int64: index of the laser; None if a scan has none.
        names: the names of the scans.
        sizes: the number of points of each scan; empty if unknown, so that the CPU has to wait for
            a GPU to count them.
    """

    points: Tensor
    scan: Tensor
    count: int
    ring: Tensor | None = None
    names: tuple[str, ...] = ()
    sizes: tuple[int, ...] = ()

    def to(self, where: torch.device | torch.dtype | str) -> PointBatch:
        """Return the batch on another device, or with the points in another floating-point type.

        Copies from pinned memory to a GPU do not block.

        Args:
            where: the device or the type.
        """
        if isinstance(where, torch.dtype):
            return replace(self, points=self.points.to(where))

        # From a GPU the copy has to block, or it could be read before it is complete.
        to_gpu = torch.device(where).type == "cuda"
        return self._map(lambda values: values.to(where, non_blocking=to_gpu))

    def pin_memory(self) -> PointBatch:
        """Return the batch in pinned memory; torch's data loaders call this too."""
        return self._map(Tensor.pin_memory)

    def _map(self, function: Callable[[Tensor], Tensor]) -> PointBatch:
        """Return the batch with a function applied to each of its tensors."""
        ring = None if self.ring is None else function(self.ring)
        return replace(self, points=function(self.points), scan=function(self.scan), ring=ring)

    def slices(self) -> list[slice]:
        """Return the slice of each scan's points."""
        sizes = self.sizes or torch.bincount(self.scan, minlength=self.count).tolist()
        ends = list(accumulate(sizes))
        return [slice(end - size, end) for size, end in zip(sizes, ends, strict=True)]

    @classmethod
    def of(cls, scans: Sequence[Scan]) -> PointBatch:
        """Return a batch of the valid points (`Scan.valid`) of one or more scans, in order.

        The batch has ring indices only if every scan has them.
        """
        parts = []
        rings = []
        for scan in scans:
            valid = scan.valid
            parts.append(scan.points[valid])
            if scan.ring is not None:
                rings.append(scan.ring[valid])

        points = np.concatenate(parts).astype(np.float32, copy=False)
        sizes = tuple(len(part) for part in parts)
        scan_index = np.repeat(np.arange(len(scans)), sizes)

        ring = None
        if len(rings) == len(scans):
            ring = torch.from_numpy(np.concatenate(rings).astype(np.int64))

        return cls(
            points=torch.from_numpy(points),
            scan=torch.from_numpy(scan_index),
            count=len(scans),
            ring=ring,
            names=tuple(scan.name for scan in scans),
            sizes=sizes,
        )
