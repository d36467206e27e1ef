"""The losses of the two networks; points with train id 0 have no part in them."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional as F

FREQUENCY_FLOOR = 1e-4  # a class rarer than this weighs no more than one at it, so that few points cannot rule a step

SMALL = 1e-3  # of the errors that Lovász-softmax leaves out; the loss is exact within it


def at_least_float(x: Tensor) -> Tensor:
    """In float32 where it is in half precision."""
    return x.to(torch.promote_types(x.dtype, torch.float32))


def class_weights(counts: np.ndarray) -> np.ndarray:
    """Square roots of inverse class frequencies (section 4.1 of the paper), their mean 1.

    Args:
        counts: (K,) points of each class in the training data.

    Returns:
        (K,) float32; classes rarer than `FREQUENCY_FLOOR`, or absent, weigh as one at the floor.
    """
    frequency = np.maximum(counts / max(counts.sum(), 1), FREQUENCY_FLOOR)
    weights = 1 / np.sqrt(frequency)
    return (weights / weights.mean()).astype(np.float32)


def range_view_loss(
    logits: Tensor, labels: Tensor, weights: Tensor | None, region: float
) -> Tensor:
    """Cross-entropy + Dice, the loss of the range-view network (section 3.1 of the paper).

    Args:
        logits: (P, K) scores before softmax.
        labels: (P,) train ids, 0 = ignored.
        weights: (K,) weights of the classes in cross-entropy, or None.
        region: weight of Dice beside cross-entropy.
    """
    return _loss(logits, labels, weights, region, dice)


def polar_view_loss(
    logits: Tensor, labels: Tensor, weights: Tensor | None, region: float
) -> Tensor:
    """Cross-entropy + Lovász-softmax, the loss of PolarNet; arguments as of `range_view_loss`."""
    return _loss(logits, labels, weights, region, lovasz_softmax)


def dice(probabilities: Tensor, target: Tensor) -> Tensor:
    """1 - the mean over the classes present of 2 |p t| / (|p| + |t|), soft. (P, K), (P,) -> ()."""
    truth = F.one_hot(target, probabilities.shape[1]).to(probabilities.dtype)
    overlap = (probabilities * truth).sum(dim=0)
    present = truth.sum(dim=0) > 0
    score = 2 * overlap / (probabilities.sum(dim=0) + truth.sum(dim=0)).clamp_min(1e-6)
    return 1 - score[present].mean()


def lovasz_softmax(probabilities: Tensor, target: Tensor) -> Tensor:
    """The Lovász extension of the Jaccard loss, mean over the classes present (Berman et al., CVPR 2018).

    For each class the errors |t - p| are sorted, largest first; the loss is their sum weighted by how much
    each one, added to the set of errors, lowers the Jaccard index. The errors below `SMALL` come last and
    add less than that in all: they are left out, which spares most of the sorting. (P, K), (P,) -> ().
    """
    losses = []
    for c in target.unique():
        truth = (target == c).to(probabilities.dtype)
        errors = (truth - probabilities[:, c]).abs()
        kept = (errors > SMALL).nonzero()[:, 0]
        errors, order = errors[kept].sort(descending=True)
        losses.append(errors @ _jaccard_steps(truth[kept][order], truth.sum()))
    return torch.stack(losses).mean()


def _jaccard_steps(truth: Tensor, total: Tensor) -> Tensor:
    """What each further error adds to the Jaccard loss.

    Args:
        truth: (M,) in the order of the errors.
        total: () points of the class, with those whose error is small.
    """
    intersection = total - truth.cumsum(0)
    union = total + (1 - truth).cumsum(0)
    loss = 1 - intersection / union
    return torch.cat([loss[:1], loss[1:] - loss[:-1]])


def _loss(
    logits: Tensor,
    labels: Tensor,
    weights: Tensor | None,
    region: float,
    region_loss: Callable[[Tensor, Tensor], Tensor],
) -> Tensor:
    """Weighted cross-entropy + region loss over the labelled points; 0 where there is none."""
    kept = labels > 0
    if not kept.any():
        return logits.sum() * 0
    logits, target = at_least_float(logits[kept]), labels[kept].long() - 1
    return F.cross_entropy(logits, target, weights) + region * region_loss(
        logits.softmax(dim=1), target
    )
