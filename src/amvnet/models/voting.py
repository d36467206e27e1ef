"""Label points by a vote of their neighbours in the range image (RangeNet++, Milioto et al. 2019).

A pixel has one label, which suits its nearest point. But there may be points behind that point in
the same pixel. The vote gives them the labels of points at their own distance.
"""

from __future__ import annotations

import torch
from torch import Tensor

from amvnet.models.views.points import PointBatch
from amvnet.models.views.range_view import WINDOW, RangeImage

# With `WINDOW`, these are the numbers of RangeNet++.
NEIGHBOURS = 5  # number of points that vote on a point's label, including the point itself
SIGMA = 1.0  # standard deviation of the Gaussian over the window, pixels
CUTOFF = 1.0  # largest weighted difference of range with which a point votes, metres


def vote(f: Tensor, batch: PointBatch, image: RangeImage) -> Tensor:
    """Return the share of each class in the votes on each point: (P, K).

    The candidates are the point itself and the nearest point of each other pixel in the window
    (`RangeImage.windows`). The `NEIGHBOURS` candidates whose range differs least, weighted by
    `window_weights`, vote. If two classes have equally many votes, the class with the nearest voter
    has the larger share.

    Args:
        f: (P, K) class probabilities of the points by the range view's network.
    """
    distance = batch.points[:, :3].norm(dim=1)
    pixels, is_outside = image.windows(image.pixel)
    own = WINDOW**2 // 2  # the place of the point itself in its window

    # The differences of range between each point and the points of its window, (P, S * S).
    ranges = torch.where(image.nearest < 0, torch.inf, distance[image.nearest])
    difference = (ranges[pixels] - distance[:, None]).abs_().mul_(window_weights().to(distance))
    difference[is_outside] = torch.inf
    difference[:, own] = 0
    difference, place = difference.topk(NEIGHBOURS, largest=False)  # (P, n), ascending

    voter = image.nearest[pixels.gather(1, place)]
    itself = torch.arange(len(f), device=f.device)[:, None]
    ballots = f.argmax(dim=1)[torch.where(place == own, itself, voter)]

    # Nearer voters count a little more, so that there are no ties. All these extra weights together
    # are less than one vote.
    rank = torch.arange(1, NEIGHBOURS + 1, device=f.device)
    weights = (difference <= CUTOFF) * (1 + 0.5**rank)
    votes = torch.zeros_like(f).scatter_add_(1, ballots, weights.to(f))
    return votes / votes.sum(dim=1, keepdim=True)


def window_weights() -> Tensor:
    """Return the weights (S * S,) of the window's pixels: 1 minus a Gaussian that sums to 1."""
    offsets = torch.arange(WINDOW) - WINDOW // 2
    squares = offsets[:, None] ** 2 + offsets**2
    gaussian = torch.exp(-squares / (2 * SIGMA**2))
    return 1 - (gaussian / gaussian.sum()).flatten()
