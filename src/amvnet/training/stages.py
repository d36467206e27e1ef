"""The training stages of the two networks, as Lightning modules."""

from __future__ import annotations

import math
from collections.abc import Sequence
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
from amvnet.models.views.points import PointBatch, occurring
from amvnet.models.views.polar_view import PolarGrid, PolarView
from amvnet.models.views.range_view import RangeView
from amvnet.training.losses import (
    RegionLoss,
    dice,
    lovasz_softmax,
    majority_labels,
    polar_view_loss,
    range_view_loss,
)

Batch = tuple[PointBatch, Tensor]  # points, and their (P,) train ids
REGION_LOSSES: dict[str, RegionLoss | None] = {
    "default": None,
    "dice": dice,
    "lovasz": lovasz_softmax,
}
MOMENTUM_CYCLE = 0.1  # the one-cycle schedule lowers the momentum by this much


class Stage(L.LightningModule):
    """The base of all stages: class weights, metrics of the validation, the one-cycle schedule.

    Args:
        config: of this stage.
        taxonomy: the K classes.
        weights: (K,) class weights of the loss, or None for equal weights.
        processes: those that share the training.
    """

    name: str  # the value of --stage
    unit: str  # what a batch consists of
    trained: nn.Module  # the part of the model that this stage trains

    def __init__(
        self,
        config: NetworkTraining | HeadTraining,
        taxonomy: Taxonomy,
        weights: np.ndarray | None,
        processes: Processes = ALONE,
    ) -> None:
        super().__init__()
        self.config = config
        self.taxonomy = taxonomy
        self.processes = processes

        self.class_weights: Tensor | None
        tensor = None if weights is None else torch.from_numpy(weights)
        self.register_buffer("class_weights", tensor, persistent=False)

        self.matrix = self.empty_matrix()

    def size_of(self, batch: Any) -> int:
        """Return how many units a batch has."""
        raise NotImplementedError

    @property
    def compilable(self) -> list[nn.Module]:
        """What --training.compile compiles."""
        return [self.trained]

    def on_after_batch_transfer(self, batch: Any, dataloader_idx: int) -> Any:
        """Convert floating-point values of a batch to the precision of the weights.

        Raises:
            InputError: if the batch is one, because a scan cannot be read.
        """
        if isinstance(batch, InputError):
            raise batch
        return tuple(self._in_precision(values) for values in batch)

    def check_finite(self, loss: Tensor, where: str) -> None:
        """Check a loss before it spoils the weights.

        Raises:
            InputError: if it is infinite or NaN.
        """
        if not torch.isfinite(loss):
            option = f"--training.{self.name}.lr"
            raise InputError(
                f"expected a finite loss, found {loss:g} {where}; lower {option}, or leave them out"
            )

    def count(self, labels: Tensor, prediction: Tensor) -> None:
        """Add points to the confusion matrix of the validation.

        Args:
            labels: (P,) train ids.
            prediction: (P,) predicted train ids.
        """
        self.matrix += self.confusion(labels, prediction)

    def confusion(self, labels: Tensor, prediction: Tensor) -> np.ndarray:
        """Return the (K + 1, K + 1) confusion matrix of points; arguments as for `count`."""
        return confusion(labels.cpu().numpy(), prediction.cpu().numpy(), self.taxonomy.size)

    def whole_matrix(self) -> np.ndarray:
        """Return the (K + 1, K + 1) confusion matrix of the validation, summed over processes."""
        return self.summed(self.matrix)

    def summed(self, counts: np.ndarray) -> np.ndarray:
        """Return the sum of counts over all processes."""
        return np.sum(self.processes.gather(counts), axis=0)

    def on_validation_epoch_start(self) -> None:
        self.matrix = self.empty_matrix()

    def on_validation_epoch_end(self) -> None:
        values = self.log_metrics("val", self.whole_matrix())
        for name, iou in values["iou"].items():
            if iou is not None:
                self.log(f"iou/{name}", iou)

    def log_metrics(self, folder: str, matrix: np.ndarray) -> dict[str, Any]:
        """Log the metrics of a confusion matrix under the names folder/miou and so on.

        Returns:
            What `evaluation.metrics.metrics` returns.
        """
        values = metrics(matrix, self.taxonomy)
        self.log(f"{folder}/miou", values["miou"] or 0.0, prog_bar=folder == "val")
        self.log(f"{folder}/miou_present", values["miou_present"] or 0.0)
        self.log(f"{folder}/acc", values["accuracy"] or 0.0)
        return values

    def one_cycle(self, optimizer: torch.optim.Optimizer, momentum: float = 0.95) -> Any:
        """Return an optimizer with the one-cycle schedule, as Lightning expects it.

        The learning rate rises to its peak and falls again, while the momentum does the opposite.

        Args:
            momentum: highest momentum of SGD, or highest first beta of AdamW.
        """
        # The schedule needs two steps before its peak, more than a very short training has.
        least = math.ceil(2 / self.config.warmup)
        steps = max(int(self.trainer.estimated_stepping_batches), least)

        schedule = torch.optim.lr_scheduler.OneCycleLR(
            optimizer,
            max_lr=self.config.lr,
            total_steps=steps,
            pct_start=self.config.warmup,
            base_momentum=momentum - MOMENTUM_CYCLE,
            max_momentum=momentum,
        )
        return {"optimizer": optimizer, "lr_scheduler": {"scheduler": schedule, "interval": "step"}}

    def empty_matrix(self) -> np.ndarray:
        """Return a (K + 1, K + 1) confusion matrix without counts."""
        ids = self.taxonomy.size + 1
        return np.zeros((ids, ids))

    def _in_precision(self, values: PointBatch | Tensor) -> PointBatch | Tensor:
        if isinstance(values, PointBatch) or values.is_floating_point():
            return values.to(self.dtype)
        return values


