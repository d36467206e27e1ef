"""Find the exact nearest neighbours of points with plain tensor operations, for a GPU.

The points of a scan are split into blocks. The search for a point's neighbours begins in the blocks
that are nearest to the point. If nearer points may lie in other blocks, it goes through all points.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn import functional as F

from amvnet.models.views.points import concatenate

BLOCK_SIZE = 128  # largest number of points in a block
# Number of blocks in which a point's neighbours are searched. For most points, two blocks suffice.
SEARCHED_BLOCKS = 8
# The n + SPARE_NEIGHBOURS nearest points in float32 are ranked again in double precision. The spare
# points also make room for the point itself and for repeated points.
SPARE_NEIGHBOURS = 16
ROUNDING = 1e-6  # largest relative error of a squared distance in float32
UNDERFLOW = 1e-37  # squared distance below which float32 is less exact than that, square metres
STEP_MEMORY = 2**30  # memory budget of one step, bytes


@dataclass(frozen=True)
class Blocks:
    """The P points of a scan in M blocks of B slots. The points of a block lie close together.

    Attributes:
        xyz: (M * B, 3) metres, the P points of the scan, followed by infinities.
        index: (M, B) int64 indices into `xyz`; P or more in an unused slot.
        points: (M, 3, B) metres, the points of each block; infinity in an unused slot.
        low: (M, 3) metres, the lower corner of the box around each block.
        high: (M, 3) metres, the upper corner of the box around each block.
    """

    xyz: Tensor
    index: Tensor
    points: Tensor
    low: Tensor
    high: Tensor


def nearest_others_by_blocks(xyz: Tensor, own: Tensor, n: int) -> Tensor:
    """Return (U, n) int64 indices of the n nearest other points of some points of a scan.

    `amvnet.models.neighbours.nearest_others` returns the same points, except that it may choose
    others among equally near points. The tensors stay on their device.
    """
    others = min(n, len(xyz) - 1)
    if not len(own) or others < 1:
        return own[:, None].repeat(1, n)

    nearest = _nearest(xyz, own, others)
    if others == n:
        return nearest
    return torch.cat([nearest, nearest[:, -1:].expand(-1, n - others)], dim=1)


def split_into_blocks(xyz: Tensor) -> Blocks:
    """Split points (P, 3) into blocks of at most `BLOCK_SIZE` points.

    At first, all points are one part. Each step cuts every part into quarters, across x and y in
    turn. The last step cuts every part into halves, across the longest side of its box.
    """
    levels = max(0, math.ceil(math.log2(len(xyz) / BLOCK_SIZE)))
    size = -(-len(xyz) >> levels)  # rounded up

    # Copies of the last point fill the blocks. They may widen a box, but are never neighbours.
    count = size << levels
    padded = torch.cat([xyz, xyz[-1:].expand(count - len(xyz), 3)])
    index = torch.arange(count, device=xyz.device)[None]
    axis = 0
    while levels > 1:
        cuts = 2 if levels > 2 else 1
        index = _cut(index, padded[:, axis][index], 2**cuts)
        levels -= cuts
        axis = 1 - axis
    if levels:
        index = _cut(index, _along_longest_side(padded, index), 2)

    low, high = padded[index].aminmax(dim=1)
    slots = F.pad(xyz, (0, 0, 0, count - len(xyz)), value=torch.inf)
    points = slots[index].transpose(1, 2).contiguous()
    return Blocks(xyz=slots, index=index, points=points, low=low, high=high)


def _cut(index: Tensor, positions: Tensor, pieces: int) -> Tensor:
    """Cut each part across an axis by positions on it: (M, B) -> (M * pieces, B / pieces)."""
    return index.gather(1, positions.argsort(dim=1)).view(len(index) * pieces, -1)


def _along_longest_side(xyz: Tensor, index: Tensor) -> Tensor:
    """Return the positions (M, B) of points along the longest side of each part's box."""
    points = xyz[index]  # (M, B, 3)
    low, high = points.aminmax(dim=1)
    axis = (high - low).argmax(dim=1)
    return points.gather(2, axis[:, None, None].expand(-1, points.shape[1], 1))[..., 0]


