"""AMVNet: two networks segment a scan in two projections; a point head refines uncertain points."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from typing import Any

from torch import Tensor, nn

from amvnet.config.schema import ModelConfig
from amvnet.models.assertion import Assertion, Disagreement, disputed_points
from amvnet.models.methods import Ensemble, geometric_mean
from amvnet.models.point_head import PointHead, first_in_cubes, nearest_neighbours
from amvnet.models.polar_net import PolarNet
from amvnet.models.range_net import RangeNet
from amvnet.models.views.points import PointBatch, concatenate
from amvnet.models.views.polar_view import PolarGrid, PolarView
from amvnet.models.views.range_view import RangeImage, RangeView

# Takes the name of a step and returns the context in which the step runs.
Watch = Callable[[str], AbstractContextManager[Any]]
Score = Callable[[], Tensor]  # runs one network; returns (P, K)
# Runs the networks of the range view and of the bird's-eye view, and returns f and g.
Arrangement = Callable[[Score, Score], tuple[Tensor, Tensor]]


def one_after_the_other(score_range: Score, score_polar: Score) -> tuple[Tensor, Tensor]:
    """Run the range view's network first, then the bird's-eye view's."""
    return score_range(), score_polar()


@dataclass(frozen=True)
class Scores:
    """Class probabilities of P points.

    Attributes:
        merged: y (P, K), computed by AMVNet or another method.
        uncertain: (P,) bool, the points on which the two networks disagree.
        rv: f (P, K) of the range view's network; None if it did not run.
        bev: g (P, K) of the bird's-eye view's network; None if it did not run.
    """

    merged: Tensor
    uncertain: Tensor
    rv: Tensor | None
    bev: Tensor | None


class LateFusion(nn.Module):
    """The fusion of any two networks' class probabilities (sections 3.2 and 3.3 of the paper).

    Args:
        point_head: classifies the disputed points. If it is None, the ensemble of the two networks
            classifies them.
        lead: decides which of the uncertain points are disputed; see `disputed_points`.

    Attributes:
        ensemble: combines f and g for the certain points, by the geometric mean as in the paper.
        watch: returns the context in which a step runs, to time it; does nothing by default.
    """

    def __init__(
        self, assertion: Assertion, point_head: PointHead | None, lead: float = 0.0
    ) -> None:
        super().__init__()
        self.assertion = assertion
        self.point_head = point_head
        self.lead = lead
        self.ensemble: Ensemble = geometric_mean
        self.watch: Watch = nullcontext

    def fuse(self, batch: PointBatch, f: Tensor, g: Tensor) -> Scores:
        """Return the fusion of f and g: (P, K) class probabilities."""
        uncertain = self.compare(batch, f, g)
        disputed = disputed_points(f, g, uncertain, self.lead)
        h = self.refine(batch, f, g, disputed)
        y = self.merge(f, g, disputed, h)
        return Scores(y, uncertain, f, g)

    def compare(self, batch: PointBatch, f: Tensor, g: Tensor) -> Tensor:
        """Return u: (P,) bool, the uncertain points."""
        with self.watch("compare"):
            return self.assertion(f, g, batch.points)

    def refine(self, batch: PointBatch, f: Tensor, g: Tensor, disputed: Tensor) -> Tensor | None:
        """Return h: (U, K) class probabilities of the disputed points; None without a head."""
        if self.point_head is None:
            return None

        # The neighbours of a point are points of its own scan.
        config = self.point_head.config
        parts = []
        for scan in batch.slices:
            points = batch.points[scan]
            index = disputed[scan].nonzero()[:, 0]
            with self.watch("neighbours"):
                index, cube = first_in_cubes(points, index, config.cell)  # (V,), (U,)
                near = nearest_neighbours(points, index, config.neighbours)
            with self.watch("head"):
                h = self.point_head.classify(points, f[scan], g[scan], index, near)
                parts.append(h.index_select(0, cube))
        return concatenate(parts)

    def merge(self, f: Tensor, g: Tensor, disputed: Tensor, h: Tensor | None) -> Tensor:
        """Return y: (P, K), h for the disputed points and the ensemble for the others."""
        with self.watch("merge"):
            y = self.ensemble(f, g)
            return y if h is None else replace_rows(y, disputed, h)


class AMVNet(LateFusion):
    """The whole method (section 3 of the paper).

    Its parts are built outside and do not know each other.

    Attributes:
        arrange: runs the two networks, by default one after the other.
    """

    def __init__(
        self,
        *,
        range_view: RangeView,
        polar_view: PolarView,
        range_net: nn.Module,
        polar_net: nn.Module,
        assertion: Assertion,
        point_head: PointHead | None,
        lead: float = 0.0,
    ) -> None:
        super().__init__(assertion, point_head, lead)
        self.range_view = range_view
        self.polar_view = polar_view
        self.range_net = range_net
        self.polar_net = polar_net
        self.arrange: Arrangement = one_after_the_other

    def forward(self, batch: PointBatch) -> Scores:
        """Return the class probabilities of the points of a batch of scans."""
        image, grid = self.project(batch)
        f, g = self.score(image, grid)
        return self.fuse(batch, f, g)

    def project(self, batch: PointBatch) -> tuple[RangeImage, PolarGrid]:
        """Return the two projections of a batch of scans."""
        with self.watch("project"):
            return self.range_view.project(batch), self.polar_view.project(batch)

    def score(self, image: RangeImage, grid: PolarGrid) -> tuple[Tensor, Tensor]:
        """Return f and g: (P, K) class probabilities by the two networks."""
        return self.arrange(lambda: self.score_range(image), lambda: self.score_polar(grid))

    def score_range(self, image: RangeImage) -> Tensor:  # (P, K)
        with self.watch("RV"):
            logits = self.range_net(image.image).float().permute(0, 2, 3, 1)  # (B, H, W, K)
            return image.to_points(logits.softmax(dim=3).permute(0, 3, 1, 2))

    def score_polar(self, grid: PolarGrid) -> Tensor:  # (P, K)
        with self.watch("BEV"):
            return grid.to_points(self.polar_net(grid)).float().softmax(dim=1)


def replace_rows(y: Tensor, chosen: Tensor, h: Tensor) -> Tensor:
    """Return y (P, K) with the rows of the U points that are `chosen` (P,) replaced by h (U, K).

    On a CPU, y itself is changed.
    """
    if y.is_cpu:
        return y.index_put_((chosen,), h)

    # On a GPU, `index_put` would make the CPU wait. On a CPU, it is twice as fast as
    # `masked_scatter`.
    return y.masked_scatter(chosen[:, None], h)


def build_amvnet(config: ModelConfig, classes: int) -> AMVNet:
    """Return AMVNet for K `classes`, with random weights."""
    return AMVNet(
        range_view=RangeView(config.range_view),
        polar_view=PolarView(config.polar_view),
        range_net=RangeNet(config.range_net, classes),
        polar_net=PolarNet(config.polar_net, config.polar_view.vertical, classes),
        assertion=Disagreement(config.assertion.threshold),
        point_head=PointHead(config.point_head, classes),
        lead=config.assertion.lead,
    )