class ScanStage(Stage):
    """The base of the stages that learn from batches of scans, by AdamW."""

    unit = "scans"
    config: NetworkTraining

    def size_of(self, batch: Batch) -> int:
        return batch[0].count

    def share_of_step(self, count: int, index: int) -> float:
        """Return the factor that makes the gradient of a step the mean over its scans.

        Lightning divides the loss of each part of a batch by the number of parts. In the last batch
        of an epoch there may be fewer parts, and fewer scans in the last of them.

        Args:
            count: scans of this part.
            index: number of the part in the epoch.
        """
        parts = self.trainer.accumulate_grad_batches
        loader = self.trainer.train_dataloader
        if loader is None or loader.batch_size is None:
            return 1.0

        batch = parts * loader.batch_size
        before = index // parts * batch  # scans of the earlier steps
        in_step = min(batch, len(loader.sampler) - before)
        return count * parts / in_step

    def configure_optimizers(self) -> Any:
        optimizer = torch.optim.AdamW(
            self.trained.parameters(), lr=self.config.lr, weight_decay=self.config.weight_decay
        )
        return self.one_cycle(optimizer)


class NetworkStage(ScanStage):
    """The base of the two networks' stages, which define `logits` and `loss`.

    Args:
        view: projects the points to the input of the network.
        net: the network.

    The other arguments are those of `Stage`.
    """

    config: NetworkTraining
    view: RangeView | PolarView

    def __init__(
        self,
        view: RangeView | PolarView,
        net: nn.Module,
        config: NetworkTraining,
        taxonomy: Taxonomy,
        weights: np.ndarray | None,
        processes: Processes = ALONE,
    ) -> None:
        super().__init__(config, taxonomy, weights, processes)
        self.view = view
        self.trained = net

    def logits(
        self, batch: PointBatch, labels: Tensor
    ) -> tuple[list[Tensor], list[Tensor], Tensor]:
        """Run the network on a batch of B scans.

        Args:
            labels: (P,) train ids.

        Returns:
            The (M, K) logits of each scan that the loss is computed on, the (M,) train ids of each
            scan that belong to them, and the (P, K) logits of all points.
        """
        raise NotImplementedError

    def loss(self, logits: Tensor, labels: Tensor) -> Tensor:
        """Return the loss of one scan, given (M, K) logits and (M,) train ids."""
        raise NotImplementedError

    @property
    def region_loss(self) -> RegionLoss | None:
        """The region loss of the recipe; None for that of the paper."""
        return REGION_LOSSES[self.config.region_loss]

    def mean_loss(self, logits: Sequence[Tensor], labels: Sequence[Tensor]) -> Tensor:
        """Return the mean loss of some scans, given (M, K) logits and (M,) train ids of each."""
        # The mean over scans stays the same if a batch is split, over processes or to save memory.
        losses = []
        for scan_logits, scan_labels in zip(logits, labels, strict=True):
            losses.append(self.loss(scan_logits, scan_labels))
        return torch.stack(losses).mean()

    def training_step(self, batch: Batch, index: int) -> Tensor:
        points, labels = batch
        logits_by_scan, labels_by_scan, _ = self.logits(points, labels)
        loss = self.mean_loss(logits_by_scan, labels_by_scan)

        self.check_finite(loss, f"at the scans {', '.join(points.names)}")
        self.log("train/loss", loss, prog_bar=True, batch_size=points.count)
        return loss * self.share_of_step(points.count, index)

    def validation_step(self, batch: Batch, index: int) -> None:
        points, labels = batch
        _, _, logits = self.logits(points, labels)
        self.count(labels, logits.argmax(dim=1) + 1)


