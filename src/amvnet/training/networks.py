"""Train the two networks (section 3.1 of the paper)."""

from __future__ import annotations

import copy
from collections.abc import Iterator
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from amvnet.config.schema import NetworkName, NetworkTraining
from amvnet.errors import InputError, counted
from amvnet.evaluation.metrics import confusion
from amvnet.models.amvnet import AMVNet
from amvnet.models.views.points import PointBatch, occurring
from amvnet.models.views.polar_view import PolarGrid, PolarView
from amvnet.models.views.range_view import RangeView
from amvnet.sensors.expectation import Expectation
from amvnet.training import losses
from amvnet.training.checking import Checked
from amvnet.training.loaders import ScanSet, make_loader
from amvnet.training.muon import Muon
from amvnet.training.plan import Plan
from amvnet.training.stage import HALF, MIXED, Loaders, Stage, StageContext, fit
from amvnet.weights.file import Weights

Batch = tuple[PointBatch, Tensor, Tensor]  # points, their (P,) train ids and (P,) sources
# The types in which the networks of a mixed precision compute.
LOWER = {MIXED: torch.bfloat16, HALF: torch.float16}
REGION_LOSSES: dict[str, losses.RegionLoss] = {"dice": losses.dice, "lovasz": losses.lovasz_softmax}


class NetworkStage(Stage):
    """The base class of the stages `rv` and `bev`, which learn from batches of scans.

    A subclass defines `compare` and `score`.

    Args:
        weights: (K,) class weights of the loss, or None for equal weights.
        rivals: (M, K) bool, which classes the points of each dataset count against
            (`rival_classes`), or None for all.
        teacher: the initial network, if its probabilities are to be kept for the classes that a
            dataset lacks (`distillation_loss`).
    """

    config: NetworkTraining
    view: RangeView | PolarView
    default_region_loss: losses.RegionLoss  # the region loss that the paper uses

    def __init__(
        self,
        context: StageContext,
        view: RangeView | PolarView,
        net: nn.Module,
        weights: np.ndarray | None = None,
        *,
        rivals: np.ndarray | None = None,
        teacher: nn.Module | None = None,
    ) -> None:
        super().__init__(context)
        # In a tuple, the teacher is not a part of the stage, so that no checkpoint holds it.
        self.teachers = () if teacher is None else (teacher.eval().requires_grad_(False),)
        self.view = view
        self.trained = net
        self.class_weights: Tensor | None
        self.rivals: Tensor | None
        for name, values in (("class_weights", weights), ("rivals", rivals)):
            tensor = None if values is None else torch.from_numpy(values)
            self.register_buffer(name, tensor, persistent=False)
        # The number of batches in the epoch, and the number of batches with a labelled point.
        self.batches = 0
        self.labelled: Tensor | int = 0

    def in_precision(self, net: nn.Module, view: Any) -> Tensor:
        """Return the logits of a network, computed in the precision of the stage.

        As in prediction (`InPrecision`), a lower precision ends with the network: projections,
        probabilities and losses keep the precision of the weights.
        """
        dtype = LOWER.get(self.precision)
        kind = self.device.type
        with torch.autocast(kind, dtype, enabled=dtype is not None, cache_enabled=False):
            logits: Tensor = net(view)
        return logits.to(self.dtype)

    def compare(self, batch: Batch, net: nn.Module | None = None) -> losses.Scored:
        """Return the pixels or voxels that the loss compares with their labels.

        Args:
            net: the network; by default the trained one.
        """
        raise NotImplementedError

    def score(self, batch: PointBatch) -> Tensor:
        """Return scores (P, K) of the P points of some scans, the largest for their class."""
        raise NotImplementedError

    def loss(self, scored: losses.Scored) -> Tensor:
        """Return the mean loss over the scans, so that a batch may be split into parts."""
        region_loss = REGION_LOSSES.get(self.config.region_loss, self.default_region_loss)
        weights = self.class_weights
        return losses.network_loss(scored, weights, self.config.region, region_loss, self.rivals)

    def distillation(self, teacher: nn.Module, batch: Batch, scored: losses.Scored) -> Tensor:
        """Return the `distillation_loss` of a batch."""
        assert self.rivals is not None
        teacher.to(batch[0].points)  # their type and device
        with torch.no_grad():
            expected = self.compare(batch, teacher)
        return losses.distillation_loss(scored, expected.logits, self.rivals)

    def training_step(self, batch: Batch, index: int) -> Tensor:
        points, _, _ = batch
        scored = self.compare(batch)
        loss = self.loss(scored)
        for teacher in self.teachers:
            loss = loss + self.config.distill * self.distillation(teacher, batch, scored)
        self.batches += 1
        self.labelled += (scored.labels > 0).any().int()  # a tensor, so that a GPU need not wait

        self.check_finite(loss, f"at the scans {', '.join(points.names)}")
        self.log("train/loss", loss, prog_bar=True, batch_size=points.count)
        return loss * self.step_factor(points.count, index)

    def check_epoch(self) -> None:
        batches = sum(self.processes.gather(self.batches))
        empty = batches - sum(self.processes.gather(int(self.labelled)))
        self.batches = 0
        self.labelled = 0
        if empty == batches:
            raise InputError(
                f"{self.name}: expected labelled points in the batches of an epoch, found none in "
                f"{counted(batches, 'batch', 'batches')}; weaken the augmentation "
                "(--training.augment.*), or label more points"
            )
        if empty:
            self.report(
                f"{self.name}: {empty} of {batches} batches had no labelled point to learn from"
            )

    def validation_step(self, batch: Batch, index: int) -> None:
        points, labels, _ = batch
        prediction = (self.score(points).argmax(dim=1) + 1).cpu().numpy()
        self.matrix += confusion(labels.cpu().numpy(), prediction, self.taxonomy.size)

    def step_factor(self, count: int, index: int) -> float:
        """Return the factor that makes the gradient of a step the mean over its scans.

        Lightning divides the loss of each part of a batch by the number of parts. The last batch
        of an epoch may have fewer parts, and its last part may have fewer scans.
        """
        parts = self.trainer.accumulate_grad_batches
        loader = self.trainer.train_dataloader
        if loader is None or loader.batch_size is None:
            return 1.0

        batch = parts * loader.batch_size
        before = index // parts * batch  # number of scans in the earlier steps
        in_step = min(batch, len(loader.sampler) - before)
        weight: float = count * parts / in_step
        return weight

    def configure_optimizers(self) -> Any:
        lr, weight_decay = self.config.lr, self.config.weight_decay
        if self.config.optimizer == "muon":
            return self.one_cycle(Muon(self.trained, lr, weight_decay))

        # On a GPU, a fused optimizer takes the whole step in one launch. With it, Lightning cannot
        # clip the scaled gradients of float16.
        is_fused = self.device.type == "cuda" and self.precision != HALF
        parameters = self.trained.parameters()
        adamw = torch.optim.AdamW(parameters, lr, weight_decay=weight_decay, fused=is_fused or None)
        return self.one_cycle(adamw)


