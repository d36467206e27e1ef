"""Fits one stage with Lightning."""

from __future__ import annotations

import pickle
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import lightning as L
import torch
from lightning.pytorch.callbacks import Callback, LearningRateMonitor, ModelCheckpoint
from lightning.pytorch.loggers import TensorBoardLogger
from lightning.pytorch.strategies import DDPStrategy
from torch.utils.data import DataLoader

from amvnet.config.schema import TrainingConfig
from amvnet.distributed import ALONE, Processes, device_of, environment
from amvnet.errors import InputError
from amvnet.training.callbacks import Bar, Curves, EpochLines, SeedBatches, Speed
from amvnet.training.stages import Stage
from amvnet.training.sync_batch_norm import synchronise_batch_norms

LOGGED_EVERY = 10  # batches, of the loss


DOUBLE = "64-true"


LAST = "last.ckpt"  # what --resume goes on from


@dataclass(frozen=True)
class FitOptions:
    """How a stage is trained.

    Attributes:
        training: the recipe's.
        folder: where its checkpoint, curves and weights are.
        epochs: passes over the data.
        parts: into which a batch is split, and accumulated before a step.
        clip: largest norm of the gradient.
        resume: go on from the last epoch in the folder.
        say: told one line an epoch.
        bars: show a progress bar instead.
        processes: those that share the training.
        steps: end after so many, for a trial; validation is left out then.
    """

    training: TrainingConfig
    folder: Path
    epochs: int
    parts: int = 1
    clip: float | None = None
    resume: bool = False
    say: Callable[[str], None] = lambda line: None
    bars: bool = False
    processes: Processes = ALONE
    steps: int | None = None


def fit(
    stage: Stage,
    course: FitOptions,
    train: DataLoader[Any],
    val: DataLoader[Any] | None,
    kept: Sequence[Callback] = (),
) -> Speed:
    """Train a stage in its folder; returns how fast it was.

    Args:
        val: None where nothing is validated.
        kept: callbacks that write at the end of each epoch, before the checkpoint is written: it never says more
            than they have kept.
    """
    on_cuda = device_of(course.training.accelerator) == "cuda"
    if course.processes.size > 1:
        synchronise_batch_norms(stage.trained, on_cuda)
    if course.training.precision == DOUBLE:
        stage.double()
    if course.training.compile:
        stage.trained.compile()
    speed = Speed()
    checkpoint = course.folder / LAST
    begun = checkpoint if course.resume and checkpoint.is_file() else None
    if begun is not None:
        # Lightning tells the sampler its epoch only after the reading processes have begun to draw.
        train.sampler.set_epoch(_epochs_done(begun))  # type: ignore[attr-defined]
    try:
        trainer = _trainer(course, len(train), [speed, *kept], val is not None)
        trainer.fit(stage, train, val, ckpt_path=begun, weights_only=begun is not None)
    except InputError as error:  # from a reading process it comes with that process's traceback
        raise InputError(
            str(error).splitlines()[-1].removeprefix(f"{InputError.__module__}.InputError: ")
        ) from None
    return speed


def _trainer(
    course: FitOptions, batches: int, callbacks: Sequence[Callback], validates: bool
) -> L.Trainer:
    training, processes, folder, trial = (
        course.training,
        course.processes,
        course.folder,
        course.steps is not None,
    )
    kept = [] if trial else [
        Curves(folder / "metrics.csv"),
        ModelCheckpoint(folder, filename="last", enable_version_counter=False, save_on_train_epoch_end=True),
        LearningRateMonitor(),
    ]  # fmt: skip
    bars = course.bars and processes.first
    shown = [Bar() if bars else EpochLines(course.say, folder.name)]
    # The statistics of synchronised batch norms are the same everywhere, and processes may validate unequal shares.
    ddp = DDPStrategy(broadcast_buffers=False)
    return L.Trainer(
        accelerator=training.accelerator,
        devices=processes.here,
        num_nodes=processes.nodes,
        strategy=ddp if processes.size > 1 else "auto",
        plugins=[environment()],
        # Lightning's own way to double precision does not know our batches.
        precision="32-true" if training.precision == DOUBLE else training.precision,
        max_epochs=course.epochs,
        max_steps=-1 if course.steps is None else course.steps,
        limit_val_batches=None if validates else 0,
        accumulate_grad_batches=course.parts,
        gradient_clip_val=course.clip,
        default_root_dir=folder,
        callbacks=[*callbacks, SeedBatches(training.seed, processes.rank), *kept, *shown],
        logger=False if trial else TensorBoardLogger(folder, name="", version=""),
        enable_checkpointing=not trial,
        enable_progress_bar=bars,
        enable_model_summary=False,
        num_sanity_val_steps=0,
        log_every_n_steps=min(LOGGED_EVERY, batches),
        use_distributed_sampler=False,
    )


def _epochs_done(checkpoint: Path) -> int:
    """The epochs that a checkpoint has behind it.

    Raises:
        InputError: where the file is broken.
    """
    try:
        return torch.load(checkpoint, map_location="cpu", weights_only=True)["epoch"] + 1
    except (RuntimeError, OSError, EOFError, ValueError, KeyError, pickle.UnpicklingError):
        raise InputError(
            f"{checkpoint}: expected a checkpoint, found a broken file; delete it to train anew"
        ) from None
