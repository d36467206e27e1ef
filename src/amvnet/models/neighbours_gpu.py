"""The nearest neighbours of points of a scan in plain tensor operations, exact, for a GPU.

The points are split into blocks. A point's neighbours are searched for in the blocks nearest to
it, and among all points only if nearer ones may lie elsewhere.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import torch
from torch import Tensor

BLOCK = 128  # points of a block, at most
NEAREST = 8  # blocks searched for a point's neighbours; for most points 2 hold them all
# Candidates beyond the n nearest in float32 that are ranked again in double precision. They also
# make room for the point itself and for repeated points.
SPARE = 16
ROUNDING = 1e-6  # largest relative error of a squared distance in float32
UNDERFLOW = 1e-37  # square metres; below, float32 is less exact than `ROUNDING`
MEMORY = 2**30  # bytes that are used at a time


@dataclass(frozen=True)
class Blocks:
    """The P points of a scan in M blocks of B points that lie close together.

    Attributes:
        index: (M, B) int64 indices of the points; P in an unused slot.
        points: (M, 3, B) metres; infinity in an unused slot.
        low: (M, 3) lower corner of the box around each block.
        high: (M, 3) upper corner of the box around each block.
    """

    index: Tensor
    points: Tensor
    low: Tensor
    high: Tensor


def nearest_others_by_blocks(xyz: Tensor, own: Tensor, n: int) -> Tensor:
    """Return (U, n) int64 indices of the n nearest other points of each point in `own`.

    The result is that of `amvnet.models.neighbours.nearest_others`, except for the choice among
    points that are equally near. The tensors stay on their device.

    Args:
        xyz: (P, 3) float32 metres, finite.
        own: (U,) int64 indices of the points whose neighbours are searched for.
    """
    others = min(n, len(xyz) - 1)
    if not len(own) or others < 1:
        return own[:, None].repeat(1, n)

    nearest = _nearest(xyz, own, others)
    return torch.cat([nearest, nearest[:, -1:].expand(-1, n - others)], dim=1)


def split_into_blocks(xyz: Tensor) -> Blocks:
    """Split points (P, 3) into blocks of at most `BLOCK`.

    Each part is halved across the longest side of its box until it is small enough.
    """
    levels = max(0, math.ceil(math.log2(len(xyz) / BLOCK)))
    size = -(-len(xyz) >> levels)  # rounded up

    # Copies of the last point fill the blocks up. They may widen a box, but are never a neighbour.
    count = size << levels
    padded = torch.cat([xyz, xyz[-1:].expand(count - len(xyz), 3)])
    index = torch.arange(count, device=xyz.device)[None]
    if levels % 2:
        index = _split(padded, index, 2)
    # Cutting into quarters takes half as many sorts, and the boxes are nearly as good.
    for _ in range(levels // 2):
        index = _split(padded, index, 4)

    points = padded[index]  # (M, B, 3)
    low, high = points.aminmax(dim=1)
    is_copy = (index >= len(xyz))[..., None]
    return Blocks(
        index=index.clamp_max(len(xyz)),
        points=points.masked_fill(is_copy, torch.inf).transpose(1, 2).contiguous(),
        low=low,
        high=high,
    )


def _split(xyz: Tensor, index: Tensor, ways: int) -> Tensor:
    """Cut each part across the longest side of its box: (M, B) -> (M * ways, B / ways)."""
    points = xyz[index]  # (M, B, 3)
    low, high = points.aminmax(dim=1)
    axis = (high - low).argmax(dim=1)
    positions = points.gather(2, axis[:, None, None].expand(-1, points.shape[1], 1))[..., 0]
    return index.gather(1, positions.argsort(dim=1)).view(len(index) * ways, -1)


def _nearest(xyz: Tensor, own: Tensor, n: int) -> Tensor:
    """Return (U, n) indices of the nearest others in a scan with at least n other points."""
    # Blocks are at least half full; those that are searched have to hold all candidates.
    if len(xyz) <= NEAREST * BLOCK or n + SPARE > NEAREST * BLOCK // 2:
        return _nearest_of_all(xyz, own, n)

    blocks = split_into_blocks(xyz)
    nearest_parts = []
    sure_parts = []
    for queries in _parts(own, _bytes_per_query(blocks)):
        nearest, sure = _nearest_in_blocks(xyz, blocks, queries, n)
        nearest_parts.append(nearest)
        sure_parts.append(sure)

    nearest = torch.cat(nearest_parts)
    unsure = (~torch.cat(sure_parts)).nonzero()[:, 0]
    if len(unsure):
        nearest[unsure] = _nearest_of_all(xyz, own[unsure], n)
    return nearest


def _nearest_in_blocks(xyz: Tensor, blocks: Blocks, own: Tensor, n: int) -> tuple[Tensor, Tensor]:
    """Search the nearest blocks only.

    Returns:
        (U, n) indices of the nearest others, and (U,) bool: True if no other point is nearer.
    """
    queries = xyz[own]  # (U, 3)
    gaps, near = _gaps(blocks, queries).topk(NEAREST + 1, dim=1, largest=False)

    # Squared distances in float32 to all points of the nearest blocks
    index = blocks.index[near[:, :-1]].flatten(1)  # (U, NEAREST * B)
    offsets = blocks.points[near[:, :-1]] - queries[:, None, :, None]  # (U, NEAREST, 3, B)
    distance = offsets.square_().sum(dim=2).flatten(1)
    distance.masked_fill_(index == own[:, None], torch.inf)

    # The best of them ranked again in double precision
    rough, column = distance.topk(n + SPARE, dim=1, largest=False)
    index = index.gather(1, column)
    offset = xyz[index.clamp_max(len(xyz) - 1)].double() - queries[:, None].double()
    exact, order = offset.square().sum(dim=2).masked_fill(rough.isinf(), torch.inf).sort(dim=1)

    # All other points are at least as far as the next block's box or the farthest candidate.
    bound = torch.minimum(gaps[:, -1], rough[:, -1]).double() * (1 - ROUNDING) - UNDERFLOW
    return index.gather(1, order[:, :n]), exact[:, n - 1] <= bound.clamp_min(0)


def _gaps(blocks: Blocks, queries: Tensor) -> Tensor:
    """Return (U, M) squared distances of points (U, 3) to the blocks' boxes; 0 inside a box."""
    total = queries.new_zeros(len(queries), len(blocks.low))
    for axis in range(3):
        values = queries[:, axis, None]
        outside = values - values.clamp(blocks.low[:, axis], blocks.high[:, axis])
        total.addcmul_(outside, outside)
    return total


def _nearest_of_all(xyz: Tensor, own: Tensor, n: int) -> Tensor:
    """Return (U, n) indices of the nearest others by the distances to all points, in float64."""
    nearest = []
    for queries in _parts(own, len(xyz) * 4 * 8):  # sums, differences, and two copies to rank them
        distance = torch.zeros(len(queries), len(xyz), dtype=torch.float64, device=xyz.device)
        for axis in xyz.double().unbind(1):
            distance += (axis - axis[queries][:, None]).square_()

        distance.scatter_(1, queries[:, None], torch.inf)
        nearest.append(distance.topk(n, dim=1, largest=False).indices)
    return torch.cat(nearest)


def _bytes_per_query(blocks: Blocks) -> int:
    """Return the memory that the search for one point's neighbours in the blocks takes."""
    to_boxes = 4 * 4 * len(blocks.low)  # distances
    per_point = 2 * 3 * 4 + 2 * 8 + 2 * 4  # coordinates, indices, distances
    return to_boxes + per_point * NEAREST * blocks.index.shape[1]


def _parts(own: Tensor, size: int) -> Iterator[Tensor]:
    """Yield the points in parts that take at most `MEMORY`, at `size` bytes a point."""
    yield from own.split(max(1, MEMORY // size))