class RangeStage(NetworkStage):
    """Stage `rv`: the loss is over pixels, each with the label of the point that represents it."""

    name = "rv"
    view: RangeView

    def logits(
        self, batch: PointBatch, labels: Tensor
    ) -> tuple[list[Tensor], list[Tensor], Tensor]:
        view = self.view.project(batch)
        image = self.trained(view.image)  # (B, K, H, W)
        pixels = image.permute(0, 2, 3, 1).flatten(0, 2)  # (B * H * W, K)

        # Pixels without a point have no label.
        occupied = view.nearest >= 0
        sizes = occupied.view(batch.count, -1).sum(dim=1).tolist()
        pixel_logits = pixels[occupied].split(sizes)
        pixel_labels = labels[view.nearest[occupied]].split(sizes)
        return list(pixel_logits), list(pixel_labels), pixels[view.pixel]

    def loss(self, logits: Tensor, labels: Tensor) -> Tensor:
        region = self.config.region
        return range_view_loss(logits, labels, self.class_weights, region, self.region_loss)


class PolarStage(NetworkStage):
    """Stage `bev`: the loss is over points, each with the logits of its voxel, or over voxels."""

    name = "bev"
    view: PolarView

    def logits(
        self, batch: PointBatch, labels: Tensor
    ) -> tuple[list[Tensor], list[Tensor], Tensor]:
        view = self.view.project(batch)
        scores = self.trained(view)  # (M, Z * K)
        points = view.to_points(scores)  # (P, K)
        if self.config.loss_over == "voxels":
            voxel_logits, voxel_labels = _split_voxels(view, scores, labels)
            return voxel_logits, voxel_labels, points

        slices = batch.slices()
        point_logits = [points[part] for part in slices]
        point_labels = [labels[part] for part in slices]
        return point_logits, point_labels, points

    def loss(self, logits: Tensor, labels: Tensor) -> Tensor:
        region = self.config.region
        return polar_view_loss(logits, labels, self.class_weights, region, self.region_loss)


def _split_voxels(
    view: PolarGrid, scores: Tensor, labels: Tensor
) -> tuple[list[Tensor], list[Tensor]]:
    """Return the logits and the majority labels of the voxels with points, scan by scan.

    Args:
        view: the grids of B scans.
        scores: (M, Z * K) logits of the pillars with points.
        labels: (P,) train ids.

    Returns:
        B tensors (V, K), and B tensors (V,).
    """
    scans, radial, angular, vertical = view.shape
    logits = scores.unflatten(1, (vertical, -1)).flatten(0, 1)  # (M * Z, K)
    voxels, (cells,) = occurring(len(logits), view.slot * vertical + view.voxel)
    voxel_logits = logits.index_select(0, voxels)
    voxel_labels = majority_labels(cells, labels, len(voxels), logits.shape[1])

    scan = view.occupied[voxels // vertical] // (radial * angular)  # ascending
    sizes = torch.bincount(scan, minlength=scans).tolist()
    return list(voxel_logits.split(sizes)), list(voxel_labels.split(sizes))
