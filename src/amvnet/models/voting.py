"""Labels of the range view by a vote of neighbours in the image (RangeNet++, Milioto et al. 2019).

A pixel has one label, that of its nearest point, but points behind that one are in the pixel too.
The vote gives such points the labels of points at their own distance.
"""

from __future__ import annotations

import torch
from torch import Tensor

from amvnet.models.views.points import PointBatch
from amvnet.models.views.range_view import RangeImage

# RangeNet++'s own numbers.
NEIGHBOURS = 5  # points that vote on a point's label, itself among them
WINDOW = 5  # rows and columns around the point's pixel; odd
SIGMA = 1.0  # of the Gaussian over the window, pixels
CUTOFF = 1.0  # metres; a point whose weighted difference of range is larger does not vote


def vote(f: Tensor, batch: PointBatch, image: RangeImage) -> Tensor:
    """Return each class's share of the votes on each point, (P, K), given f (P, K).

    The points that vote are the point itself and the nearest point of each other pixel of the
    window, which continues at the other end of the image along the azimuth. Those with the least
    difference of range, weighted by `window_weights`, are chosen. If classes have equally many
    votes, the one with the vote of least difference has the larger share.
    """
    distance = batch.points[:, :3].norm(dim=1)
    pixels, is_outside = _windows(image)
    own = WINDOW**2 // 2  # the place of the point itself in its window

    # (P, S * S), between each point and those of its window
    ranges = torch.where(image.nearest < 0, torch.inf, distance[image.nearest])
    difference = (ranges[pixels] - distance[:, None]).abs_().mul_(window_weights().to(distance))
    difference[is_outside] = torch.inf
    difference[:, own] = 0
    difference, place = difference.topk(NEIGHBOURS, largest=False)  # (P, n), ascending

    voter = image.nearest[pixels.gather(1, place)]
    itself = torch.arange(len(f), device=f.device)[:, None]
    ballots = f.argmax(dim=1)[torch.where(place == own, itself, voter)]

    # Each vote counts a little more than one, less than two in total: so ties are decided.
    rank = torch.arange(1, NEIGHBOURS + 1, device=f.device)
    weights = (difference <= CUTOFF) * (1 + 0.5**rank)
    votes = torch.zeros_like(f).scatter_add_(1, ballots, weights.to(f))
    return votes / votes.sum(dim=1, keepdim=True)


def window_weights() -> Tensor:
    """Return (S * S,) weights of the window's pixels: 1 minus a Gaussian whose sum is 1."""
    offsets = torch.arange(WINDOW) - WINDOW // 2
    squares = offsets[:, None] ** 2 + offsets**2
    gaussian = torch.exp(-squares / (2 * SIGMA**2))
    return 1 - (gaussian / gaussian.sum()).flatten()


def _windows(image: RangeImage) -> tuple[Tensor, Tensor]:
    """Return the pixels around each point's pixel, row by row.

    Returns:
        (P, S * S) indices into the B * H * W pixels of the batch; and (P, S * S) bool, the
        pixels that do not count, as they would be above or below the point's image.
    """
    _, _, height, width = image.image.shape
    offsets = torch.arange(WINDOW, device=image.pixel.device) - WINDOW // 2
    rows = (image.pixel // width)[:, None] + offsets  # (P, S), of all images
    columns = ((image.pixel % width)[:, None] + offsets) % width
    is_outside = rows // height != (image.pixel // (width * height))[:, None]

    rows = rows.where(~is_outside, 0)
    pixels = rows[:, :, None] * width + columns[:, None]
    return pixels.flatten(1), is_outside.repeat_interleave(WINDOW, dim=1)