class RangeStage(NetworkStage):
    """Stage `rv`. Its loss compares pixels; a pixel has the label of the point that it shows."""

    name = "rv"
    view: RangeView
    default_region_loss = staticmethod(losses.dice)

    def compare(self, batch: Batch, net: nn.Module | None = None) -> losses.Scored:
        points, labels, source = batch
        view = self.view.project(points)
        image = self.in_precision(net or self.trained, view.image)  # (B, K, H, W)
        pixels = image.permute(0, 2, 3, 1).flatten(0, 2)  # (B * H * W, K)

        # Pixels without a point have no label.
        index = (view.nearest >= 0).nonzero()[:, 0]
        shown = view.nearest[index]
        return losses.Scored(
            logits=pixels.index_select(0, index),
            labels=labels[shown],
            scan=index // (len(pixels) // points.count),
            scans=points.count,
            source=source[shown],
        )

    def score(self, batch: PointBatch) -> Tensor:
        view = self.view.project(batch)
        return view.to_points(self.in_precision(self.trained, view.image).softmax(dim=1))


class PolarStage(NetworkStage):
    """Stage `bev`. Its loss compares voxels; a voxel has the most frequent label of its points."""

    name = "bev"
    view: PolarView
    default_region_loss = staticmethod(losses.lovasz_softmax)

    def compare(self, batch: Batch, net: nn.Module | None = None) -> losses.Scored:
        points, labels, source = batch
        view = self.view.project(points)
        logits = self.in_precision(net or self.trained, view)
        return _score_voxels(view, logits, labels, source)

    def score(self, batch: PointBatch) -> Tensor:
        view = self.view.project(batch)
        return view.to_points(self.in_precision(self.trained, view))


