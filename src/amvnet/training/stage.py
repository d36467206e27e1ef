"""The base class of all stages of a training, and the function that fits a stage by Lightning."""

from __future__ import annotations

import io
import logging
import math
import pickle
import signal
import threading
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, Literal

import lightning as L
import numpy as np
import torch
from lightning.pytorch.callbacks import (
    Callback,
    LearningRateMonitor,
    ModelCheckpoint,
    RichProgressBar,
)
from lightning.pytorch.loggers import TensorBoardLogger
from lightning.pytorch.plugins import MixedPrecision, TorchCheckpointIO
from lightning.pytorch.strategies import DDPStrategy
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.utils.data import DataLoader

from amvnet.config.schema import HeadTraining, NetworkTraining, StageName, TrainingConfig
from amvnet.data.taxonomy import Taxonomy
from amvnet.errors import InputError
from amvnet.evaluation.metrics import metrics
from amvnet.files import atomic_write
from amvnet.models.views.points import PointBatch
from amvnet.progress import Reporter, report_nothing
from amvnet.runtime.distributed import ALONE, Processes, device_of, environment
from amvnet.runtime.memory import keep_freed_memory
from amvnet.training.callbacks import AverageWeights, EpochLines, KeepWeights, SeedBatches
from amvnet.training.curves import EPOCHS
from amvnet.training.plan import Plan
from amvnet.training.sync_batch_norm import synchronise_batch_norms
from amvnet.weights.file import Weights

MOMENTUM_CYCLE = 0.1  # decrease of the momentum at the peak of the one-cycle schedule
LOGGED_EVERY = 10  # number of batches between two logged values of the loss

Precision = Literal["32-true", "bf16-mixed", "16-mixed", "64-true"]
SINGLE: Final = "32-true"
DOUBLE: Final = "64-true"
MIXED: Final = "bf16-mixed"
HALF: Final = "16-mixed"

# The loaders of the batches to learn from and to validate with. The second one is None if nothing
# is validated.
Loaders = tuple[DataLoader[Any], DataLoader[Any] | None]


@dataclass(frozen=True)
class StageContext:
    """What a stage takes from its run.

    Attributes:
        config: the values of the stage in the recipe.
        device: what the stage is trained on: "cpu", "cuda", ...
        precision: the precision of the forward and backward passes.
    """

    config: NetworkTraining | HeadTraining
    taxonomy: Taxonomy
    processes: Processes = ALONE
    report: Reporter = report_nothing
    device: str = "cpu"
    precision: Precision = SINGLE

    @classmethod
    def of(cls, plan: Plan, name: StageName) -> StageContext:
        """Return what a stage takes from a run. The head always computes in float32.

        It is so small that a lower precision would save nothing.
        """
        training = plan.recipe.training
        device = device_of(training.accelerator)
        precision = SINGLE if name == "head" else precision_of(training, device)
        config = training.of(name)
        return cls(config, plan.data.taxonomy, plan.processes, plan.report, device, precision)