def _nearest(xyz: Tensor, own: Tensor, n: int) -> Tensor:
    """Return (U, n) indices of the nearest others in a scan with at least n other points."""
    # Blocks are at least half full. The searched blocks have to hold all candidates.
    if (
        len(xyz) <= SEARCHED_BLOCKS * BLOCK_SIZE
        or n + SPARE_NEIGHBOURS > SEARCHED_BLOCKS * BLOCK_SIZE // 2
    ):
        return _nearest_of_all(xyz, own, n)

    blocks = split_into_blocks(xyz)
    parts = []
    for queries in _parts(own, _bytes_per_query(blocks)):
        nearest, is_unsure = _nearest_in_blocks(blocks, queries, n)
        unsure = is_unsure.nonzero()[:, 0]
        if len(unsure):
            nearest[unsure] = _nearest_of_all(xyz, queries[unsure], n)
        parts.append(nearest)
    return concatenate(parts)


def _nearest_in_blocks(blocks: Blocks, own: Tensor, n: int) -> tuple[Tensor, Tensor]:
    """Search only the blocks nearest to each point.

    Returns:
        (U, n) indices of the nearest others, and (U,) bool: whether another point may be nearer.
    """
    queries = blocks.xyz[own]  # (U, 3)
    gaps, near = _gaps(blocks, queries).topk(SEARCHED_BLOCKS + 1, dim=1, largest=False)

    # Compute squared distances in float32 to all points of the nearest blocks.
    index = blocks.index[near[:, :-1]].flatten(1)  # (U, SEARCHED_BLOCKS * B)
    offsets = blocks.points[near[:, :-1]] - queries[:, None, :, None]  # (U, SEARCHED_BLOCKS, 3, B)
    distance = offsets.square_().sum(dim=2).flatten(1)

    # Rank the nearest points again in double precision, without the point itself.
    rough, column = distance.topk(n + SPARE_NEIGHBOURS, dim=1, largest=False)
    index = index.gather(1, column)
    exact = (blocks.xyz[index] - queries[:, None].double()).square_().sum(dim=2)
    exact, order = exact.masked_fill_(index == own[:, None], torch.inf).sort(dim=1)

    # All other points are at least as far away as the next block's box or the farthest candidate.
    bound = torch.minimum(gaps[:, -1], rough[:, -1]) * (1 - ROUNDING)
    return index.gather(1, order[:, :n]), exact[:, n - 1] > F.threshold(bound, UNDERFLOW, 0)


def _gaps(blocks: Blocks, queries: Tensor) -> Tensor:
    """Return (U, M) squared distances of points (U, 3) to the blocks' boxes; 0 inside a box."""
    values = queries[:, :, None]
    return values.clamp(blocks.low.T, blocks.high.T).sub_(values).square_().sum(dim=1)


def _nearest_of_all(xyz: Tensor, own: Tensor, n: int) -> Tensor:
    """Return (U, n) indices of the nearest others among all points."""
    points = xyz.T.double()
    parts = []
    # A query needs the offsets, the distances and two copies of these to rank them.
    for queries in _parts(own, len(xyz) * 6 * 8):
        offsets = points - points.T[queries][:, :, None]  # (U, 3, P)
        distance = offsets.square_().sum(dim=1).scatter_(1, queries[:, None], torch.inf)
        parts.append(distance.topk(n, dim=1, largest=False).indices)
    return concatenate(parts)


def _bytes_per_query(blocks: Blocks) -> int:
    """Return the memory that the search for one point's neighbours takes, in bytes."""
    to_boxes = 4 * 4 * len(blocks.low)  # offsets and distances
    per_point = 2 * 3 * 4 + 2 * 8 + 2 * 4  # coordinates, indices, distances
    return to_boxes + per_point * SEARCHED_BLOCKS * blocks.index.shape[1]


def _parts(own: Tensor, size: int) -> Iterator[Tensor]:
    """Yield the points in parts that take at most `STEP_MEMORY`, at `size` bytes for each point."""
    yield from own.split(max(1, STEP_MEMORY // size))
