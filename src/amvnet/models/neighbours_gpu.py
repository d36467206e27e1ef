"""The nearest other points of some points of a scan in plain tensor operations, for a GPU: exact, by blocks."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import torch
from torch import Tensor

BLOCK = 128  # points of a block, at most
NEAREST = (
    8  # blocks that are searched for a point's neighbours; 2 hold them for most points of a scan
)
SPARE = 16  # so many more than are asked for are ranked anew in double precision; points that are repeated take room
ROUNDING = 1e-6  # relative: a squared distance in float32 is nearer than this to the true one
UNDERFLOW = 1e-37  # square metres: smaller ones float32 does not know so well
MEMORY = 2**30  # bytes of what is computed at a time


@dataclass(frozen=True)
class Blocks:
    """The P points of a scan in M blocks of B neighbours.

    Attributes:
        index: (M, B) int64; P where a block has a point less.
        points: (M, 3, B) metres; infinity there.
        low, high: (M, 3) corners of the box around each block.
    """

    index: Tensor
    points: Tensor
    low: Tensor
    high: Tensor


def nearest_others_by_blocks(xyz: Tensor, own: Tensor, n: int) -> Tensor:
    """(U, n) int64 indices of the n nearest other points of each point in `own`; the tensors stay where they are.

    As `amvnet.models.neighbours.nearest_others`, but for the choice among points that are equally near: of a scan with fewer
    than n other points the last one is repeated; a lone point is its own neighbour.

    Args:
        xyz: (P, 3) float32 metres, finite.
        own: (U,) int64 indices of the points whose neighbours are asked for.
    """
    others = min(n, len(xyz) - 1)
    if not len(own) or others < 1:
        return own[:, None].repeat(1, n)
    found = _nearest(xyz, own, others)
    return torch.cat([found, found[:, -1:].expand(-1, n - others)], dim=1)


def split_into_blocks(xyz: Tensor) -> Blocks:
    """Halve the points again and again across the longest side of their box, until there are `BLOCK` in each part."""
    levels = max(0, math.ceil(math.log2(len(xyz) / BLOCK)))
    size = -(-len(xyz) >> levels)  # rounded up
    # Up to the full blocks there are copies of the last point: boxes hold them, and nobody finds them.
    index = torch.arange(size << levels, device=xyz.device)[None]
    for ways in [2] * (levels % 2) + [4] * (
        levels // 2
    ):  # in quarters: half as many sorts, and nearly as good boxes
        index = _split(xyz, index, ways)
    points = xyz[index.clamp_max(len(xyz) - 1)]  # (M, B, 3)
    low, high = points.amin(dim=1), points.amax(dim=1)
    copies = (index >= len(xyz))[..., None]
    return Blocks(
        index.clamp_max(len(xyz)),
        points.masked_fill(copies, torch.inf).transpose(1, 2).contiguous(),
        low,
        high,
    )


def _split(xyz: Tensor, index: Tensor, ways: int) -> Tensor:
    """(M, B) -> (M * ways, B / ways): each part cut across the longest side of its box."""
    points = xyz[index.clamp_max(len(xyz) - 1)]
    axis = (points.amax(dim=1) - points.amin(dim=1)).argmax(dim=1)
    along = points.gather(2, axis[:, None, None].expand(-1, points.shape[1], 1))[..., 0]
    return index.gather(1, along.argsort(dim=1)).view(len(index) * ways, -1)


def _nearest(xyz: Tensor, own: Tensor, n: int) -> Tensor:
    """(U, n) of a scan with n other points or more: by the blocks, and where these leave a doubt by all points."""
    if (
        len(xyz) <= NEAREST * BLOCK or n + SPARE > NEAREST * BLOCK // 2
    ):  # a block is at least half full
        return _among_all(xyz, own, n)
    blocks = split_into_blocks(xyz)
    parts = [_in_blocks(xyz, blocks, some, n) for some in _parts(own, _bytes_in_blocks(blocks))]
    found, sure = (torch.cat(values) for values in zip(*parts, strict=True))
    doubtful = (~sure).nonzero()[:, 0]
    if len(doubtful):
        found[doubtful] = _among_all(xyz, own[doubtful], n)
    return found


def _in_blocks(xyz: Tensor, blocks: Blocks, own: Tensor, n: int) -> tuple[Tensor, Tensor]:
    """(U, n) the nearest in the nearest blocks, and (U,) bool: whether there can be no nearer ones."""
    asked = xyz[own]
    gap, near = _gaps(blocks, asked).topk(NEAREST + 1, dim=1, largest=False)
    index = blocks.index[near[:, :-1]].flatten(1)  # (U, NEAREST * B)
    squares = (
        blocks.points[near[:, :-1]] - asked[:, None, :, None]
    ).square_()  # (U, NEAREST, 3, B)
    distance = (squares[:, :, 0] + squares[:, :, 1] + squares[:, :, 2]).flatten(1)
    distance.masked_fill_(index == own[:, None], torch.inf)
    rough, place = distance.topk(n + SPARE, dim=1, largest=False)
    index = index.gather(1, place)
    offset = xyz[index.clamp_max(len(xyz) - 1)].double() - asked[:, None].double()
    exact, order = offset.square().sum(dim=2).masked_fill(rough.isinf(), torch.inf).sort(dim=1)
    # What was left out is no nearer than the next block's box, or than the farthest of the candidates.
    bound = torch.minimum(gap[:, -1], rough[:, -1]).double() * (1 - ROUNDING) - UNDERFLOW
    return index.gather(1, order[:, :n]), exact[:, n - 1] <= bound.clamp_min(0)


def _gaps(blocks: Blocks, asked: Tensor) -> Tensor:
    """(U, M) squared distances of points (U, 3) to the boxes; 0 inside."""
    total = asked.new_zeros(len(asked), len(blocks.low))
    for axis, low, high in zip(
        asked.unbind(1), blocks.low.unbind(1), blocks.high.unbind(1), strict=True
    ):
        total += torch.maximum(low - axis[:, None], axis[:, None] - high).clamp_min_(0).square_()
    return total


def _among_all(xyz: Tensor, own: Tensor, n: int) -> Tensor:
    """(U, n) by the distances to all points, in double precision."""
    found = []
    for some in _parts(own, len(xyz) * 4 * 8):  # sum, difference, and what the choice takes
        distance = torch.zeros(len(some), len(xyz), dtype=torch.float64, device=xyz.device)
        for axis in xyz.double().unbind(1):
            distance += (axis - axis[some][:, None]).square_()
        distance.scatter_(1, some[:, None], torch.inf)
        found.append(distance.topk(n, dim=1, largest=False).indices)
    return torch.cat(found)


def _bytes_in_blocks(blocks: Blocks) -> int:
    """What the search for one point takes: distances to all boxes, and coordinates, indices, distances in some."""
    return 4 * 4 * len(blocks.low) + (2 * 3 * 4 + 2 * 8 + 2 * 4) * NEAREST * blocks.index.shape[1]


def _parts(own: Tensor, size: int) -> Iterator[Tensor]:
    """The points asked for in parts that together take no more than `MEMORY`, at so many bytes each."""
    yield from own.split(max(1, MEMORY // size))
