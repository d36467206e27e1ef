"""The losses of the two networks (section 3.1 of the paper); train id 0 is ignored.

The loss of a batch is the mean over its scans. No loop runs over scans or classes: on a GPU its
steps would cost more to launch than to compute.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional as F

# The lowest class frequency that class weights take into account. A rarer class gets the weight of
# a class with this frequency, so that a few points cannot dominate a step.
FREQUENCY_FLOOR = 1e-4

# The smallest error that Lovász-softmax takes into account. All smaller errors together would add
# less than this to the loss of a class.
MIN_ERROR = 1e-3


def class_weights(counts: NDArray[np.number], power: float = 0.5) -> NDArray[np.float32]:
    """Return powers (K,) of the inverse frequencies of the classes, with a mean of 1.

    Frequencies below `FREQUENCY_FLOOR` are raised to it; the frequency of an absent class is 0.
    Section 4.2 of the paper takes the square roots.
    """
    frequency = np.maximum(counts / max(counts.sum(), 1), FREQUENCY_FLOOR)
    weights = frequency**-power
    scaled: NDArray[np.float32] = (weights / weights.mean()).astype(np.float32)
    return scaled


def rival_classes(taught: NDArray[np.bool_]) -> NDArray[np.bool_] | None:
    """Return which classes the points of each dataset count against.

    A dataset without points of a class cannot teach what does not belong to the class. If another
    dataset teaches the class, the points of the first do not count against it: otherwise, the
    networks would learn that the class never occurs with the first dataset's sensor. All points
    count against a class that no dataset teaches.

    Args:
        taught: (M, K) whether each of M datasets has enough points of each class to teach it.

    Returns:
        (M, K) bool, or None if all points count against all classes.
    """
    rivals = taught | ~taught.any(axis=0)
    return None if rivals.all() else rivals


@dataclass(frozen=True)
class Scored:
    """The P points, pixels or voxels of a batch of scans that a loss compares with their labels.

    Attributes:
        logits: (P, K).
        labels: (P,) train ids; 0 is ignored.
        scan: (P,) index of the scan in the batch, 0..scans - 1.
        scans: B, the number of scans.
        source: (P,) index of the dataset, or None if it is not needed.
    """

    logits: Tensor
    labels: Tensor
    scan: Tensor
    scans: int
    source: Tensor | None = None


@dataclass(frozen=True)
class Targets:
    """The labels that a region loss compares with probabilities (P, K).

    Attributes:
        classes: (P,) index of the class of each point, 0..K - 1.
        scan: (P,) index of the scan of each point, 0..B - 1.
        counts: (B, K) number of points of each class in each scan.
    """

    classes: Tensor
    scan: Tensor
    counts: Tensor

    @classmethod
    def of(cls, classes: Tensor, scan: Tensor, shape: tuple[int, int]) -> Targets:
        """Return the targets of B scans and K classes, where `shape` is (B, K)."""
        scans, class_count = shape
        counts = classes.new_zeros(scans * class_count)
        counts.scatter_add_(0, scan * class_count + classes, torch.ones_like(classes))
        return cls(classes, scan, counts.view(shape))

    def shares(self, dtype: torch.dtype) -> Tensor:
        """Return the (B, K) share of each class of each scan in the loss of the batch.

        The loss of the batch is the mean over its scans, and the loss of a scan is the mean over
        its classes. A class that is absent from a scan has the share 0. The loss of a scan without
        points is 0.
        """
        present = (self.counts > 0).to(dtype)
        return present / (present.sum(dim=1, keepdim=True).clamp_min(1) * len(present))


RegionLoss = Callable[[Tensor, Targets], Tensor]  # takes (P, K) probabilities, returns a scalar


def network_loss(
    scored: Scored,
    weights: Tensor | None,
    region: float,
    region_loss: RegionLoss,
    rivals: Tensor | None = None,
) -> Tensor:
    """Return the mean over scans of cross-entropy + a region loss.

    Args:
        scored: the points, pixels or voxels. Entries with label 0 are ignored.
        weights: (K,) class weights of the cross-entropy, or None for equal weights.
        region: weight of the region loss. The weight of the cross-entropy is 1.
        region_loss: `dice` or `lovasz_softmax`.
        rivals: (M, K) bool, which classes the points of each of M datasets count against besides
            their own class; None for all classes. `scored` must have sources then.

    Returns:
        The loss: a scalar of the logits' type. The loss of a scan without labels is 0.
    """
    labelled = (scored.labels > 0).nonzero()[:, 0]
    logits = scored.logits.index_select(0, labelled)
    classes = scored.labels.index_select(0, labelled).long() - 1
    scan = scored.scan.index_select(0, labelled)
    if rivals is not None:
        assert scored.source is not None
        competes = rivals[scored.source.index_select(0, labelled)]
        competes = competes.scatter(1, classes[:, None], True)
        logits = logits.masked_fill(~competes, -torch.inf)
    targets = Targets.of(classes, scan, (scored.scans, logits.shape[1]))

    # The share of a point in the loss of its scan is proportional to the weight of its class.
    weighted_counts = targets.counts.to(logits) if weights is None else targets.counts * weights
    weight_of_class = logits.new_ones(logits.shape[1]) if weights is None else weights.to(logits)
    totals = weighted_counts.sum(dim=1).clamp_min(torch.finfo(logits.dtype).tiny)
    shares = weight_of_class[classes] / (totals[scan] * scored.scans)
    cross_entropy = (F.cross_entropy(logits, classes, reduction="none") * shares).sum()
    return cross_entropy + region * region_loss(logits.softmax(dim=1), targets)


def distillation_loss(scored: Scored, teacher: Tensor, rivals: Tensor) -> Tensor:
    """Return the mean over scans of the loss that keeps the classes that a dataset lacks.

    The points of such a dataset do not count against these classes (`rival_classes`), but they
    raise the scores of all others. This loss is the cross-entropy between the probabilities of the
    teacher and of the network for the classes that are left out and, as one class, all others. It
    follows learning without forgetting (Li and Hoiem, 2016).

    Args:
        teacher: (P, K) logits of the initial network for the same points.

    Returns:
        The loss: a scalar. The loss of a scan without points of such a dataset is 0.
    """
    assert scored.source is not None
    classes = (scored.labels - 1).clamp_min(0)[:, None]
    competes = rivals[scored.source]
    learns = (scored.labels > 0) & ~competes.all(dim=1) & competes.gather(1, classes)[:, 0]
    index = learns.nonzero()[:, 0]
    others = competes.index_select(0, index)  # (N, K) bool, the classes that are not left out
    scan = scored.scan.index_select(0, index)

    log = scored.logits.index_select(0, index).log_softmax(dim=1)
    target = teacher.index_select(0, index).softmax(dim=1)
    log_of_others = log.masked_fill(~others, -torch.inf).logsumexp(dim=1)
    losses = -(target * log).masked_fill(others, 0).sum(dim=1)
    losses = losses - target.masked_fill(~others, 0).sum(dim=1) * log_of_others

    counts = torch.bincount(scan, minlength=scored.scans)
    return (losses / (counts[scan] * scored.scans)).sum()


def majority_labels(cells: Tensor, labels: Tensor, count: int, classes: int) -> Tensor:
    """Return the most frequent train id of the points in each of `count` cells; 0 without labels.

    Points without a label (id 0) count only if their cell has no others. If ids are equally
    frequent, the lowest one is returned.
    """
    ids = classes + 1
    points = torch.bincount(cells * ids + labels, minlength=count * ids).view(count, ids)

    # Ranks make the lowest of equally frequent ids win on any device.
    ranks = torch.arange(classes, 0, -1, device=cells.device)
    order = points[:, 1:] * ids + ranks
    return torch.where(points[:, 1:].any(dim=1), order.argmax(dim=1) + 1, 0)


def dice(probabilities: Tensor, targets: Targets) -> Tensor:
    """Return the soft Dice loss: 1 - 2 |p t| / (|p| + |t|), averaged over the classes present.

    p are the probabilities (P, K), and t is the one-hot encoding of the labels. The result is the
    mean over the scans.
    """
    truth = F.one_hot(targets.classes, probabilities.shape[1]).to(probabilities)
    members = F.one_hot(targets.scan, len(targets.counts)).to(probabilities).T  # (B, P)

    overlap = members @ (probabilities * truth)  # (B, K)
    size = members @ probabilities + targets.counts
    losses = 1 - 2 * overlap / size.clamp_min(1e-6)
    return (losses * targets.shares(losses.dtype)).sum()


def lovasz_softmax(probabilities: Tensor, targets: Targets) -> Tensor:
    """Return the Lovász extension of the Jaccard loss: the mean over the classes present and scans.

    For each class, the errors |t - p| are sorted, largest first, where t is 1 for the points of the
    class, else 0. Each error is weighted by the increase of the Jaccard loss when its point joins
    the mispredicted points (Berman et al., CVPR 2018). Errors up to `MIN_ERROR` are left out, which
    saves most of the sorting.
    """
    classes = probabilities.shape[1]
    with torch.no_grad():  # the order and the increases have no gradient
        truth = F.one_hot(targets.classes, classes).bool()
        errors = torch.where(truth, 1 - probabilities, probabilities)
        is_large = (errors > MIN_ERROR) & (targets.counts > 0)[targets.scan]
        index = is_large.flatten().nonzero()[:, 0]  # (M,) indices into the flattened errors

        # A group holds the errors of one class in one scan.
        point = index // classes
        group = targets.scan[point] * classes + index % classes
        order = _order(group, errors.flatten()[index])
        index = index[order]
        group = group[order]
        is_true = truth.flatten()[index]

        increases = _jaccard_increases(is_true, group, targets.counts.flatten())
        increases = increases * targets.shares(probabilities.dtype).flatten()[group]
        sign = 1 - 2 * is_true.to(probabilities)

    large = probabilities.flatten().index_select(0, index)
    return ((is_true + sign * large) * increases).sum()


def _order(group: Tensor, errors: Tensor) -> Tensor:
    # Floats of at least 0 have the order of their bits, so one sort of whole numbers sorts by both.
    bits = errors.to(torch.float32).view(torch.int32).long()
    return (group * 2**32 - bits).argsort()


def _jaccard_increases(is_true: Tensor, group: Tensor, counts: Tensor) -> Tensor:
    """Return how much the Jaccard loss increases as each point in turn becomes mispredicted.

    Args:
        is_true: (M,) bool: whether the point has the class of its group. The points are sorted by
            group, and by decreasing error within a group.
        group: (M,) group of each point, ascending.
        counts: (G,) number of points that have the class of each group, including points with a
            small error.

    Returns:
        (M,) float32.
    """
    sizes = torch.zeros_like(counts).scatter_add_(0, group, torch.ones_like(group))
    before = sizes.cumsum(0) - sizes  # number of points before each group
    true = is_true.cumsum(0)  # whole numbers, which stay exact
    true_before = F.pad(true, (1, 0))[before]

    # Counts within the group, up to each point.
    place = torch.arange(1, len(group) + 1, device=group.device) - before[group]
    missed = true - true_before[group]
    total = counts[group]
    loss = 1 - (total - missed).float() / (total + place - missed)
    return loss - F.pad(loss, (1, 0))[:-1].where(place > 1, 0)
