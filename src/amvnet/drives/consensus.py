"""Fuse the scores of a drive over time: what its scans say of the same places in the world."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from itertools import chain, repeat
from typing import Generic, NamedTuple, TypeVar

import numpy as np
import torch
from numpy.typing import NDArray

SIZE = 0.25  # edge of the small voxels, metres; the large ones have twice this edge
REACH = 9  # number of scans before a scan, and of scans after it, whose scores count
OWN = 0.2  # share of a point's own scores, in [0, 1]
LEAST = 0.01  # smaller probabilities count as this, so that no scan alone rules out a class
# Log scores and weights are sums of whole numbers of steps, which float32 holds exactly. So a scan
# that left the reach leaves nothing behind, and a resumed run computes the same labels.
STEPS = 16
_BITS = 21  # bits of a voxel's place along one axis
LARGEST_INDEX = 1 << (_BITS - 1)  # voxels in so many places on each side have keys of their own

NOTHING = np.empty((0, 0), np.float32)  # the consensus on no points

Item = TypeVar("Item")


class VoxelTable:
    """The sums over some scans by voxel, C (`width`) in each; it grows with the voxels they see."""

    def __init__(self, width: int) -> None:
        self._keys = np.empty(0, np.int64)  # of all voxels in reach, ascending
        self._rows = np.empty(0, np.intp)  # the row of each of them
        self._free = np.empty(0, np.intp)  # rows that no voxel has
        self._sums = np.empty((0, width), np.float32)
        self._scans = np.empty(0, np.int32)  # number of scans that see the voxel of a row

    def add(self, keys: NDArray[np.int64], sums: NDArray[np.float32]) -> None:
        """Add the sums (M, C) of a scan in its M voxels, whose keys are ascending."""
        place = self._keys.searchsorted(keys)
        is_new = np.ones(len(keys), bool)
        inside = place < len(self._keys)
        is_new[inside] = self._keys[place[inside]] != keys[inside]

        rows = self._take(int(np.count_nonzero(is_new)))
        self._keys = np.insert(self._keys, place[is_new], keys[is_new])
        self._rows = np.insert(self._rows, place[is_new], rows)
        rows = self.rows(keys)
        self._sums[rows] += sums
        self._scans[rows] += 1

    def remove(self, keys: NDArray[np.int64], sums: NDArray[np.float32]) -> None:
        """Subtract the sums of a scan that was added."""
        place = self._keys.searchsorted(keys)
        rows = self._rows[place]
        self._sums[rows] -= sums
        self._scans[rows] -= 1
        is_unseen = self._scans[rows] == 0
        self._free = np.concatenate((self._free, rows[is_unseen]))
        self._keys = np.delete(self._keys, place[is_unseen])
        self._rows = np.delete(self._rows, place[is_unseen])

    def rows(self, keys: NDArray[np.int64]) -> NDArray[np.intp]:
        """Return the rows (M,) of voxels that were added."""
        return self._rows[self._keys.searchsorted(keys)]

    def means(self, keys: NDArray[np.int64]) -> NDArray[np.float32]:
        """Return the (M, C - 1) weighted means; the last sum of a voxel is its total weight."""
        sums = self._sums[self.rows(keys)]
        means: NDArray[np.float32] = sums[:, :-1] / sums[:, -1:]
        return means

    def contents(self) -> tuple[NDArray[np.int64], NDArray[np.float32], NDArray[np.int32]]:
        """Return all voxels: their keys (V,), sums (V, C) and numbers of scans (V,)."""
        return self._keys, self._sums[self._rows], self._scans[self._rows]

    def restore(
        self, keys: NDArray[np.int64], sums: NDArray[np.float32], scans: NDArray[np.int32]
    ) -> None:
        """Set all voxels, given what `contents` returned."""
        self._keys, self._sums, self._scans = keys, sums, scans
        self._rows = np.arange(len(keys))
        self._free = np.empty(0, np.intp)

    def _take(self, count: int) -> NDArray[np.intp]:
        """Return rows of zeros that no voxel has."""
        size = len(self._sums)
        if count > len(self._free):
            more = max(count - len(self._free), size // 2)
            self._sums = np.pad(self._sums, ((0, more), (0, 0)))
            self._scans = np.concatenate((self._scans, np.zeros(more, np.int32)))
            self._free = np.concatenate((self._free, np.arange(size, size + more)))
        taken, self._free = self._free[:count], self._free[count:]
        return taken


@dataclass(frozen=True)
class DriveScan(Generic[Item]):
    """A scan of a drive.

    Attributes:
        xyz: (N, 3) coordinates of the points, metres.
        scores: (N, K) their scores, such as class probabilities. Points whose scores are all 0 are
            left alone.
        pose: (4, 4) moves the points into the world.
    """

    item: Item
    xyz: NDArray[np.floating]
    scores: NDArray[np.floating]
    pose: NDArray[np.floating]


class Fused(NamedTuple, Generic[Item]):
    """The consensus on the N points of a scan.

    Attributes:
        scores: (N, K) float32 fused probabilities; the rows of points without scores are 0.
    """

    item: Item
    scores: NDArray[np.float32]


@dataclass(frozen=True)
class _Seen:
    """A scan in reach.

    Attributes:
        logs: (N, K) float32 log scores of its points, in steps.
        is_fused: (N,) bool, the points that have scores.
        keys: the ascending keys of the small voxels (M,), and of the large ones.
        sums: the sums in them.
        inverse: the index of the small voxel of each point that has scores, and of the large voxel
            of each small one.
    """

    logs: NDArray[np.float32]
    is_fused: NDArray[np.bool_]
    keys: tuple[NDArray[np.int64], NDArray[np.int64]]
    sums: tuple[NDArray[np.float32], NDArray[np.float32]]
    inverse: tuple[NDArray[np.intp], NDArray[np.intp]]


class Consensus:
    """The consensus of a drive: the scores of each point, fused with scores of the same place.

    Let p_j be the class probabilities of point j, w_j the square of the largest of them, and

        m(V) = sum_j w_j log p_j / sum_j w_j

    the mean log scores of all points that the scans in reach have in the voxel V of the world. The
    fused log scores of a point i in the small voxel V and the large voxel V' are

        OWN log p_i + (1 - OWN) / 2 (m(V) + m(V')).

    Like the geometric mean of two networks, this is a late fusion, with time as a further view.

    Args:
        reach: number of scans before a scan, and after it, that count.
        past_only: whether scans after a scan do not count, as on a robot.
    """

    def __init__(self, reach: int = REACH, past_only: bool = False) -> None:
        self.reach = reach
        self.ahead = 0 if past_only else reach
        self._tables: list[VoxelTable] = []  # of the small and of the large voxels

    def stream(self, scans: Iterable[DriveScan[Item]]) -> Iterator[Fused[Item]]:
        """Yield the consensus on each scan of a drive, in order.

        A scan is returned when `reach` later scans have been read, or at once if only past scans
        count.
        """
        self._tables = []
        # The scans in reach of the next one to return; None stands for what has no points.
        window = deque[tuple[Item, _Seen | None]]()
        place = 0  # the index of the next one in the window
        for count, scan in enumerate(chain(scans, repeat(None, self.ahead))):
            if scan is not None:
                seen = self._see(scan) if len(scan.xyz) else None
                window.append((scan.item, seen))
                if seen is not None:
                    if not self._tables:
                        self._tables = [VoxelTable(sums.shape[1]) for sums in seen.sums]
                    for table, keys, sums in zip(self._tables, seen.keys, seen.sums, strict=True):
                        table.add(keys, sums)
            if count < self.ahead:
                continue

            item, seen = window[place]
            yield Fused(item, NOTHING if seen is None else self._fuse(seen))
            if place < self.reach:
                place += 1
                continue
            _, seen = window.popleft()
            if seen is not None:
                for table, keys, sums in zip(self._tables, seen.keys, seen.sums, strict=True):
                    table.remove(keys, sums)

    def _see(self, scan: DriveScan[Item]) -> _Seen:
        """Sum the log scores of a scan by voxel."""
        is_fused, logs, weighted = weighted_logs(scan.scores)
        xyz = np.asarray(scan.xyz, np.float64)
        xyz = xyz if is_fused.all() else xyz[is_fused]
        world = xyz @ scan.pose[:3, :3].T + scan.pose[:3, 3]
        index = np.floor(world / SIZE).astype(np.int64)
        small, first, inverse = np.unique(keys_of(index), return_index=True, return_inverse=True)
        large, parent = np.unique(keys_of(index[first] // 2), return_inverse=True)
        sums = sum_by(inverse, weighted, len(small))
        return _Seen(
            logs,
            is_fused,
            keys=(small, large),
            sums=(sums, sum_by(parent, sums, len(large))),
            inverse=(inverse, parent),
        )

    def _fuse(self, seen: _Seen) -> NDArray[np.float32]:
        """Return the fused probabilities of a scan whose reach is in the tables."""
        means = self._tables[0].means(seen.keys[0])
        means += self._tables[1].means(seen.keys[1])[seen.inverse[1]]
        fused = torch.from_numpy(means).mul_((1 - OWN) / 2)
        fused = fused.index_select(0, torch.from_numpy(seen.inverse[0]))
        logs = torch.from_numpy(seen.logs)
        is_fused = torch.from_numpy(seen.is_fused)
        is_whole = bool(is_fused.all())
        fused.add_(logs if is_whole else logs[is_fused], alpha=OWN)
        # In place: new memory for a softmax takes longer than its numbers. From log LEAST to 0, no
        # exponential is too large or too small.
        fused.div_(STEPS).exp_()
        fused.div_(fused.sum(dim=1, keepdim=True))
        if is_whole:
            return fused.numpy()

        probabilities = torch.zeros_like(logs)
        probabilities[is_fused] = fused
        return probabilities.numpy()


def weighted_logs(
    scores: NDArray[np.floating],
) -> tuple[NDArray[np.bool_], NDArray[np.float32], NDArray[np.float32]]:
    """Return the log scores of N points, and their weights in the mean log scores of a voxel.

    Returns:
        (N,) bool, the P points that have scores; (N, K) log scores in steps; and (P, K + 1) whole
        numbers, the weighted log scores and the weights of these points.
    """
    values = torch.from_numpy(np.asarray(scores, np.float32))
    total = values.sum(dim=1, keepdim=True)
    has_scores = total[:, 0] > 0
    total = total.where(has_scores[:, None], 1)
    weights = (values.amax(dim=1, keepdim=True) / total).square_().mul_(STEPS).round_().clamp_(1)
    logs = (values / total).clamp_(LEAST).log_().mul_(STEPS)

    weighted = torch.empty(len(logs), logs.shape[1] + 1)
    torch.mul(logs.round(), weights, out=weighted[:, :-1])
    weighted[:, -1:] = weights
    if not has_scores.all():
        weighted = weighted[has_scores]
    return has_scores.numpy(), logs.numpy(), weighted.numpy()


def sum_by(group: NDArray[np.intp], values: NDArray[np.float32], count: int) -> NDArray[np.float32]:
    """Return the sums (count, C) of the values (P, C) in each group."""
    sums = torch.zeros(count, values.shape[1])
    sums.index_add_(0, torch.from_numpy(group), torch.from_numpy(values))
    return sums.numpy()


def keys_of(index: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return one number for the place (N, 3) of each voxel, different for near voxels.

    Voxels have the same number if they are a multiple of 2^21 voxels apart in x, y and z.
    """
    x, y, z = (index & ((1 << _BITS) - 1)).T
    keys: NDArray[np.int64] = x << (2 * _BITS) | y << _BITS | z
    return keys


def index_of(keys: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return the places (N, 3) of voxels, from -2^20 to 2^20 - 1, given their keys."""
    shifts = np.array([2 * _BITS, _BITS, 0])
    index: NDArray[np.int64] = (keys[:, None] >> shifts) & ((1 << _BITS) - 1)
    index -= (index >> (_BITS - 1)) << _BITS  # negative places have the highest bit
    return index
