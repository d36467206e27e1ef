"""AMVNet: two networks look at a scan in two projections; where they disagree, the point head decides."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor, nn

from amvnet.config.schema import ModelConfig
from amvnet.models.assertions import Assertion, build_assertion
from amvnet.models.point_head import PointHead, nearest_neighbours, point_table, select_used_points
from amvnet.models.polar_net import PolarNet
from amvnet.models.range_net import RangeNet
from amvnet.models.streams import Arrangement, in_turn
from amvnet.models.views.points import PointBatch
from amvnet.models.views.polar_view import PolarView
from amvnet.models.views.range_view import RangeView


@dataclass(frozen=True)
class Scores:
    """What AMVNet finds for P points: merged, and f and g of the networks that were asked: (P, K); uncertain: (P,)."""

    merged: Tensor
    uncertain: Tensor
    rv: Tensor | None
    bev: Tensor | None


class AMVNet(nn.Module):
    """The whole method (section 3 of the paper) around parts that are built outside and do not know each other."""

    def __init__(
        self,
        range_view: RangeView,
        polar_view: PolarView,
        range_net: nn.Module,
        polar_net: nn.Module,
        assertion: Assertion,
        point_head: PointHead | None,
    ) -> None:
        super().__init__()
        self.range_view, self.polar_view = range_view, polar_view
        self.range_net, self.polar_net = range_net, polar_net
        self.assertion, self.point_head = assertion, point_head
        self.run: Arrangement = in_turn

    def forward(self, batch: PointBatch) -> Scores:
        f, g = self.run(self.score_range_view, self.score_polar_view, batch)
        uncertain = self.assertion(f, g, batch.points)
        h = self.refine(batch, f, g, uncertain)
        return Scores(merge(f, g, uncertain, h), uncertain, f, g)

    def score_range_view(self, batch: PointBatch) -> Tensor:
        """f: (P, K) class probabilities by the range view."""
        view = self.range_view.project(batch)
        return view.to_points(self.range_net(view.image)).float().softmax(dim=1)

    def score_polar_view(self, batch: PointBatch) -> Tensor:
        """g: (P, K) class probabilities by the bird's-eye view."""
        view = self.polar_view.project(batch)
        return view.to_points(self.polar_net(view)).float().softmax(dim=1)

    def refine(self, batch: PointBatch, f: Tensor, g: Tensor, uncertain: Tensor) -> Tensor | None:
        """h: (U, K) class probabilities of the uncertain points by the point head; None without one."""
        if self.point_head is None:
            return None
        parts = [
            refine(self.point_head, batch.points[s], f[s], g[s], uncertain[s])
            for s in batch.slices()
        ]
        return torch.cat(parts)


def refine(head: PointHead, points: Tensor, f: Tensor, g: Tensor, uncertain: Tensor) -> Tensor:
    """h: (U, K) class probabilities of one scan's uncertain points, from themselves and their neighbours."""
    index = uncertain.nonzero()[:, 0]
    near = nearest_neighbours(points, index, head.config.neighbours)
    return settle(head, points, f, g, index, near)


def settle(
    head: PointHead, points: Tensor, f: Tensor, g: Tensor, index: Tensor, near: Tensor
) -> Tensor:
    """h: (U, K) of the points with these indices (U,), whose neighbours are (U, n)."""
    asked, (index, near) = select_used_points(len(points), index, near)
    table = point_table(*(values.index_select(0, asked) for values in (points, f, g)))
    return head.score(table, index, near).softmax(dim=1)


def merge(f: Tensor, g: Tensor, uncertain: Tensor, h: Tensor | None) -> Tensor:
    """y: the head's scores for the uncertain points, the geometric mean of f and g for the others."""
    y = geometric_mean(f, g)
    if h is None:
        return y
    # The second takes a processor twice the time, the first has it wait for a GPU.
    return y.index_put((uncertain,), h) if y.is_cpu else y.masked_scatter(uncertain[:, None], h)


def geometric_mean(f: Tensor, g: Tensor) -> Tensor:
    """The ensemble that AMVNet rests on; all ensembles take and give (P, K)."""
    return torch.sqrt(f * g)


def arithmetic_mean(f: Tensor, g: Tensor) -> Tensor:
    """An ensemble to compare with."""
    return (f + g) / 2


def maximum(f: Tensor, g: Tensor) -> Tensor:
    """An ensemble to compare with."""
    return torch.maximum(f, g)


ENSEMBLES = {"arithmetic": arithmetic_mean, "maximum": maximum, "ensemble": geometric_mean}


def build_amvnet(config: ModelConfig, classes: int) -> AMVNet:
    """AMVNet with fresh weights, for K classes."""
    return AMVNet(
        RangeView(config.range_view),
        PolarView(config.polar_view),
        RangeNet(config.range_net, classes),
        PolarNet(config.polar_net, config.polar_view.vertical, classes),
        build_assertion(config.assertion),
        PointHead(config.point_head, classes),
    )
