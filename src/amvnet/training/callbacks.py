"""Callbacks of Lightning that average and write weights, seed batches, and report epochs."""

from __future__ import annotations

import dataclasses
import time
from datetime import timedelta
from typing import Any

import lightning as L
import numpy as np
import torch
from lightning.pytorch.callbacks import Callback
from torch import Tensor

from amvnet.config.schema import PART_OF, StageName
from amvnet.progress import Reporter
from amvnet.training.plan import Plan
from amvnet.weights.file import Weights, part_state


class AverageWeights(Callback):
    """Keeps an exponential moving average of the weights. The average is validated and written.

    The statistics of batch norms are averaged as well. The training itself continues with its own
    weights.

    Args:
        decay: share of the average that a step keeps, in [0, 1]. Early steps keep less, so that the
            initial weights are soon forgotten. 0 keeps only the weights of the last step.
        initial_share: share of the initial weights in the weights that are validated and written,
            in [0, 1] (WiSE-FT: Wortsman et al., Robust fine-tuning of zero-shot models, 2022).
    """

    def __init__(self, decay: float, initial_share: float = 0.0) -> None:
        self.decay = decay
        self.initial_share = initial_share
        self.initial: dict[str, Tensor] = {}
        self.average: dict[str, Tensor] = {}
        self.steps = 0  # number of steps that are in the average
        self._raw: dict[str, Tensor] = {}  # the training's own weights during a validation

    def state_dict(self) -> dict[str, Any]:
        return {"initial": self.initial, "average": self.average, "steps": self.steps}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        self.initial = state_dict["initial"]
        self.average = state_dict["average"]
        self.steps = state_dict["steps"]

    def on_fit_start(self, trainer: L.Trainer, pl_module: Any) -> None:
        weights = pl_module.trained.state_dict()
        if not self.average:
            self.average = _copies(weights)
            self.initial = _copies(weights) if self.initial_share else {}

        # The weights of a checkpoint are in the CPU's memory.
        for tensors in (self.initial, self.average):
            for name in tensors:
                tensors[name] = tensors[name].to(weights[name].device)

    @torch.no_grad()
    def on_train_batch_end(
        self, trainer: L.Trainer, pl_module: Any, outputs: Any, batch: Any, batch_idx: int
    ) -> None:
        # A step may take several batches, because gradients may be accumulated.
        if trainer.global_step == self.steps:
            return

        decay = min(self.decay, (1 + self.steps) / (10 + self.steps))
        weights = pl_module.trained.state_dict()
        floats = [name for name, value in weights.items() if value.is_floating_point()]
        torch._foreach_lerp_(
            [self.average[name] for name in floats], [weights[name] for name in floats], 1 - decay
        )
        for name in weights.keys() - floats:
            self.average[name].copy_(weights[name])
        self.steps = trainer.global_step

    def on_validation_start(self, trainer: L.Trainer, pl_module: Any) -> None:
        self._raw = _copies(pl_module.trained.state_dict())
        pl_module.trained.load_state_dict(self.weights())

    def on_validation_end(self, trainer: L.Trainer, pl_module: Any) -> None:
        pl_module.trained.load_state_dict(self._raw)
        self._raw = {}

    def weights(self) -> dict[str, Tensor]:
        """Return the average, mixed with the share `initial_share` of the initial weights."""
        weights = dict(self.average)
        for name, initial in self.initial.items():
            if initial.is_floating_point():
                weights[name] = self.average[name].lerp(initial, self.initial_share)
        return weights


