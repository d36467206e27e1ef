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
    """Find which of 0..count - 1 occur in some tensors of indices, as `unique` but without a sort.

    Returns:
        Those that occur (M,), ascending, and the tensors with indices into these.
    """
    occurs = torch.zeros(count, dtype=torch.bool, device=indices[0].device)
    for index in indices:
        occurs[index.flatten()] = True

    position = occurs.cumsum(0) - 1
    return occurs.nonzero()[:, 0], [position[index] for index in indices]


@dataclass(frozen=True)
class PointBatch:
    """The points of B scans, one scan after the other.

    Attributes:
        points: (P, 4) float32: x, y, z in metres, intensity in [0, 1]; all finite.
        scan: (P,) int64: the scan that each point belongs to, 0..B - 1; ascending.
        count: B.
        ring: (P,) int64: index of the laser, or None.
        names: the names of the scans.
        sizes: the number of points of each scan, or empty if unknown. If it is known, the CPU need
            not wait for a GPU to count them.
    """

    points: Tensor
    scan: Tensor
    count: int
    ring: Tensor | None = None
    names: tuple[str, ...] = ()
    sizes: tuple[int, ...] = ()

    def to(self, where: torch.device | torch.dtype | str) -> PointBatch:
        """Return the batch on a device, or with points of a floating-point type.

        Copies from pinned memory to a GPU do not block.
        """
        if isinstance(where, torch.dtype):
            return replace(self, points=self.points.to(where))

        # From a GPU the copy has to block: else it could be read before it is complete.
        to_gpu = torch.device(where).type == "cuda"
        return self._map(lambda values: values.to(where, non_blocking=to_gpu))

    def pin_memory(self) -> PointBatch:
        """Return the batch in pinned memory; torch's data loaders call this too."""
        return self._map(Tensor.pin_memory)

    def _map(self, function: Callable[[Tensor], Tensor]) -> PointBatch:
        ring = None if self.ring is None else function(self.ring)
        return replace(self, points=function(self.points), scan=function(self.scan), ring=ring)

    def slices(self) -> list[slice]:
        """Return the slice of each scan's points."""
        sizes = self.sizes or torch.bincount(self.scan, minlength=self.count).tolist()
        ends = list(accumulate(sizes))
        return [slice(end - size, end) for size, end in zip(sizes, ends, strict=True)]

    @classmethod
    def of(cls, scans: Sequence[Scan]) -> PointBatch:
        """Return the valid points (`Scan.valid`) of some scans, in order.

        The batch has rings only if all scans have.
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
        index = np.repeat(np.arange(len(scans)), sizes)

        ring = None
        if len(rings) == len(scans):
            ring = torch.from_numpy(np.concatenate(rings).astype(np.int64))
        return cls(
            points=torch.from_numpy(points),
            scan=torch.from_numpy(index),
            count=len(scans),
            ring=ring,
            names=tuple(scan.name for scan in scans),
            sizes=sizes,
        )
