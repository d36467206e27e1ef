"""The training of the two networks, as Lightning modules."""

from __future__ import annotations

import math
from typing import Any

import lightning as L
import numpy as np
import torch
from torch import Tensor, nn

from amvnet.config.schema import HeadTraining, NetworkTraining
from amvnet.data.taxonomy import Taxonomy
from amvnet.distributed import ALONE, Processes
from amvnet.errors import InputError
from amvnet.evaluation.metrics import confusion, metrics
from amvnet.models.views.points import PointBatch
from amvnet.models.views.polar_view import PolarView
from amvnet.models.views.range_view import RangeView
from amvnet.training.losses import polar_view_loss, range_view_loss

Batch = tuple[PointBatch, Tensor]
MOMENTUM_CYCLE = 0.1  # by so much the one-cycle schedule lowers the momentum


class Stage(L.LightningModule):
    """What the stages share: class weights, the validation's confusion matrix, the one-cycle schedule."""

    name: str  # as --stage says it
    trained: nn.Module
    unit: str  # what a batch is made of

    def __init__(
        self,
        config: NetworkTraining | HeadTraining,
        taxonomy: Taxonomy,
        weights: np.ndarray | None,
        processes: Processes = ALONE,
    ) -> None:
        super().__init__()
        self.config, self.taxonomy, self.processes = config, taxonomy, processes
        self.class_weights: Tensor | None
        self.register_buffer(
            "class_weights",
            None if weights is None else torch.from_numpy(weights),
            persistent=False,
        )
        self.matrix = self._empty_matrix()

    def _empty_matrix(self) -> np.ndarray:
        return np.zeros((self.taxonomy.size + 1,) * 2)

    def size_of(self, batch: Any) -> int:
        """How many units a batch has."""
        raise NotImplementedError

    def on_after_batch_transfer(self, batch: Any, dataloader_idx: int) -> Any:
        """In the precision of the weights."""
        return tuple(
            x.to(self.dtype) if isinstance(x, PointBatch) or x.is_floating_point() else x
            for x in batch
        )

    def on_validation_epoch_start(self) -> None:
        self.matrix = self._empty_matrix()

    def check_finite(self, loss: Tensor, where: str) -> None:
        """Raises InputError where a loss is not finite, before it has spoiled the weights."""
        if not torch.isfinite(loss):
            rate = f"--training.{self.name}.lr"
            raise InputError(
                f"expected a finite loss, found {loss:g} {where}; lower {rate}, or leave them out"
            )

    def count(self, labels: Tensor, prediction: Tensor) -> None:
        """Add points to the validation's confusion matrix."""
        self.matrix += confusion(labels.cpu().numpy(), prediction.cpu().numpy(), self.taxonomy.size)

    def whole_matrix(self) -> np.ndarray:
        """The validation's confusion matrix over the scans of all processes."""
        return np.sum(self.processes.gather(self.matrix), axis=0)

    def on_validation_epoch_end(self) -> None:
        found = metrics(self.whole_matrix(), self.taxonomy)
        self.log("val/miou", found["miou"] or 0.0, prog_bar=True)
        self.log_dict(
            {"val/miou_present": found["miou_present"] or 0.0, "val/acc": found["accuracy"] or 0.0}
        )
        self.log_dict(
            {f"iou/{name}": value for name, value in found["iou"].items() if value is not None}
        )

    def one_cycle(self, optimizer: torch.optim.Optimizer, momentum: float = 0.95) -> Any:
        """The schedule of the learning rate and, the other way round, of SGD's momentum or AdamW's first beta."""
        # A run of very few steps has no room for the cycle, which needs two before its peak.
        steps = max(int(self.trainer.estimated_stepping_batches), math.ceil(2 / self.config.warmup))
        cycle = torch.optim.lr_scheduler.OneCycleLR(
            optimizer,
            max_lr=self.config.lr,
            total_steps=steps,
            pct_start=self.config.warmup,
            base_momentum=momentum - MOMENTUM_CYCLE,
            max_momentum=momentum,
        )
        return {"optimizer": optimizer, "lr_scheduler": {"scheduler": cycle, "interval": "step"}}


class NetworkStage(Stage):
    """Training of one of the two networks; which one is said by `logits` and the loss."""

    config: NetworkTraining
    unit = "scans"

    def size_of(self, batch: Batch) -> int:
        return batch[0].count

    def logits(
        self, batch: PointBatch, labels: Tensor
    ) -> tuple[list[Tensor], list[Tensor], Tensor]:
        """Of each scan the scores and labels (M, K), (M,) that the loss is over, and scores (P, K) of all points."""
        raise NotImplementedError

    def loss(self, logits: Tensor, labels: Tensor) -> Tensor:
        raise NotImplementedError

    def training_step(self, batch: Batch, index: int) -> Tensor:
        logits, labels, _ = self.logits(*batch)
        # Scan by scan: the same however a batch is split, over processes or into parts that fit into memory.
        loss = torch.stack([self.loss(*scan) for scan in zip(logits, labels, strict=True)]).mean()
        self.check_finite(loss, f"at the scans {', '.join(batch[0].names)}")
        self.log("train/loss", loss, prog_bar=True, batch_size=batch[0].count)
        return loss

    def validation_step(self, batch: Batch, index: int) -> None:
        _, _, points = self.logits(*batch)
        self.count(batch[1], points.argmax(dim=1) + 1)

    def configure_optimizers(self) -> Any:
        c = self.config
        return self.one_cycle(
            torch.optim.AdamW(self.trained.parameters(), lr=c.lr, weight_decay=c.weight_decay)
        )


class RangeStage(NetworkStage):
    """Stage `rv`: the loss is over the pixels, each labelled as the point that represents it."""

    name = "rv"

    def __init__(self, view: RangeView, net: nn.Module, *args: Any) -> None:
        super().__init__(*args)
        self.view, self.trained = view, net

    def logits(
        self, batch: PointBatch, labels: Tensor
    ) -> tuple[list[Tensor], list[Tensor], Tensor]:
        view = self.view.project(batch)
        scores = self.trained(view.image)  # (B, K, H, W)
        seen = view.nearest >= 0
        sizes = seen.view(batch.count, -1).sum(dim=1).tolist()
        pixels = scores.permute(0, 2, 3, 1).flatten(0, 2)
        kept, truth = pixels[seen].split(sizes), labels[view.nearest[seen]].split(sizes)
        return list(kept), list(truth), pixels[view.pixel]

    def loss(self, logits: Tensor, labels: Tensor) -> Tensor:
        return range_view_loss(logits, labels, self.class_weights, self.config.region)


class PolarStage(NetworkStage):
    """Stage `bev`: the loss is over the points, each scored as its voxel."""

    name = "bev"

    def __init__(self, view: PolarView, net: nn.Module, *args: Any) -> None:
        super().__init__(*args)
        self.view, self.trained = view, net

    def logits(
        self, batch: PointBatch, labels: Tensor
    ) -> tuple[list[Tensor], list[Tensor], Tensor]:
        view = self.view.project(batch)
        points = view.to_points(self.trained(view))  # (P, K)
        return [points[s] for s in batch.slices()], [labels[s] for s in batch.slices()], points

    def loss(self, logits: Tensor, labels: Tensor) -> Tensor:
        return polar_view_loss(logits, labels, self.class_weights, self.config.region)
