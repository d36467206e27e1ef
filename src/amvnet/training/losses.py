"""The losses of the two networks (section 3.1 of the paper); train id 0 is ignored."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional as F

# A rarer class gets the weight of one with this frequency, so that a few points cannot dominate a
# step.
FREQUENCY_FLOOR = 1e-4

RegionLoss = Callable[[Tensor, Tensor], Tensor]  # of probabilities and target, as `dice`

# Lovász-softmax leaves out smaller errors. Together they would add less than this to the loss of a
# class.
MIN_ERROR = 1e-3


def class_weights(counts: np.ndarray) -> np.ndarray:
    """Return the square roots of the inverse class frequencies, scaled to a mean of 1.

    A frequency below `FREQUENCY_FLOOR` is raised to it, also that of an absent class. Section 4.2
    of the paper.

    Args:
        counts: (K,) numbers of points of each class in the training data.

    Returns:
        (K,) float32.
    """
    frequency = np.maximum(counts / max(counts.sum(), 1), FREQUENCY_FLOOR)
    weights = 1 / np.sqrt(frequency)
    return (weights / weights.mean()).astype(np.float32)


def range_view_loss(
    logits: Tensor,
    labels: Tensor,
    weights: Tensor | None,
    region: float,
    region_loss: RegionLoss | None = None,
) -> Tensor:
    """Return cross-entropy + a region loss: in the paper the Dice loss for the range view.

    Args:
        logits: (P, K).
        labels: (P,) train ids; points with 0 are ignored.
        weights: (K,) class weights of the cross-entropy, or None for equal weights.
        region: weight of the region loss; that of the cross-entropy is 1.
        region_loss: `dice` or `lovasz_softmax`; `dice` if None.

    Returns:
        The loss, (), float32, or float64 if the logits are; 0 if all points are ignored.
    """
    return _loss(logits, labels, weights, region, region_loss or dice)


def polar_view_loss(
    logits: Tensor,
    labels: Tensor,
    weights: Tensor | None,
    region: float,
    region_loss: RegionLoss | None = None,
) -> Tensor:
    """Return cross-entropy + a region loss: Lovász-softmax if None, as PolarNet.

    The arguments and the result are as for `range_view_loss`.
    """
    return _loss(logits, labels, weights, region, region_loss or lovasz_softmax)


def majority_labels(cells: Tensor, labels: Tensor, count: int, classes: int) -> Tensor:
    """Return the most frequent train id of the points of each cell.

    Points without a label (id 0) count only if their cell has no others. Of equally frequent ids,
    the lowest is returned.

    Args:
        cells: (P,) int64 cell of each point, 0..count - 1.
        labels: (P,) int64 train ids, 0..classes.
        count: M, the number of cells.
        classes: K.

    Returns:
        (M,) int64; 0 for a cell without points.
    """
    ids = classes + 1
    points = torch.bincount(cells * ids + labels, minlength=count * ids).view(count, ids)

    # The lowest id first among those with equally many points, on any device.
    ranks = torch.arange(classes, 0, -1, device=cells.device)
    order = points[:, 1:] * ids + ranks
    return torch.where(points[:, 1:].any(dim=1), order.argmax(dim=1) + 1, 0)


def dice(probabilities: Tensor, target: Tensor) -> Tensor:
    """Return the soft Dice loss: 1 - the mean of 2 |p t| / (|p| + |t|) over the classes present.

    Args:
        probabilities: (P, K), p.
        target: (P,) class indices in 0..K - 1; t is their one-hot encoding.

    Returns:
        The loss, ().
    """
    truth = F.one_hot(target, probabilities.shape[1]).to(probabilities.dtype)
    present = truth.sum(dim=0) > 0

    overlap = (probabilities * truth).sum(dim=0)
    score = 2 * overlap / (probabilities.sum(dim=0) + truth.sum(dim=0)).clamp_min(1e-6)
    return 1 - score[present].mean()


def lovasz_softmax(probabilities: Tensor, target: Tensor) -> Tensor:
    """Return the Lovász extension of the Jaccard loss, averaged over the classes present.

    For each class the errors |t - p| are sorted, largest first. Each is weighted by the increase of
    the Jaccard loss when its point joins the mispredicted ones (Berman et al., CVPR 2018). Errors
    up to `MIN_ERROR` are left out, which saves most of the sorting.

    Args:
        probabilities: (P, K), p.
        target: (P,) class indices in 0..K - 1; t is 1 for the points of the class, else 0.

    Returns:
        The loss, ().
    """
    losses = []
    for index in target.unique():
        truth = (target == index).to(probabilities.dtype)
        errors = (truth - probabilities[:, index]).abs()

        large = (errors > MIN_ERROR).nonzero()[:, 0]
        errors, order = errors[large].sort(descending=True)
        increases = _jaccard_increases(truth[large][order], truth.sum())
        losses.append(errors @ increases)

    return torch.stack(losses).mean()


def _jaccard_increases(truth: Tensor, total: Tensor) -> Tensor:
    """Return how much the Jaccard loss increases as each point in turn becomes mispredicted.

    Args:
        truth: (M,) 1 for points of the class, 0 for others; sorted by falling error.
        total: () number of all points of the class, including those with a small error.

    Returns:
        (M,).
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
    region_loss: RegionLoss,
) -> Tensor:
    labelled = labels > 0
    if not labelled.any():
        return logits.sum() * 0  # so that backward() finds a graph, with gradients of 0

    logits = at_least_float32(logits[labelled])
    target = labels[labelled].long() - 1
    cross_entropy = F.cross_entropy(logits, target, weights)
    return cross_entropy + region * region_loss(logits.softmax(dim=1), target)


def at_least_float32(x: Tensor) -> Tensor:
    """Return half precision as float32, and float64 as it is."""
    return x.to(torch.promote_types(x.dtype, torch.float32))