class Stage(L.LightningModule):
    """The base class of all stages: it computes the metrics of the validation, and the schedule."""

    name: StageName
    trained: nn.Module  # the part of the model that this stage trains

    # The mIoU that chooses the best weights, if `val/miou` does not depend on the trained part.
    own_miou: float | None = None

    def __init__(self, context: StageContext) -> None:
        super().__init__()
        self.context = context
        self.config = context.config
        self.taxonomy = context.taxonomy
        self.processes = context.processes
        self.report = context.report
        self.precision = context.precision
        self.matrix = self.empty_matrix()

    def on_after_batch_transfer(self, batch: Any, dataloader_idx: int) -> Any:
        """Convert floating-point values of a batch to the precision of the weights."""
        return tuple(map(self._in_precision, batch))

    def check_finite(self, loss: Tensor, where: str) -> None:
        """Raise InputError if a loss is not finite, before it spoils the weights."""
        if not torch.isfinite(loss):
            option = f"--training.{self.name}.lr"
            raise InputError(
                f"expected a finite loss, found {loss:g} {where}; lower {option}, or leave them out"
            )

    def check_epoch(self) -> None:
        """Raise InputError if an epoch had nothing to learn from, before its weights are kept."""

    def whole_matrix(self) -> NDArray[np.float64]:
        """Return the (K + 1, K + 1) confusion matrix of the validation, summed over processes.

        Every process must call this.
        """
        total: NDArray[np.float64] = np.sum(self.processes.gather(self.matrix), axis=0)
        return total

    def on_train_batch_end(self, outputs: Any, batch: Any, batch_idx: int) -> None:
        """Log the number of epochs that are done, which places the loss in a diagram."""
        self.log(EPOCHS, self.current_epoch + (batch_idx + 1) / self.trainer.num_training_batches)

    def on_validation_epoch_start(self) -> None:
        self.matrix = self.empty_matrix()

    def on_validation_epoch_end(self) -> None:
        values = metrics(self.whole_matrix(), self.taxonomy)
        self.log("val/miou", values["miou"] or 0.0, prog_bar=True)
        self.log("val/miou_present", values["miou_present"] or 0.0)
        self.log("val/acc", values["accuracy"] or 0.0)
        for name, iou in values["iou"].items():
            if iou is not None:
                self.log(f"iou/{name}", iou)

    def one_cycle(self, optimizer: torch.optim.Optimizer, momentum: float = 0.95) -> Any:
        """Return an optimizer with the one-cycle schedule, as Lightning expects it.

        The learning rate rises to its peak, may stay there, and falls again. The momentum, of which
        `momentum` is the highest (SGD) or the highest first beta (others), does the opposite.
        """
        # The schedule needs two steps before its peak, but a very short training has fewer.
        least = math.ceil(2 / self.config.warmup)
        steps = max(int(self.trainer.estimated_stepping_batches), least)
        held = int(getattr(self.config, "hold", 0) * steps)
        peak = math.ceil(self.config.warmup * steps - 1)
        self._held = range(peak + 1, peak + 1 + held)

        schedule = torch.optim.lr_scheduler.OneCycleLR(
            optimizer,
            max_lr=self.config.lr,
            total_steps=steps - held,
            pct_start=self.config.warmup * steps / (steps - held),
            base_momentum=momentum - MOMENTUM_CYCLE,
            max_momentum=momentum,
        )
        return {"optimizer": optimizer, "lr_scheduler": {"scheduler": schedule, "interval": "step"}}

    def lr_scheduler_step(self, scheduler: Any, metric: Any) -> None:
        """Advance the learning rate, but not while it is held at its peak."""
        if self.trainer.global_step not in self._held:
            with warnings.catch_warnings():
                # 16-mixed skips the first steps until its scale suits the gradients.
                warnings.filterwarnings("ignore", "Detected call of `lr_scheduler.step")
                scheduler.step()

    def empty_matrix(self) -> np.ndarray:
        """Return a (K + 1, K + 1) confusion matrix without counts."""
        ids = self.taxonomy.size + 1
        return np.zeros((ids, ids))

    def _in_precision(self, values: PointBatch | Tensor) -> PointBatch | Tensor:
        if isinstance(values, PointBatch) or values.is_floating_point():
            return values.to(self.dtype)
        return values


