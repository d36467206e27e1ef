"""Assertions: functions of two networks' scores that say which points are uncertain (section 3.2 of the paper)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import torch
from torch import Tensor

from amvnet.config.schema import AssertionConfig

TINY = 1e-12  # keeps the logarithm of a probability finite


class Assertion(Protocol):
    """f, g: (P, K) class probabilities of the two networks; points: (P, 4); labels: (P,) train ids or None.

    Returns (P,) bool: True where a point is uncertain.
    """

    def __call__(
        self, f: Tensor, g: Tensor, points: Tensor, labels: Tensor | None = None
    ) -> Tensor: ...


@dataclass(frozen=True)
class Disagreement:
    """Uncertain where the cosine similarity of the two scores is at most tau: the paper's assertion."""

    tau: float = 0.85

    def __call__(
        self, f: Tensor, g: Tensor, points: Tensor, labels: Tensor | None = None
    ) -> Tensor:
        return cosine_similarity(f, g) <= self.tau


def cosine_similarity(f: Tensor, g: Tensor) -> Tensor:
    """(P,) of two networks' scores (P, K): from 0, they have no class in common, to 1, they are the same."""
    both, length = torch.linalg.vecdot(f, g), torch.linalg.vecdot(f, f) * torch.linalg.vecdot(g, g)
    return both / length.clamp_min(TINY).sqrt()


@dataclass(frozen=True)
class HighEntropy:
    """Uncertain where the entropy of the mean score is at least so many nats."""

    nats: float = 0.7

    def __call__(
        self, f: Tensor, g: Tensor, points: Tensor, labels: Tensor | None = None
    ) -> Tensor:
        mean = (f + g) / 2
        return -(mean * mean.clamp_min(TINY).log()).sum(dim=1) >= self.nats


@dataclass(frozen=True)
class HighLoss:
    """Uncertain where a network's cross-entropy is at least so many nats; needs labels, so for training only."""

    nats: float = 0.7

    def __call__(
        self, f: Tensor, g: Tensor, points: Tensor, labels: Tensor | None = None
    ) -> Tensor:
        if labels is None:
            raise ValueError(
                "expected labels for the loss assertion, found none; it is for training"
            )
        column = (labels.long() - 1).clamp_min(0)[:, None]
        worst = torch.minimum(f.gather(1, column), g.gather(1, column))[:, 0]
        return (-worst.clamp_min(TINY).log() >= self.nats) & (labels > 0)


KINDS: dict[str, Callable[[float], Assertion]] = {
    "disagreement": Disagreement,
    "entropy": HighEntropy,
    "loss": HighLoss,
}


def build_assertion(config: AssertionConfig) -> Assertion:
    """The assertion that a configuration names."""
    return KINDS[config.name](config.threshold)
