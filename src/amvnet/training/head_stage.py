"""The training of the point head on gathered points, as a Lightning module."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional as F

from amvnet.config.schema import HeadTraining
from amvnet.models.point_head import PointHead
from amvnet.training.head_points import HeadBatch, HeadPoints
from amvnet.training.stages import Stage


class HeadStage(Stage):
    """Stage `head`: the networks are frozen, in that only their scores are here."""

    name = "head"
    unit = "points"
    config: HeadTraining

    def __init__(
        self, head: PointHead, train: HeadPoints, val: HeadPoints | None, *args: Any
    ) -> None:
        super().__init__(*args)
        self.trained, self.learnt, self.val = head, train, val

    def size_of(self, batch: HeadBatch) -> int:
        return len(batch[2])

    def training_step(self, batch: HeadBatch, index: int) -> Tensor:
        point, rows, labels, _ = batch
        loss = F.cross_entropy(
            self.trained(point, rows), labels - 1, self.class_weights, reduction="sum"
        )
        own = (
            labels.new_tensor(len(labels))
            if self.class_weights is None
            else self.class_weights[labels - 1].sum()
        )
        # The mean over the batch of all processes, of which Lightning averages the gradients.
        whole = self.trainer.strategy.reduce(own.float(), reduce_op="sum")
        loss = loss * self.processes.size / whole
        self.check_finite(loss, "at points of the head")
        self.log("train/loss", loss, prog_bar=True, batch_size=len(labels))
        return loss

    def validation_step(self, batch: HeadBatch, index: int) -> None:
        point, rows, labels, stands_for = batch
        found = self.trained(point, rows).argmax(dim=1) + 1
        size = len(self.matrix)
        place = (labels * size + found).cpu().numpy()
        self.matrix += np.bincount(place, stands_for.cpu().numpy(), size**2).reshape(size, size)

    def whole_matrix(self) -> np.ndarray:
        """With the points that are certain, whose classes the ensemble has settled."""
        assert self.val is not None
        return super().whole_matrix() + self.val.certain

    def on_validation_epoch_end(self) -> None:
        super().on_validation_epoch_end()
        assert self.val is not None
        self.log_dict(
            {"train/uncertain": self.learnt.uncertain, "val/uncertain": self.val.uncertain}
        )

    def configure_optimizers(self) -> Any:
        c = self.config
        parameters = self.trained.parameters()
        return self.one_cycle(
            torch.optim.SGD(parameters, c.lr, c.momentum, weight_decay=c.weight_decay), c.momentum
        )