class KeepSignals(Callback):
    """Keeps this process's handler of SIGTERM.

    Lightning's own handler would end the training as if it were done.
    """

    def __init__(self) -> None:
        self._handler = signal.getsignal(signal.SIGTERM)

    def on_train_start(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        if threading.current_thread() is threading.main_thread():
            signal.signal(signal.SIGTERM, self._handler)


class ScaledLoss(MixedPrecision):
    """Scales the loss of 16-mixed, so that small gradients do not vanish in float16.

    A stage itself decides what computes in float16, and not Lightning.
    """

    @contextmanager
    def forward_context(self) -> Iterator[None]:
        yield


class WholeCheckpoints(TorchCheckpointIO):
    """Writes a checkpoint into its folder, and keeps the earlier one until the new one is whole.

    Lightning writes into the system's temporary folder first. If that is on another file system,
    it then copies over the earlier checkpoint.
    """

    def save_checkpoint(
        self, checkpoint: dict[str, Any], path: str | Path, storage_options: Any = None
    ) -> None:
        # PyTorch reports a full disk without its reason, so a plain file writes the bytes.
        content = io.BytesIO()
        torch.save(checkpoint, content)
        with atomic_write(path) as part:
            part.write_bytes(content.getbuffer())


def fit(stage: Stage, plan: Plan, loaders: Loaders, weights: Weights) -> None:
    """Train a stage in its folder of the run, and write its weights after each epoch.

    Raises:
        InputError: if a scan cannot be read, or the loss is not finite.
    """
    for name in ("lightning.pytorch", "lightning.fabric"):  # set their levels when imported
        logging.getLogger(name).setLevel(logging.ERROR)

    stage.train()
    train, val = loaders
    device = stage.context.device
    if device == "cpu":
        keep_freed_memory()
    if plan.processes.size > 1:
        synchronise_batch_norms(stage.trained, cuda=device == "cuda")
    if stage.precision == DOUBLE:
        stage.double()

    folder = plan.folder.stages[stage.name]
    begun = folder.checkpoint if plan.resume and folder.checkpoint.is_file() else None
    if begun is not None:
        # Lightning sets the sampler's epoch only after the reading processes have begun to draw.
        train.sampler.set_epoch(_epochs_done(begun))  # type: ignore[attr-defined]

    # Buffers need no broadcast, because synchronised batch norms have the same statistics in all
    # processes. A broadcast would even block, because processes may validate unequal shares.
    ddp = DDPStrategy(broadcast_buffers=False)
    plugins: list[Any] = [environment(), WholeCheckpoints()]
    if stage.precision == HALF:
        plugins.append(ScaledLoss(HALF, device))
    trainer = L.Trainer(
        accelerator=plan.recipe.training.accelerator,
        devices=plan.processes.size // plan.processes.nodes,  # on each machine
        num_nodes=plan.processes.nodes,
        strategy=ddp if plan.processes.size > 1 else "auto",
        plugins=plugins,
        max_epochs=stage.config.epochs,
        limit_val_batches=0 if val is None else None,
        accumulate_grad_batches=getattr(stage.config, "accumulate", 1),
        gradient_clip_val=getattr(stage.config, "clip", None),
        callbacks=_callbacks(stage, plan, KeepWeights(plan, stage.name, weights)),
        default_root_dir=folder.path,
        logger=TensorBoardLogger(folder.path, name="", version=""),
        enable_progress_bar=plan.bars and plan.processes.first,
        enable_model_summary=False,
        log_every_n_steps=min(LOGGED_EVERY, len(train)),
        num_sanity_val_steps=0,
        use_distributed_sampler=False,
    )
    try:
        trainer.fit(stage, train, val, ckpt_path=begun, weights_only=begun is not None)
    except InputError as error:
        # A worker process raises an error with its traceback, whose last line is the message.
        line = str(error).strip().splitlines()[-1]
        raise InputError(line.removeprefix(f"{InputError.__module__}.InputError: ")) from None
    except RuntimeError as error:
        if not str(error).startswith("DataLoader worker"):
            raise
        raise InputError(
            "training.workers: expected processes that read scans to the end, found one that was "
            "killed, as the system does if memory runs out; lower it, and go on with --resume"
        ) from None


def _callbacks(stage: Stage, plan: Plan, keep_weights: KeepWeights) -> list[Callback]:
    """Return the callbacks of a stage.

    The weights are written before the checkpoint, so that a checkpoint never claims an epoch whose
    weights are not on disk.
    """
    has_bar = plan.bars and plan.processes.first
    lines = EpochLines(plan.report, stage.name, _epochs_after(stage, plan))
    callbacks: list[Callback] = [
        keep_weights,
        KeepSignals(),
        SeedBatches(plan.recipe.training.seed, plan.processes.rank),
        ModelCheckpoint(
            plan.out / stage.name,
            filename="last",
            enable_version_counter=False,
            save_on_train_epoch_end=True,
        ),
        LearningRateMonitor(),
        RichProgressBar() if has_bar else lines,
    ]
    config = stage.config
    if isinstance(config, NetworkTraining) and (config.ema or config.initial):
        callbacks.append(AverageWeights(config.ema, config.initial))
    return callbacks


def _epochs_after(stage: Stage, plan: Plan) -> int:
    """Estimate how long the later stages of the call take, in epochs of this stage.

    The epochs of the head take hardly any time. Before them, all scans are scored once for each
    view, and each scoring counts as an epoch.
    """
    epochs = 0
    for name in plan.stages[plan.stages.index(stage.name) + 1 :]:
        config = plan.recipe.training.of(name)
        if not (plan.resume and plan.folder.stages[name].is_finished):
            epochs += max(config.views, 1) if isinstance(config, HeadTraining) else config.epochs
    return epochs


def precision_of(training: TrainingConfig, device: str) -> Precision:
    """Return the precision of a training on a device, as Lightning names it.

    `auto` is bf16-mixed on a device with bfloat16 arithmetic, and 32-true on others. They only
    emulate bfloat16, which takes several times as long.
    """
    if training.precision != "auto":
        return training.precision
    return MIXED if _multiplies_bfloat16(device) else SINGLE


def _multiplies_bfloat16(device: str) -> bool:
    if device == "cuda":
        return bool(torch.cuda.is_bf16_supported(including_emulation=False))
    if device == "cpu" and hasattr(torch.cpu, "get_capabilities"):  # newer than torch 2.6
        capabilities = torch.cpu.get_capabilities()
        return bool(capabilities.get("avx512_bf16") or capabilities.get("amx_bf16"))
    return False


def _epochs_done(checkpoint: Path) -> int:
    try:
        state = torch.load(checkpoint, map_location="cpu", weights_only=True)
        return int(state["epoch"]) + 1
    except (RuntimeError, OSError, EOFError, ValueError, KeyError, pickle.UnpicklingError):
        raise InputError(
            f"{checkpoint}: expected a checkpoint, found a broken file; delete it to train again"
        ) from None
