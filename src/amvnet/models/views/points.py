"""Put the points of one or more scans into one batch, which the views and networks take."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import accumulate

import numpy as np
import torch
from torch import Tensor

from amvnet.scan import Scan


def occurring(count: int, *indices: Tensor) -> tuple[Tensor, list[Tensor]]:
    """Find which of the indices 0..count - 1 occur in any of the tensors `indices`.

    This is what `torch.unique` does, but without a sort.

    Returns:
        The M indices that occur, ascending, (M,); and for each tensor in `indices`, the places of
        its values among these M indices.
    """
    # There is one place before the first index, so that the cumulative sum counts smaller indices.
    padded = torch.zeros(count + 1, dtype=torch.bool, device=indices[0].device)
    occurs = padded[1:]
    for index in indices:
        occurs.index_fill_(0, index.flatten().long(), True)

    rank = padded.cumsum(0)  # position of an index among those that occur
    ranks = [rank.index_select(0, index.flatten()).view(index.shape) for index in indices]
    return occurs.nonzero()[:, 0], ranks


def concatenate(parts: Sequence[Tensor]) -> Tensor:
    """Concatenate tensors along their first axis; a single tensor is not copied."""
    return parts[0] if len(parts) == 1 else torch.cat(list(parts))


@dataclass(frozen=True)
class PointBatch:
    """The points of B scans, one scan after the other.

    Attributes:
        points: (P, 4) float32: x, y, z in metres, intensity in [0, 1]; all finite.
        scan: (P,) int64: the scan that each point belongs to, 0..B - 1, ascending.
        count: B, the number of scans.
        ring: (P,) int64 indices of the lasers: 0 is the lowest laser, -1 is unknown. None if no
            scan has rings.
        row: (P,) int64 rows of the range image: 0 is the top, -1 is unknown. None if no scan has
            rows.
        sizes: the number of points of each scan. If it is empty, the points have to be counted, and
            for this the CPU waits for a GPU.
    """

    points: Tensor
    scan: Tensor
    count: int
    ring: Tensor | None = None
    row: Tensor | None = None
    names: tuple[str, ...] = ()
    sizes: tuple[int, ...] = ()

    def to(self, where: torch.device | torch.dtype | str) -> PointBatch:
        """Return the batch on another device, or with the points in another floating-point type.

        Copies from pinned memory to a GPU do not block.
        """
        if isinstance(where, torch.dtype):
            return replace(self, points=self.points.to(where))

        # A copy from a GPU has to block: otherwise it could be read before it is complete.
        to_gpu = torch.device(where).type == "cuda"
        return self._map(lambda values: values.to(where, non_blocking=to_gpu))

    def pin_memory(self) -> PointBatch:
        """Return the batch in pinned memory. torch's data loaders also call this."""
        return self._map(Tensor.pin_memory)

    def _map(self, function: Callable[[Tensor], Tensor]) -> PointBatch:
        ring = None if self.ring is None else function(self.ring)
        row = None if self.row is None else function(self.row)
        points = function(self.points)
        return replace(self, points=points, scan=function(self.scan), ring=ring, row=row)

    @cached_property
    def cylindrical(self) -> Tensor:
        """Radius, azimuth and height of the points, (3, P) float64, in metres and radians.

        With double precision, a point at a cell's border falls into the same cell on any device.
        """
        # Some functions are much faster on contiguous tensors.
        xyz = self.points.T[:3].to(torch.float64, memory_format=torch.contiguous_format)
        x, y, z = xyz
        x_squared, y_squared = xyz[:2].square()
        return torch.stack([(x_squared + y_squared).sqrt_(), torch.atan2(y, x), z])

    @cached_property
    def slices(self) -> list[slice]:
        """The slice of each scan's points."""
        sizes = self.sizes or torch.bincount(self.scan, minlength=self.count).tolist()
        ends = list(accumulate(sizes))
        return [slice(end - size, end) for size, end in zip(sizes, ends, strict=True)]

    @classmethod
    def of(cls, scans: Sequence[Scan], device: torch.device | str = "cpu") -> PointBatch:
        """Return a batch of the valid points (`Scan.valid`) of one or more scans, in order.

        For a GPU, points are first copied into pinned memory, which torch uses again.
        """
        valid = [scan.valid for scan in scans]
        sizes = tuple(int(np.count_nonzero(mask)) for mask in valid)
        count = sum(sizes)
        is_pinned = torch.device(device).type == "cuda"
        points = torch.empty(count, 4, pin_memory=is_pinned)
        scan_index = torch.empty(count, dtype=torch.int64, device=device)
        ring = None
        if any(scan.ring is not None for scan in scans):
            ring = torch.full((count,), -1, pin_memory=is_pinned)
        row = None
        if any(scan.row is not None for scan in scans):
            row = torch.full((count,), -1, pin_memory=is_pinned)

        batch = cls(
            points=points,
            scan=scan_index,
            count=len(scans),
            ring=ring,
            row=row,
            names=tuple(scan.name for scan in scans),
            sizes=sizes,
        )
        for index, (scan, mask, part) in enumerate(zip(scans, valid, batch.slices, strict=True)):
            which = slice(None) if mask.all() else mask  # indexing by a slice makes no copy
            points.numpy()[part] = scan.points[which]
            scan_index[part].fill_(index)
            if ring is not None and scan.ring is not None:
                ring.numpy()[part] = scan.ring[which]
            if row is not None and scan.row is not None:
                row.numpy()[part] = scan.row[which]
        return batch.to(device)
