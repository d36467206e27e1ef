"""The training of the two networks, as Lightning modules."""

from __future__ import annotations

import math
import pickle
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import lightning as L
import numpy as np
import torch
from lightning.pytorch.callbacks import Callback, LearningRateMonitor, ModelCheckpoint, RichProgressBar
from lightning.pytorch.loggers import TensorBoardLogger
from torch import Tensor, nn
from torch.utils.data import DataLoader

from amvnet.callbacks import Curves, EpochLines, KeepWeights, SeedBatches
from amvnet.config import HeadTraining, NetworkTraining, TrainingConfig
from amvnet.data.labels import Taxonomy
from amvnet.errors import InputError
from amvnet.evaluation import confusion, metrics
from amvnet.losses import polar_view_loss, range_view_loss
from amvnet.views.points import PointBatch
from amvnet.views.polar_view import PolarView
from amvnet.views.range_view import RangeView

Batch = tuple[PointBatch, Tensor]
MOMENTUM_CYCLE = 0.1  # by so much the one-cycle schedule lowers the momentum
LAST = "last.ckpt"  # what --resume goes on from


class Stage(L.LightningModule):
    """What the stages share: class weights, the validation's confusion matrix, the one-cycle schedule."""

    name: str  # as --stage says it
    trained: nn.Module

    def __init__(self, config: NetworkTraining | HeadTraining, taxonomy: Taxonomy, weights: np.ndarray | None) -> None:
        super().__init__()
        self.config, self.taxonomy = config, taxonomy
        self.class_weights: Tensor | None
        self.register_buffer("class_weights", None if weights is None else torch.from_numpy(weights), persistent=False)
        self.matrix = self._empty_matrix()

    def _empty_matrix(self) -> np.ndarray:
        return np.zeros((self.taxonomy.size + 1,) * 2)

    def on_validation_epoch_start(self) -> None:
        self.matrix = self._empty_matrix()

    def count(self, labels: Tensor, prediction: Tensor) -> None:
        """Add points to the validation's confusion matrix."""
        self.matrix += confusion(labels.cpu().numpy(), prediction.cpu().numpy(), self.taxonomy.size)

    def on_validation_epoch_end(self) -> None:
        found = metrics(self.matrix, self.taxonomy)
        values = {"val/miou": found["miou"], "val/miou_present": found["miou_present"], "val/acc": found["accuracy"]}
        self.log_dict({k: v or 0.0 for k, v in values.items()})
        self.log_dict({f"iou/{name}": value for name, value in found["iou"].items() if value is not None})

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

    def logits(self, batch: PointBatch, labels: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Scores and labels (M, K), (M,) of what the loss is over, and scores (P, K) of the points."""
        raise NotImplementedError

    def loss(self, logits: Tensor, labels: Tensor) -> Tensor:
        raise NotImplementedError

    def training_step(self, batch: Batch, index: int) -> Tensor:
        logits, labels, _ = self.logits(*batch)
        loss = self.loss(logits, labels)
        if not torch.isfinite(loss):
            names, rate = ", ".join(batch[0].names), f"--training.{self.name}.lr"
            raise InputError(
                f"expected a finite loss, found {loss:g} at the scans {names}; lower {rate}, or leave them out"
            )
        self.log("train/loss", loss, prog_bar=True, batch_size=batch[0].count)
        return loss

    def validation_step(self, batch: Batch, index: int) -> None:
        _, _, points = self.logits(*batch)
        self.count(batch[1], points.argmax(dim=1) + 1)

    def configure_optimizers(self) -> Any:
        c = self.config
        return self.one_cycle(torch.optim.AdamW(self.trained.parameters(), lr=c.lr, weight_decay=c.weight_decay))


class RangeStage(NetworkStage):
    """Stage `rv`: the loss is over the pixels, each labelled as the point that represents it."""

    name = "rv"

    def __init__(self, view: RangeView, net: nn.Module, *args: Any) -> None:
        super().__init__(*args)
        self.view, self.trained = view, net

    def logits(self, batch: PointBatch, labels: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        view = self.view.project(batch)
        scores = self.trained(view.image)  # (B, K, H, W)
        seen = view.nearest >= 0
        pixels = scores.permute(0, 2, 3, 1).flatten(0, 2)
        return pixels[seen], labels[view.nearest[seen]], pixels[view.pixel]

    def loss(self, logits: Tensor, labels: Tensor) -> Tensor:
        return range_view_loss(logits, labels, self.class_weights, self.config.region)


class PolarStage(NetworkStage):
    """Stage `bev`: the loss is over the points, each scored as its voxel."""

    name = "bev"

    def __init__(self, view: PolarView, net: nn.Module, *args: Any) -> None:
        super().__init__(*args)
        self.view, self.trained = view, net

    def logits(self, batch: PointBatch, labels: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        view = self.view.project(batch)
        points = view.to_points(self.trained(view))  # (P, K)
        return points, labels, points

    def loss(self, logits: Tensor, labels: Tensor) -> Tensor:
        return polar_view_loss(logits, labels, self.class_weights, self.config.region)


def fit(
    stage: Stage,
    config: TrainingConfig,
    epochs: int,
    train: DataLoader[Any],
    val: DataLoader[Any],
    folder: Path,
    keep: KeepWeights,
    resume: bool,
    say: Callable[[str], None],
    bars: bool,
    batches: int = 1,
    clip: float | None = None,
) -> None:
    """Train a stage in its folder; with `resume`, on from its last epoch.

    Args:
        say: told one line an epoch.
        bars: show a progress bar instead.
        batches: parts of a batch that are accumulated before a step.
        clip: largest norm of the gradient.
    """
    shown: list[Callback] = [RichProgressBar() if bars else EpochLines(say, folder.name), LearningRateMonitor()]
    # Weights and curves are kept before the checkpoint is, so that a checkpoint never says more than they hold.
    kept: list[Callback] = [keep, Curves(folder / "metrics.csv"), SeedBatches(config.seed)]
    trainer = L.Trainer(
        accelerator=_accelerator(config.accelerator),
        devices=1,
        precision=config.precision,
        max_epochs=epochs,
        accumulate_grad_batches=batches,
        gradient_clip_val=clip,
        default_root_dir=folder,
        callbacks=[*kept, ModelCheckpoint(folder, filename="last", enable_version_counter=False), *shown],
        logger=TensorBoardLogger(folder, name="", version=""),
        enable_progress_bar=bars,
        enable_model_summary=False,
        num_sanity_val_steps=0,
        log_every_n_steps=10,
        use_distributed_sampler=False,
    )
    checkpoint = folder / LAST
    begun = checkpoint if resume and checkpoint.is_file() else None
    if begun is not None:
        # Lightning tells the sampler its epoch only after the reading processes have begun to draw.
        train.sampler.set_epoch(_epochs_done(begun))  # type: ignore[attr-defined]
    try:
        trainer.fit(stage, train, val, ckpt_path=begun, weights_only=begun is not None)
    except InputError as error:  # from a reading process it comes with that process's traceback
        raise InputError(str(error).splitlines()[-1].removeprefix(f"{InputError.__module__}.InputError: ")) from None


def _accelerator(name: str) -> str:
    """Lightning's name of an accelerator of this machine.

    Raises:
        InputError: where it is none.
    """
    there = ["auto", "cpu", *(["gpu", "cuda"] if torch.cuda.is_available() else [])]
    there += ["mps"] if torch.backends.mps.is_available() else []
    if name not in there:
        raise InputError(
            f"expected an accelerator of this machine ({', '.join(there)}), found {name!r}; use one of them"
        )
    return name


def _epochs_done(checkpoint: Path) -> int:
    """The epochs that a checkpoint has behind it.

    Raises:
        InputError: where the file is broken.
    """
    try:
        return torch.load(checkpoint, map_location="cpu", weights_only=True)["epoch"] + 1
    except (RuntimeError, OSError, EOFError, ValueError, KeyError, pickle.UnpicklingError):
        raise InputError(f"{checkpoint}: expected a checkpoint, found a broken file; delete it to train anew") from None


def names_of(records: Sequence[Any]) -> list[str]:
    """The sequences of some scans, for the description of a run."""
    return sorted({record.sequence for record in records})