class KeepWeights(Callback):
    """Writes last.safetensors, best.safetensors and `SETTINGS` of a stage after each epoch.

    The best weights are the weights with the highest mIoU in the validation, which is the stage's
    `own_miou` if it has one. If nothing is validated, they are the last ones.
    """

    def __init__(self, plan: Plan, name: StageName, weights: Weights) -> None:
        self.folder = plan.folder.stages[name]
        self.part = PART_OF[name].name
        self.weights = weights
        self.settings = plan.settings(name, weights)
        self.record = plan.stage_record(self.settings)
        self.started = time.monotonic()  # unlike the system's clock, it is never set back
        self.seconds_before = 0.0  # the time of earlier calls, of which this one continues the last
        self.highest = -1.0  # mIoU of the best weights so far, in [0, 1]

    def state_dict(self) -> dict[str, Any]:
        return {"highest": self.highest, "seconds": self._seconds()}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        self.highest = state_dict["highest"]
        self.seconds_before = state_dict.get("seconds", 0.0)

    def _seconds(self) -> float:
        """Return how long the training has taken, without the time between its calls."""
        return self.seconds_before + time.monotonic() - self.started

    def on_train_epoch_end(self, trainer: L.Trainer, pl_module: Any) -> None:
        pl_module.check_epoch()
        found = _metrics(trainer)
        metrics = {name: value for name, value in found.items() if name.startswith("val/")}
        metrics["epoch"] = trainer.current_epoch

        miou = metrics.get("val/miou") if pl_module.own_miou is None else pl_module.own_miou
        is_best = miou is None or miou > self.highest
        if miou is not None:
            self.highest = max(self.highest, miou)

        if trainer.is_global_zero:
            state = pl_module.trained.state_dict()
            for callback in trainer.callbacks:  # type: ignore[attr-defined]
                if isinstance(callback, AverageWeights):
                    state = callback.weights()
            kept = ("last", "best") if is_best else ("last",)
            self.folder.write(self._trained(state, metrics), kept, self.settings)

    def _trained(self, state: dict[str, Tensor], metrics: dict[str, float]) -> Weights:
        """Return weights that hold only the trained part, given its parameters."""
        return dataclasses.replace(
            self.weights,
            tensors=part_state(self.part, state),
            training={self.part: {**self.record, "seconds": round(self._seconds())}},
            metrics={self.part: metrics},
        )


class SeedBatches(Callback):
    """Seeds PyTorch before each training batch, so that a resumed run draws the same numbers."""

    def __init__(self, seed: int, rank: int = 0) -> None:
        self.seed = seed
        self.rank = rank

    def on_train_batch_start(
        self, trainer: L.Trainer, pl_module: L.LightningModule, batch: Any, index: int
    ) -> None:
        entropy = [self.seed, trainer.current_epoch, index]
        if self.rank > 0:  # the first process draws the same numbers as a single process
            entropy.append(self.rank)

        torch.manual_seed(int(np.random.SeedSequence(entropy).generate_state(1)[0]))


class EpochLines(Callback):
    """Reports a line for each epoch. It is used if there is no terminal for a progress bar.

    `later` is the number of epochs in the later stages. The estimate of the whole time left assumes
    that each of them takes as long as an epoch of this stage.
    """

    def __init__(self, report: Reporter, name: str, later: int = 0) -> None:
        self.report = report
        self.name = name
        self.later = later
        self._start = 0.0

    def on_train_epoch_start(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        self._start = time.monotonic()

    def on_train_epoch_end(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        metrics = _metrics(trainer)
        results = f"loss {metrics.get('train/loss', float('nan')):.3f}"
        if "val/miou" in metrics:
            miou = metrics["val/miou"]
            miou_present = metrics["val/miou_present"]
            results += f", val mIoU {miou:.1%} (classes present {miou_present:.1%})"

        epochs = trainer.max_epochs or 0
        epoch = trainer.current_epoch + 1
        took = timedelta(seconds=round(time.monotonic() - self._start))
        left = (epochs - epoch) * took
        times = f"epoch in {took}, {left} left"
        if self.later:
            times += f", about {left + self.later * took} with the stages that follow"
        self.report(f"{self.name} epoch {epoch}/{epochs}: {results}; {times}")


def _metrics(trainer: L.Trainer) -> dict[str, float]:
    return {name: float(value) for name, value in trainer.callback_metrics.items()}


def _copies(tensors: dict[str, Tensor]) -> dict[str, Tensor]:
    return {name: tensor.clone() for name, tensor in tensors.items()}
