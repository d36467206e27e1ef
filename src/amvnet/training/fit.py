"""Fit one stage with Lightning."""

from __future__ import annotations

import logging
import pickle
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import lightning as L
import torch
from lightning.pytorch.callbacks import Callback, LearningRateMonitor, ModelCheckpoint
from lightning.pytorch.strategies import DDPStrategy
from torch.utils.data import DataLoader

from amvnet.config.schema import TrainingConfig
from amvnet.distributed import device_of, environment
from amvnet.errors import InputError
from amvnet.memory import keep_freed_memory
from amvnet.training.callbacks import AverageWeights, Bar, Curves, EpochLines, SeedBatches, Speed
from amvnet.training.loggers import make_logger
from amvnet.training.precision import DOUBLE, SINGLE, precision_of
from amvnet.training.run_plan import RunOptions
from amvnet.training.stages import Stage
from amvnet.training.sync_batch_norm import synchronise_batch_norms

LOGGED_EVERY = 10  # batches, of the loss
LAST = "last.ckpt"  # what --resume continues from


@dataclass(frozen=True)
class FitOptions:
    """How a stage is fitted.

    Attributes:
        training: the recipe's numbers.
        folder: for its checkpoint, curves and weights.
        epochs: passes over the data.
        run: how the run goes: resumed or not, with which processes.
        accumulate: parts of a batch, whose gradients are accumulated before a step.
        clip: largest norm of the gradient; None does not clip.
        ema: decay of the moving average of the weights; 0 for none.
        initial: share of the initial weights in those that are used in the end.
        steps: end after this many, for a trial; then nothing is validated or written.
    """

    training: TrainingConfig
    folder: Path
    epochs: int
    run: RunOptions
    accumulate: int = 1
    clip: float | None = None
    ema: float = 0.0
    initial: float = 0.0
    steps: int | None = None


@dataclass(frozen=True)
class Loaders:
    """The batches to learn from and to validate with; None if nothing is validated."""

    train: DataLoader[Any]
    val: DataLoader[Any] | None


def fit(
    stage: Stage, options: FitOptions, loaders: Loaders, callbacks: Sequence[Callback] = ()
) -> Speed:
    """Train a stage in its folder.

    Args:
        callbacks: write at the end of each epoch, before the checkpoint, which therefore never
            claims more than they have written.

    Returns:
        How fast it was.

    Raises:
        InputError: if a scan cannot be read, or the loss is not finite.
    """
    device = device_of(options.training.accelerator)
    if device == "cpu":
        keep_freed_memory()
    if options.run.processes.size > 1:
        synchronise_batch_norms(stage.trained, cuda=device == "cuda")
    if precision_of(options.training) == DOUBLE:
        stage.double()
    if options.training.compile:
        for net in stage.compilable:
            net.compile()

    checkpoint = options.folder / LAST
    begun = checkpoint if options.run.resume and checkpoint.is_file() else None
    if begun is not None:
        # Lightning sets the sampler's epoch only after the reading processes have begun to draw.
        loaders.train.sampler.set_epoch(_epochs_done(begun))  # type: ignore[attr-defined]

    speed = Speed()
    trainer = _trainer(options, loaders, [speed, *callbacks])
    trainer.fit(stage, loaders.train, loaders.val, ckpt_path=begun, weights_only=begun is not None)
    return speed


def _trainer(options: FitOptions, loaders: Loaders, callbacks: Sequence[Callback]) -> L.Trainer:
    training = options.training
    processes = options.run.processes
    folder = options.folder
    precision = precision_of(training)
    is_trial = options.steps is not None
    bars = options.run.bars and processes.first

    all_callbacks = [*callbacks, SeedBatches(training.seed, processes.rank)]
    if options.ema or options.initial:
        all_callbacks.append(AverageWeights(options.ema, options.initial))
    if not is_trial:
        all_callbacks += [
            Curves(folder / "metrics.csv"),
            ModelCheckpoint(
                folder,
                filename="last",
                enable_version_counter=False,
                save_on_train_epoch_end=True,
            ),
            LearningRateMonitor(),
        ]
    all_callbacks.append(Bar() if bars else EpochLines(options.run.say, folder.name))

    # The statistics of synchronised batch norms are the same everywhere, and processes may validate
    # unequal shares.
    ddp = DDPStrategy(broadcast_buffers=False)
    return L.Trainer(
        accelerator=training.accelerator,
        devices=processes.here,
        num_nodes=processes.nodes,
        strategy=ddp if processes.size > 1 else "auto",
        plugins=[environment()],
        # Lightning's own way to double precision does not convert our batches.
        precision=SINGLE if precision == DOUBLE else precision,
        max_epochs=options.epochs,
        max_steps=-1 if options.steps is None else options.steps,
        limit_val_batches=0 if loaders.val is None else None,
        accumulate_grad_batches=options.accumulate,
        gradient_clip_val=options.clip,
        default_root_dir=folder,
        callbacks=all_callbacks,
        logger=False if is_trial else make_logger(options.run.logger, folder),
        enable_checkpointing=not is_trial,
        enable_progress_bar=bars,
        enable_model_summary=False,
        num_sanity_val_steps=0,
        log_every_n_steps=min(LOGGED_EVERY, len(loaders.train)),
        use_distributed_sampler=False,
    )


def _epochs_done(checkpoint: Path) -> int:
    """Return how many epochs a checkpoint has seen.

    Raises:
        InputError: if the file is broken.
    """
    try:
        state = torch.load(checkpoint, map_location="cpu", weights_only=True)
        return state["epoch"] + 1
    except (RuntimeError, OSError, EOFError, ValueError, KeyError, pickle.UnpicklingError):
        raise InputError(
            f"{checkpoint}: expected a checkpoint, found a broken file; delete it to train again"
        ) from None


def quiet_lightning() -> None:
    """Suppress Lightning's notes; it sets its log levels when it is imported."""
    for name in ("lightning.pytorch", "lightning.fabric"):
        logging.getLogger(name).setLevel(logging.ERROR)
