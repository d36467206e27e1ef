"""Assertions: functions of the two networks' scores that find uncertain points (section 3.2)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal, Protocol

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
    similarity = product / squared_lengths.clamp_min(TINY).sqrt()
    return similarity.clamp_max(1)  # rounding must not put a point beyond tau = 1


@dataclass(frozen=True)
class HighEntropy:
    """Uncertain if the entropy of the mean of f and g is at least `nats`."""

    nats: float = 0.7

    def __call__(
        self, f: Tensor, g: Tensor, points: Tensor, labels: Tensor | None = None
    ) -> Tensor:
        return entropy(f, g) >= self.nats


def entropy(f: Tensor, g: Tensor) -> Tensor:
    """Return the (P,) entropy of the mean of f and g, in nats."""
    mean = (f + g) / 2
    return -(mean * mean.clamp_min(TINY).log()).sum(dim=1)


@dataclass(frozen=True)
class SmallMargin:
    """Uncertain if the two largest probabilities of the mean of f and g differ by at most this."""

    difference: float = 0.3

    def __call__(
        self, f: Tensor, g: Tensor, points: Tensor, labels: Tensor | None = None
    ) -> Tensor:
        return margin(f, g) <= self.difference


def margin(f: Tensor, g: Tensor) -> Tensor:
    """Return the (P,) difference of the two largest probabilities of the mean of f and g."""
    largest = ((f + g) / 2).topk(2, dim=1).values
    return largest[:, 0] - largest[:, 1]


@dataclass(frozen=True)
class DifferentLabels:
    """Uncertain if the two networks label the point differently."""

    def __call__(
        self, f: Tensor, g: Tensor, points: Tensor, labels: Tensor | None = None
    ) -> Tensor:
        return f.argmax(dim=1) != g.argmax(dim=1)


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
    "margin": SmallMargin,
    "loss": HighLoss,
}


@dataclass(frozen=True)
class Combination:
    """Uncertain if any, or if all, of several assertions find the point uncertain."""

    assertions: tuple[Assertion, ...]
    needed: Literal["any", "all"] = "any"

    def __call__(
        self, f: Tensor, g: Tensor, points: Tensor, labels: Tensor | None = None
    ) -> Tensor:
        verdicts = torch.stack([each(f, g, points, labels) for each in self.assertions])
        return verdicts.any(dim=0) if self.needed == "any" else verdicts.all(dim=0)


def build_assertion(config: AssertionConfig, labels: bool = False) -> Assertion:
    """Return the assertion that a configuration names.

    Args:
        config: names one assertion or several.
        labels: whether the assertion is given labels, as in training. Without them, what needs
            labels is left out; if nothing is left, the paper's assertion stands in for it.
    """
    if not labels:
        config = config.for_prediction()

    assertions = []
    for name, threshold in config.terms:
        assertions.append(DifferentLabels() if name == "labels" else KINDS[name](threshold))
    if len(assertions) == 1:
        return assertions[0]
    return Combination(tuple(assertions), config.combine)
