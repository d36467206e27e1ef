"""Find uncertain points by comparing the two networks' scores: the assertion (section 3.2)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from amvnet.errors import InputError

TINY = 1e-12  # smallest divisor, which keeps the cosine of all-zero scores finite


# Takes the class probabilities f and g (P, K) of the two networks, and the points (P, 4): x, y, z
# in metres and intensity in [0, 1]. Returns u (P,) bool, True if a point is uncertain.
Assertion = Callable[[Tensor, Tensor, Tensor], Tensor]


@dataclass(frozen=True)
class Disagreement:
    """The paper's assertion: a point is uncertain if the cosine similarity is at most tau.

    Attributes:
        tau: largest cosine similarity of f and g at an uncertain point, 0 to 1.

    Raises:
        InputError: if tau is out of range.
    """

    tau: float = 0.85

    def __post_init__(self) -> None:
        if not 0 <= self.tau <= 1:  # this also refuses NaN
            raise InputError(f"expected tau from 0 to 1, found {self.tau}; give another")

    def __call__(self, f: Tensor, g: Tensor, points: Tensor) -> Tensor:
        return cosine_similarity(f, g) <= self.tau


def disputed_points(f: Tensor, g: Tensor, uncertain: Tensor, lead: float) -> Tensor:
    """Return (P,) bool: the points that the head classifies, among the `uncertain` ones (P,).

    At a disputed point, the networks name different classes by f and g (P, K), or the best class
    by their geometric mean is at most `lead` times as probable as the second. Elsewhere the head
    hardly ever changes a label, but takes as much time. With a lead of 0, all uncertain points are
    disputed, as in the paper.
    """
    if not lead:
        return uncertain

    index = uncertain.nonzero()[:, 0]
    f, g = f.index_select(0, index), g.index_select(0, index)
    differs = f.argmax(dim=1) != g.argmax(dim=1)
    squares = f * g  # of the mean's probabilities
    is_close = squares * lead**2 >= squares.amax(dim=1, keepdim=True)
    disputed = uncertain.clone()
    disputed[index] = differs | (is_close.sum(dim=1) > 1)
    return disputed


def cosine_similarity(f: Tensor, g: Tensor) -> Tensor:
    """Return the cosine similarity (P,) of class probabilities f and g (P, K), at most 1."""
    lengths = f.norm(dim=1) * g.norm(dim=1)
    similarity: Tensor = torch.linalg.vecdot(f, g) / lengths.clamp_min(TINY)
    return similarity.clamp_max(1)  # rounding must not put a point beyond tau = 1
