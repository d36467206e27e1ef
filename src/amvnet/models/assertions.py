"""Assertions: functions of the two networks' scores that find uncertain points (section 3.2)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import torch
from torch import Tensor

from amvnet.config.schema import AssertionConfig

TINY = 1e-12  # keeps the logarithm of a probability finite


class Assertion(Protocol):
    """A function that finds the uncertain points.

    Args:
        f: (P, K) class probabilities of the range-view network.
        g: (P, K) class probabilities of the bird's-eye-view network.
        points: (P, 4) x, y, z in metres and intensity in [0, 1].
        labels: (P,) train ids, or None.

    Returns:
        (P,) bool: True if a point is uncertain.
    """

    def __call__(
        self, f: Tensor, g: Tensor, points: Tensor, labels: Tensor | None = None
    ) -> Tensor: ...


@dataclass(frozen=True)
class Disagreement:
    """The paper's assertion: uncertain if the cosine similarity of f and g is at most tau."""

    tau: float = 0.85

    def __call__(
        self, f: Tensor, g: Tensor, points: Tensor, labels: Tensor | None = None
    ) -> Tensor:
        return cosine_similarity(f, g) <= self.tau


def cosine_similarity(f: Tensor, g: Tensor) -> Tensor:
    """Return the (P,) similarity of class probabilities (P, K): 0 if disjoint, 1 if the same."""
    product = torch.linalg.vecdot(f, g)
    squared_lengths = torch.linalg.vecdot(f, f) * torch.linalg.vecdot(g, g)
    return product / squared_lengths.clamp_min(TINY).sqrt()


@dataclass(frozen=True)
class HighEntropy:
    """Uncertain if the entropy of the mean of f and g is at least `nats`."""

    nats: float = 0.7

    def __call__(
        self, f: Tensor, g: Tensor, points: Tensor, labels: Tensor | None = None
    ) -> Tensor:
        mean = (f + g) / 2
        return -(mean * mean.clamp_min(TINY).log()).sum(dim=1) >= self.nats


@dataclass(frozen=True)
class HighLoss:
    """Uncertain if either network's cross-entropy is at least `nats`.

    Needs labels, and so serves training only. Points without a label are never uncertain.
    """

    nats: float = 0.7

    def __call__(
        self, f: Tensor, g: Tensor, points: Tensor, labels: Tensor | None = None
    ) -> Tensor:
        if labels is None:
            raise ValueError(
                "expected labels for the loss assertion, found none; use it in training only"
            )

        column = (labels.long() - 1).clamp_min(0)[:, None]  # label 0 has no column
        lower = torch.minimum(f.gather(1, column), g.gather(1, column))[:, 0]
        return (-lower.clamp_min(TINY).log() >= self.nats) & (labels > 0)


KINDS: dict[str, Callable[[float], Assertion]] = {
    "disagreement": Disagreement,
    "entropy": HighEntropy,
    "loss": HighLoss,
}


def build_assertion(config: AssertionConfig) -> Assertion:
    """Return the assertion that a configuration names."""
    return KINDS[config.name](config.threshold)
