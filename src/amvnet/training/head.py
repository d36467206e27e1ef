"""The training of the point head (section 3.3 of the paper)."""

from __future__ import annotations

import shutil
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional as F
from torch.utils.data import DataLoader

from amvnet.config.schema import HeadTraining
from amvnet.errors import InputError
from amvnet.models.methods import BOTH_NETWORKS
from amvnet.models.point_head import PointHead
from amvnet.sensors.intensity import trained_intensity
from amvnet.training.callbacks import KeepWeights
from amvnet.training.head_points import (
    HeadBatch,
    HeadPoints,
    PointDraw,
    PointGatherer,
    PointSampler,
)
from amvnet.training.plan import Plan
from amvnet.training.stage import Loaders, Stage, class_weights_of, fit
from amvnet.weights.file import UNCERTAIN, Weights

VAL_FACTOR = 64  # a validation batch is as large as this many training batches


class HeadStage(Stage):
    """Stage `head`: it learns from scores gathered beforehand, so that the networks stay frozen.

    Args:
        head: the point head.
        train: the points to train with.
        val: the points to validate with, or None for no validation.

    The other arguments are those of `Stage`.
    """

    name = "head"
    in_float32 = True  # it multiplies so little that a lower precision would save nothing
    config: HeadTraining

    def __init__(
        self, head: PointHead, train: HeadPoints, val: HeadPoints | None, **shared: Any
    ) -> None:
        super().__init__(**shared)
        self.trained: PointHead = head
        self.train_points = train
        self.val_points = val

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


def train_head(plan: Plan, weights: Weights) -> None:
    """Train the point head on scores of frozen networks, and write its weights after each epoch.

    Raises:
        InputError: if a network is missing, or the scans have too few points for the head.
    """
    training = plan.recipe.training
    config = training.head
    folder = plan.out / "head"

    # Gather the uncertain points of all scans, with their scores and neighbours. Other models'
    # scores are of the scans as they are.
    for part in BOTH_NETWORKS if plan.scores is None else ():
        if part not in weights.parts:
            raise InputError(
                f"expected trained networks for the head, found no {part}; train it, or give --init"
            )
    intensity = None
    if plan.scores is None:
        intensity = trained_intensity(weights.training, weights.sensor)
    gatherer = PointGatherer(plan, weights, intensity)
    train = gatherer.gather(plan.scans.train, folder / "train", config.views, plan.say)
    val = gatherer.gather(plan.scans.val, folder / "val") if plan.scans.val else None

    model = plan.build(weights)
    assert model.point_head is not None
    stage = HeadStage(
        model.point_head,
        train,
        val,
        config=config,
        taxonomy=plan.scans.dataset.taxonomy,
        weights=class_weights_of(plan) if config.class_weights else None,
        processes=plan.processes,
    )
    keep_weights = KeepWeights(plan, "head", weights, intensity)
    fit(stage, plan, _make_loaders(plan, train, val), keep_weights)

    # The gathered points take much space, and no process needs them any more.
    plan.processes.wait()
    if plan.processes.first:
        for name in ("train", "val"):
            shutil.rmtree(folder / name, ignore_errors=True)


def _make_loaders(plan: Plan, train: HeadPoints, val: HeadPoints | None) -> Loaders:
    config = plan.recipe.training.head
    seed = plan.recipe.training.seed
    labels = train.labels if config.balance else None
    draw = PointDraw(len(train), config.drawn, labels, config.balance)
    train_loader = _loader(
        train, PointSampler(draw, config.batch, seed, shuffle=True, processes=plan.processes)
    )
    if val is None:
        return train_loader, None

    batch = VAL_FACTOR * config.batch
    points = PointDraw(len(val))
    sampler = PointSampler(points, batch, seed, shuffle=False, processes=plan.processes)
    return train_loader, _loader(val, sampler)


def _loader(points: HeadPoints, sampler: PointSampler) -> DataLoader[HeadBatch]:
    """Return a loader of this process's parts of the batches."""
    return DataLoader(points, batch_size=None, sampler=sampler)  # type: ignore[arg-type]
