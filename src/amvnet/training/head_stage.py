"""The training stage of the point head, as a Lightning module (section 3.3 of the paper)."""

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
from amvnet.weights.file import UNCERTAIN


class HeadStage(Stage):
    """Stage `head`: it learns from scores gathered beforehand, so that the networks stay frozen.

    Args:
        head: the point head.
        train: the points to train with.
        val: the points to validate with, or None for no validation.

    The other arguments are those of `Stage`.
    """

    name = "head"
    unit = "points"
    config: HeadTraining

    def __init__(
        self, head: PointHead, train: HeadPoints, val: HeadPoints | None, **shared: Any
    ) -> None:
        super().__init__(**shared)
        self.trained: PointHead = head
        self.train_points = train
        self.val_points = val

    def size_of(self, batch: HeadBatch) -> int:
        _, _, labels, _ = batch
        return len(labels)

    def training_step(self, batch: HeadBatch, index: int) -> Tensor:
        point, rows, labels, _ = batch
        loss = self._loss(point, rows, labels)

        self.check_finite(loss, "at points of the head")
        self.log("train/loss", loss, prog_bar=True, batch_size=len(labels))
        return loss

    def validation_step(self, batch: HeadBatch, index: int) -> None:
        point, rows, labels, stands_for = batch
        prediction = self.trained(point, rows).argmax(dim=1) + 1

        # Each point counts for as many points of its scan as it stands for.
        size = len(self.matrix)
        cells = (labels * size + prediction).cpu().numpy()
        counts = np.bincount(cells, stands_for.cpu().numpy(), size**2)
        self.matrix += counts.reshape(size, size)

    def whole_matrix(self) -> np.ndarray:
        """Return AMVNet's confusion matrix: the head's, plus the ensemble's of certain points."""
        assert self.val_points is not None
        return super().whole_matrix() + self.val_points.certain

    def on_validation_epoch_end(self) -> None:
        super().on_validation_epoch_end()
        assert self.val_points is not None
        self.log("train/uncertain", self.train_points.uncertain_share)
        self.log(UNCERTAIN, self.val_points.uncertain_share)

    def configure_optimizers(self) -> Any:
        optimizer = torch.optim.SGD(
            self.trained.parameters(),
            lr=self.config.lr,
            momentum=self.config.momentum,
            weight_decay=self.config.weight_decay,
        )
        return self.one_cycle(optimizer, self.config.momentum)

    def _loss(self, point: Tensor, rows: Tensor, labels: Tensor) -> Tensor:
        logits = self.trained(point, rows)
        loss = F.cross_entropy(logits, labels - 1, self.class_weights, reduction="sum")

        # The mean is over the batch of all processes; Lightning averages the processes' gradients.
        total = self.trainer.strategy.reduce(self._weight(labels), reduce_op="sum")
        return loss * self.processes.size / total

    def _weight(self, labels: Tensor) -> Tensor:
        """Return the sum of the points' class weights, in float32."""
        if self.class_weights is None:
            return labels.new_tensor(len(labels)).float()
        return self.class_weights[labels - 1].sum().float()