def _score_voxels(view: PolarGrid, scores: Tensor, labels: Tensor, source: Tensor) -> losses.Scored:
    """Return the voxels that have points, each with the most frequent label of its points.

    A voxel with points of several datasets has the first of them as its source.

    Args:
        scores: (M, Z * K) logits of the M pillars that have points.
        labels: (P,) train ids.
        source: (P,) index of the dataset of each point.
    """
    scans, radial, angular, vertical = view.shape
    logits = scores.unflatten(1, (vertical, -1)).flatten(0, 1)  # (M * Z, K)
    voxels, (cells,) = occurring(len(logits), view.slot * vertical + view.voxel)
    voxel_logits = logits.index_select(0, voxels)
    classes = logits.shape[1]
    voxel_labels = losses.majority_labels(cells, labels, count=len(voxels), classes=classes)

    scan = view.occupied[voxels // vertical] // (radial * angular)
    voxel_source = source.new_zeros(len(voxels))
    voxel_source.scatter_reduce_(0, cells, source, "amin", include_self=False)
    return losses.Scored(
        logits=voxel_logits, labels=voxel_labels, scan=scan, scans=scans, source=voxel_source
    )


def train_network(plan: Plan, checked: Checked, name: NetworkName, weights: Weights) -> None:
    """Train a network in the stage `rv` or `bev`, and write its weights after each epoch.

    Raises:
        InputError: if the weights do not fit the recipe, a scan is broken, or the memory of the GPU
            is too small.
    """
    config = plan.recipe.training.of(name)
    loaders = make_loaders(plan, config, weights.expects)
    # The class weights of the loss (section 4.2 of the paper).
    power = config.class_weights
    loss_weights = losses.class_weights(checked.class_counts, power) if power else None
    rivals = losses.rival_classes(checked.taught)
    for line in _notes(plan, name, checked.taught, rivals):
        plan.report(line)

    stage = make_stage(plan, name, plan.build(weights), loss_weights, rivals)
    try:
        fit(stage, plan, loaders, weights)
    except torch.OutOfMemoryError:
        raise InputError(
            f"{name}: expected steps that fit into the GPU's memory, found {config.batch} scans in "
            f"{counted(config.accumulate, 'part')}; raise --training.{name}.accumulate to a larger "
            "divisor of the batch"
        ) from None


def _notes(
    plan: Plan, name: NetworkName, taught: np.ndarray, rivals: np.ndarray | None
) -> Iterator[str]:
    """Yield lines about classes that a dataset lacks, and about scans that no epoch uses."""
    config = plan.recipe.training.of(name)
    sources = plan.data.sources

    def listed(row: Any) -> str:
        return ", ".join(plan.data.taxonomy.classes[index] for index in np.flatnonzero(row))

    kept = ", and keep the initial probabilities there (distill)" if config.distill else ""
    for source, row in zip(sources, [] if rivals is None else ~rivals, strict=False):
        if row.any():
            yield (
                f"{name}: {source.dataset.spec} has hardly a point of {listed(row)}; its scans do "
                f"not count against these classes{kept}"
            )
    if config.distill:
        absent = ~taught.any(axis=0)
        if absent.any():
            yield (
                f"{name}: no --data has more than stray points of {listed(absent)}; the network "
                "learns that they do not occur, unless a further --data has them, such as "
                "simulated streets"
            )

    for places, source in zip(plan.data.places, sources, strict=True):
        used = places * config.epochs
        if used < len(source.train) and not source.dataset.simulated_sensor:
            yield (
                f"{name}: {used} of {len(source.train)} scans of {source.dataset.spec} are used in "
                f"{counted(config.epochs, 'epoch')}; --training.others decides how many"
            )


def make_stage(
    plan: Plan,
    name: NetworkName,
    model: AMVNet,
    weights: np.ndarray | None = None,
    rivals: np.ndarray | None = None,
) -> RangeStage | PolarStage:
    """Return the stage `rv` or `bev` of a model.

    Args:
        weights, rivals: as `NetworkStage` takes them.
    """
    context = StageContext.of(plan, name)
    net = model.range_net if name == "rv" else model.polar_net
    # On a CPU, convolutions are faster if channels are last in memory. They follow their kernels.
    if context.device == "cpu":
        net.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
    distils = plan.recipe.training.of(name).distill and rivals is not None
    teacher = copy.deepcopy(net) if distils else None
    if name == "rv":
        return RangeStage(context, model.range_view, net, weights, rivals=rivals, teacher=teacher)
    return PolarStage(context, model.polar_view, net, weights, rivals=rivals, teacher=teacher)


def make_loaders(plan: Plan, config: NetworkTraining, expects: Expectation) -> Loaders:
    """Return the loaders of training batches and of validation batches."""
    training = plan.recipe.training
    shared: dict[str, Any] = {"workers": training.workers, "processes": plan.processes}

    # The number of scans that one process takes at a time.
    batch = config.batch // config.accumulate // plan.processes.size
    train_set = ScanSet(plan.data, expects, training.augment, training.seed)
    train = make_loader(train_set, batch, shuffle=True, **shared)
    if not plan.data.val:
        return train, None
    val_set = ScanSet(plan.data.to_validate(), expects)
    return train, make_loader(val_set, 1, shuffle=False, **shared)
