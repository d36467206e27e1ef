"""Train the point head (section 3.3 of the paper)."""

from __future__ import annotations

import shutil
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional as F
from torch.utils.data import DataLoader

from amvnet.config.schema import NETWORK_STAGES, PART_OF, HeadTraining
from amvnet.errors import InputError
from amvnet.evaluation.metrics import metrics
from amvnet.models.point_head import PointHead
from amvnet.training.head_points import HeadBatch, HeadPoints, PointGatherer, PointSampler
from amvnet.training.plan import Plan
from amvnet.training.stage import Loaders, Stage, StageContext, fit
from amvnet.weights.file import UNCERTAIN, Weights

VAL_FACTOR = 64  # size of a validation batch, in training batches


class HeadStage(Stage):
    """Stage `head`. It learns from scores that were gathered beforehand by frozen networks.

    Without `val`, nothing is validated.
    """

    name = "head"
    config: HeadTraining

    def __init__(
        self, context: StageContext, head: PointHead, train: HeadPoints, val: HeadPoints | None
    ) -> None:
        super().__init__(context)
        self.trained: PointHead = head
        self.train_points = train
        self.val_points = val

    def training_step(self, batch: HeadBatch, index: int) -> Tensor:
        point, rows, labels, _ = batch
        total_loss = F.cross_entropy(self.trained(point, rows), labels - 1, reduction="sum")

        # Lightning averages the gradients of all processes. The factor makes the loss the mean over
        # the whole batch.
        count = labels.new_tensor(len(labels)).float()
        total_count = self.trainer.strategy.reduce(count, reduce_op="sum")
        loss = total_loss * self.processes.size / total_count

        self.check_finite(loss, "at points of the head")
        self.log("train/loss", loss, prog_bar=True, batch_size=len(labels))
        return loss

    def validation_step(self, batch: HeadBatch, index: int) -> None:
        point, rows, labels, stands_for = batch
        prediction = self.trained(point, rows).argmax(dim=1) + 1

        # Each point counts as many times as the number of points that it stands for.
        size = len(self.matrix)
        cells = (labels * size + prediction).cpu().numpy()
        counts = np.bincount(cells, stands_for.cpu().numpy(), size**2)
        self.matrix += counts.reshape(size, size)

    def whole_matrix(self) -> NDArray[np.float64]:
        """Return AMVNet's confusion matrix: the head's, plus the ensemble's for certain points."""
        assert self.val_points is not None
        certain: NDArray[np.float64] = self.val_points.certain
        if self.val_points.are_uncertain:
            return super().whole_matrix() + certain
        return certain  # where the networks agree, AMVNet's labels are the ensemble's

    def on_validation_epoch_end(self) -> None:
        super().on_validation_epoch_end()
        assert self.val_points is not None
        if not self.val_points.are_uncertain:  # AMVNet's mIoU says nothing about the head
            self.own_miou = metrics(super().whole_matrix(), self.taxonomy)["miou"] or 0.0
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


def _check_networks(plan: Plan, weights: Weights) -> None:
    """Raise InputError if a network is missing, and say why that of the folder or of `init` is."""
    for stage in NETWORK_STAGES:
        part = PART_OF[stage].name
        if part in weights.parts:
            continue
        why, advice = "", "train it first" if plan.init else "train it first, or give --init"
        if plan.folder.stages[stage].is_begun:
            why = f", whose stage {stage} is not finished"
            advice = f"finish it with --stage {stage} --resume"
        elif plan.init and part not in plan.init.parts:
            why = f", and --init has only {', '.join(plan.init.parts)}"
        elif plan.init:
            why = ", and that of --init has other classes"
        raise InputError(
            f"expected trained networks for the head, found no {part} in {plan.out}{why}; {advice}"
        )


def train_head(plan: Plan, weights: Weights) -> None:
    """Train the point head on scores of frozen networks, and write its weights after each epoch.

    If `weights` have a head, the training begins with it.

    Raises:
        InputError: if a network is missing, or the scans have too few points for the head.
    """
    training = plan.recipe.training
    config = training.head
    folder = plan.folder.stages["head"].path

    if plan.scores is None:  # other models have not scored the scans already
        _check_networks(plan, weights)

    # Gather the uncertain points of all scans, with their scores and neighbours.
    gatherer = PointGatherer(plan, weights)
    train = gatherer.gather(
        plan.data, folder / "train", config.views, tau=config.tau, report=plan.report
    )
    val = gatherer.gather(plan.data.to_validate(), folder / "val") if plan.data.val else None

    model = plan.build(weights)
    assert model.point_head is not None
    stage = HeadStage(StageContext.of(plan, "head"), model.point_head, train, val)
    fit(stage, plan, _make_loaders(plan, train, val), weights)

    # Remove the gathered points, which take much space, when no process needs them any more.
    plan.processes.wait()
    if plan.processes.first:
        for name in ("train", "val"):
            shutil.rmtree(folder / name, ignore_errors=True)


def _make_loaders(plan: Plan, train: HeadPoints, val: HeadPoints | None) -> Loaders:
    """Return the loaders of this process's parts of the batches."""
    training = plan.recipe.training
    sampler = PointSampler(train.labels, training.head, training.seed, plan.processes)
    train_loader = _loader(train, sampler)
    if val is None:
        return train_loader, None

    size = VAL_FACTOR * training.head.batch
    batches = []
    for start in range(0, len(val), size):
        stop = min(start + size, len(val))
        batches.append(np.arange(start + plan.processes.rank, stop, plan.processes.size))
    return train_loader, _loader(val, batches)


def _loader(points: HeadPoints, sampler: PointSampler | list[np.ndarray]) -> DataLoader[HeadBatch]:
    return DataLoader(points, batch_size=None, sampler=sampler)  # type: ignore[arg-type]
