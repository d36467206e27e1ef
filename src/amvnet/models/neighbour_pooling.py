"""How the point head pools its encoded neighbours: by their maximum (section 3.3), or by attention.

A pooling module takes the uncertain points' own features (U, W) and their neighbours' channels
(U, n, C) before the last ReLU of the shared MLP, and returns (U, C). The order of the neighbours
does not matter.
"""

from __future__ import annotations

from typing import Literal

from torch import Tensor, nn
from torch.nn import functional as F

from amvnet.models.layers import PointLinear

QUERIES = 4  # of each uncertain point: what it may look for among its neighbours


class MaxPooling(nn.Module):
    """The paper's pooling: the maximum of each channel over the neighbours."""

    def forward(self, point: Tensor, rows: Tensor) -> Tensor:
        # ReLU is monotonic: after the maximum it gives the same for a fraction of the work.
        return F.relu(rows.amax(dim=1))


class AttentionPooling(nn.Module):
    """A block of attention (Vaswani et al., 2017) that asks the neighbours what the point needs.

    Each uncertain point has a few queries, computed from its own features: what to look for depends
    on what the two networks disagree about. The answer to a query is a mean of the neighbours,
    weighted by the softmax of their products with it. The neighbours are keys and values as they
    are, because the shared MLP before the pooling can adapt to it.

    Args:
        width: W, values of a point.
        channels: C.
    """

    def __init__(self, width: int, channels: int) -> None:
        super().__init__()
        self.query = PointLinear(width, QUERIES * channels)
        self.answer = nn.Sequential(
            PointLinear(QUERIES * channels, channels), nn.BatchNorm1d(channels), nn.ReLU()
        )

    def forward(self, point: Tensor, rows: Tensor) -> Tensor:
        rows = F.relu(rows)
        queries = self.query(point).unflatten(1, (QUERIES, -1))  # (U, queries, C)
        products = queries @ rows.transpose(1, 2) * rows.shape[2] ** -0.5  # (U, queries, n)
        means = products.softmax(dim=2) @ rows  # (U, queries, C)
        return self.answer(means.flatten(1))


def build_pooling(name: Literal["max", "attention"], width: int, channels: int) -> nn.Module:
    """Return the pooling of this name; the arguments are those of `AttentionPooling`."""
    return AttentionPooling(width, channels) if name == "attention" else MaxPooling()
