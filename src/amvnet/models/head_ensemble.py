"""Ensembles of point heads (the paper's outlook): their probabilities are averaged."""

from __future__ import annotations

from collections.abc import Sequence
from typing import cast

import torch
from torch import Tensor, nn

from amvnet.config.schema import PointHeadConfig
from amvnet.models.point_head import PointHead


class HeadEnsemble(nn.Module):
    """Several point heads that stand for one.

    Its logits are those whose softmax is the mean of the heads' class probabilities.
    """

    def __init__(self, config: PointHeadConfig, classes: int) -> None:
        super().__init__()
        self.config = config
        self.classes = classes
        self.heads = nn.ModuleList(PointHead(config, classes) for _ in range(config.heads))

    def forward(self, point: Tensor, rows: Tensor) -> Tensor:
        return average([head(point, rows) for head in heads_of(self)])

    def score(self, table: Tensor, uncertain: Tensor, near: Tensor) -> Tensor:
        """Return (U, K) logits; the arguments are those of `PointHead.score`."""
        return average([head.score(table, uncertain, near) for head in heads_of(self)])


Head = PointHead | HeadEnsemble


def average(logits: Sequence[Tensor]) -> Tensor:
    """Return logits (U, K) whose softmax is the mean of those of all the logits (U, K) given."""
    return torch.stack(list(logits)).log_softmax(dim=2).logsumexp(dim=0)


def heads_of(head: Head) -> list[PointHead]:
    """Return the heads of an ensemble, or the only one."""
    if isinstance(head, PointHead):
        return [head]
    return cast(list[PointHead], list(head.heads))


def build_head(config: PointHeadConfig, classes: int) -> Head:
    """Return a point head for K `classes`, or an ensemble of them, with random weights."""
    if config.heads > 1:
        return HeadEnsemble(config, classes)
    return PointHead(config, classes)
