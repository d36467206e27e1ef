"""Test-time augmentation: class probabilities as means over flips and turns of a scan."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from amvnet.errors import InputError
from amvnet.models.methods import TtaName
from amvnet.models.views.points import PointBatch

Score = Callable[[PointBatch], tuple[Tensor, ...]]  # (P, K) class probabilities of each network


@dataclass(frozen=True)
class Symmetry:
    """A flip or a turn about the vertical that exchanges or negates coordinates, without rounding.

    Attributes:
        swap: whether x and y are exchanged.
        x, y: 1 or -1, by which the coordinates are multiplied after that.
    """

    swap: bool
    x: int
    y: int

    def __call__(self, batch: PointBatch) -> PointBatch:
        """Return the batch with other coordinates of its points."""
        first, second, *others = batch.points.unbind(1)
        if self.swap:
            first, second = second, first
        points = torch.stack([self.x * first, self.y * second, *others], dim=1)
        return replace(batch, points=points)


IDENTITY = Symmetry(swap=False, x=1, y=1)
FLIPS = (
    IDENTITY,
    Symmetry(swap=False, x=1, y=-1),
    Symmetry(swap=False, x=-1, y=1),
    Symmetry(swap=False, x=-1, y=-1),
)
TURNS = (  # by 0, 90, 180 and 270 degrees
    IDENTITY,
    Symmetry(swap=True, x=-1, y=1),
    Symmetry(swap=False, x=-1, y=-1),
    Symmetry(swap=True, x=1, y=-1),
)
# Each is a group, so that a scan that is flipped or turned by one of them has the same means.
SYMMETRIES: dict[TtaName, tuple[Symmetry, ...]] = {
    "flips": FLIPS,
    "yaw": TURNS,
    "both": (*FLIPS, *(replace(flip, swap=True) for flip in FLIPS)),
}


def average(score: Score, batch: PointBatch, symmetries: Sequence[Symmetry]) -> tuple[Tensor, ...]:
    """Return the means of each network's class probabilities over symmetries of some scans.

    Args:
        score: scores the points of a batch.
        batch: the scans.
        symmetries: one or more.
    """
    first, *others = symmetries
    sums = score(first(batch))
    for symmetry in others:
        sums = tuple(map(torch.add, sums, score(symmetry(batch))))

    return tuple(total / len(symmetries) for total in sums)


def check_tta(tta: TtaName | None) -> TtaName | None:
    """Return the name of an augmentation, or None.

    Raises:
        InputError: if there is no such augmentation.
    """
    if tta is not None and tta not in SYMMETRIES:
        raise InputError(
            f"expected a test-time augmentation of {', '.join(SYMMETRIES)}, found {tta!r}; "
            "use one of them, or None"
        )
    return tta
