"""Pseudo-labels: what both views say, where they agree and are sure of it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from torch import Tensor

from amvnet.config.schema import AdaptConfig
from amvnet.models.methods import geometric_mean


@dataclass(frozen=True)
class Opinion:
    """What two networks say about the P valid points of a scan.

    Attributes:
        labels: (P,) uint8 train ids by the ensemble.
        agreed: (P,) uint8 train ids that both networks name where the assertion holds, else 0.
        confidence: (P,) float16 probability of `labels` by the ensemble, in [0, 1].
        uncertain: share of the points where the assertion fails.
    """

    labels: np.ndarray
    agreed: np.ndarray
    confidence: np.ndarray
    uncertain: float


@dataclass(frozen=True)
class Trust:
    """What is trusted of the opinions on some scans, for each of K classes.

    Attributes:
        thresholds: (K,) least confidence of a pseudo-label.
        counts: (K,) points whose confidence reaches it.
        told: (K,) bool, the classes that the networks can tell. The others get no pseudo-labels.
    """

    thresholds: np.ndarray
    counts: np.ndarray
    told: np.ndarray


def opinion(f: Tensor, g: Tensor, uncertain: Tensor) -> Opinion:
    """Return what two networks say.

    Args:
        f, g: (P, K) class probabilities by the two networks.
        uncertain: (P,) bool, the points where the assertion fails (section 3.2 of the paper).
    """
    ensemble = geometric_mean(f, g)
    confidence, best = (ensemble / ensemble.sum(dim=1, keepdim=True)).max(dim=1)

    by_f = f.argmax(dim=1)
    agrees = (by_f == g.argmax(dim=1)) & ~uncertain
    agreed = (by_f + 1) * agrees
    return Opinion(
        labels=(best + 1).cpu().numpy().astype(np.uint8),
        agreed=agreed.cpu().numpy().astype(np.uint8),
        confidence=confidence.cpu().numpy().astype(np.float16),
        uncertain=float(uncertain.float().mean()),
    )


def trust(opinions: Sequence[Opinion], classes: int, config: AdaptConfig) -> Trust:
    """Return what to trust of the opinions on some scans.

    The threshold of a class is a quantile of its confidence among the points that both networks
    agree on, but at most `highest_confidence`. A class is told if this threshold is high enough and
    enough points reach it.
    """
    agreed = np.concatenate([scan.agreed for scan in opinions])
    confidence = np.concatenate([scan.confidence for scan in opinions]).astype(np.float32)

    thresholds = np.ones(classes, dtype=np.float32)
    counts = np.zeros(classes, dtype=np.int64)
    for index in range(classes):
        of_class = confidence[agreed == index + 1]
        if len(of_class):
            quantile = np.quantile(of_class, config.quantile)
            thresholds[index] = min(quantile, config.highest_confidence)
            counts[index] = np.count_nonzero(of_class >= thresholds[index])

    told = (thresholds >= config.lowest_confidence) & (counts >= config.points)
    return Trust(thresholds, counts, told)


def pseudo_labels(scan: Opinion, trusted: Trust) -> np.ndarray:
    """Return the (P,) uint8 pseudo-labels of a scan; 0 for points without."""
    least = np.concatenate([[np.inf], np.where(trusted.told, trusted.thresholds, np.inf)])
    is_sure = scan.confidence.astype(np.float32) >= least[scan.agreed]
    return np.where(is_sure, scan.agreed, 0).astype(np.uint8)


def agreement(start: Sequence[np.ndarray], now: Sequence[np.ndarray], classes: int) -> float:
    """Return how much of what was trusted at the start still stands, in [0, 1].

    It is the share of the points with a pseudo-label at the start that still have this label, on
    average over the classes (as the end without labels of "Train till you drop", Michele et al.).

    Args:
        start: for each scan, its (P,) pseudo-labels at the start; 0 for points without.
        now: for each scan, its (P,) labels by the networks now.
    """
    before = np.concatenate(start)
    kept = before[before == np.concatenate(now)]
    totals = np.bincount(before, minlength=classes + 1)[1:]
    stands = np.bincount(kept, minlength=classes + 1)[1:]
    present = totals > 0
    return float((stands[present] / totals[present]).mean()) if present.any() else 1.0
