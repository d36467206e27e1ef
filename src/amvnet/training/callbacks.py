"""Lightning callbacks of a training: weights, curves, seeds, speed."""

from __future__ import annotations

import csv
import dataclasses
import time
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import timedelta
from pathlib import Path
from typing import Any

import lightning as L
import numpy as np
import torch
import yaml
from lightning.pytorch.callbacks import Callback, RichProgressBar
from torch import Tensor, nn

from amvnet.files import atomic_write
from amvnet.progress import Say
from amvnet.sensors.intensity import TrainedIntensity
from amvnet.training.loaders import sensor_record
from amvnet.training.plan import Plan
from amvnet.training.run_folder import PART_OF, SETTINGS, description, stage_settings
from amvnet.weights.file import Weights, part_state, save


class AverageWeights(Callback):
    """Keeps an exponential moving average of the weights, which is validated and written.

    The statistics of batch norms are averaged, too. The training itself goes on with the weights of
    its own.

    Args:
        decay: share of the average that a step keeps. Early steps keep less, so that the initial
            weights are soon forgotten. 0 keeps the weights of the last step alone.
        initial_share: of the weights that the training begins with in what is validated and
            written (WiSE-FT: Wortsman et al., Robust fine-tuning of zero-shot models, 2022).
    """

    def __init__(self, decay: float, initial_share: float = 0.0) -> None:
        self.decay = decay
        self.initial_share = initial_share
        self.initial: dict[str, Tensor] = {}
        self.average: dict[str, Tensor] = {}
        self.steps = 0  # that are in the average
        self._raw: dict[str, Tensor] = {}  # the weights of the training, while it is validated

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

        for kept in (self.initial, self.average):
            for name in kept:
                kept[name] = kept[name].to(weights[name].device)

    @torch.no_grad()
    def on_train_batch_end(
        self, trainer: L.Trainer, pl_module: Any, outputs: Any, batch: Any, batch_idx: int
    ) -> None:
        # A step may take several batches, whose gradients are accumulated.
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
        self._insert(pl_module.trained)

    def on_validation_end(self, trainer: L.Trainer, pl_module: Any) -> None:
        self._remove(pl_module.trained)

    @contextmanager
    def inserted(self, part: nn.Module) -> Iterator[None]:
        """Let a module have the averaged weights within the block."""
        self._insert(part)
        try:
            yield
        finally:
            self._remove(part)

    def _insert(self, part: nn.Module) -> None:
        self._raw = _copies(part.state_dict())
        part.load_state_dict({**self.average, **self._mixed()})

    def _mixed(self) -> dict[str, Tensor]:
        """Return the mean of the initial weights and the average, by their shares."""
        mixed = {}
        for name, initial in self.initial.items():
            if initial.is_floating_point():
                mixed[name] = self.average[name].lerp(initial, self.initial_share)
        return mixed

    def _remove(self, part: nn.Module) -> None:
        part.load_state_dict(self._raw)
        self._raw = {}


class KeepWeights(Callback):
    """Writes the weights of a stage after each epoch, and keeps those with the highest mIoU.

    Without validation the last weights are kept as the best.

    The folder of the stage receives last.safetensors, best.safetensors and `SETTINGS`.
    """

    def __init__(
        self, plan: Plan, name: str, weights: Weights, intensity: TrainedIntensity | None
    ) -> None:
        self.folder = plan.out / name
        self.part = PART_OF[name]
        self.weights = weights
        self.settings = stage_settings(plan, name, weights)
        self.description: dict[str, Any] = {}
        if plan.processes.first:  # the others do not write
            sensor = sensor_record(plan.scans.dataset, plan.scans.train, intensity)
            self.description = description(plan, self.settings, sensor)
        self.started = time.time()
        self.highest = -1.0  # mIoU of the best weights so far

    def state_dict(self) -> dict[str, Any]:
        return {"highest": self.highest}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        self.highest = state_dict["highest"]

    def on_train_epoch_end(self, trainer: L.Trainer, pl_module: Any) -> None:
        metrics = {}
        for name, value in _metrics(trainer).items():
            if name.startswith("val/"):
                metrics[name] = value
        metrics["epoch"] = trainer.current_epoch

        miou = metrics.get("val/miou")
        is_best = miou is None or miou > self.highest
        if miou is not None:
            self.highest = max(self.highest, miou)

        if trainer.is_global_zero:
            with _weights_to_keep(trainer, pl_module.trained) as module:
                trained = self._trained(module, metrics)
            for name in ("last", "best") if is_best else ("last",):
                save(trained, self.folder / f"{name}.safetensors")
            with atomic_write(self.folder / SETTINGS) as file:
                file.write_text(yaml.safe_dump(self.settings, sort_keys=False))

    def _trained(self, module: nn.Module, metrics: dict[str, float]) -> Weights:
        """Return the weights of the trained part alone."""
        seconds = round(time.time() - self.started)
        return dataclasses.replace(
            self.weights,
            tensors=part_state(self.part, module),
            training={self.part: {**self.description, "seconds": seconds}},
            metrics={self.part: metrics},
        )


class Curves(Callback):
    """Keeps the metrics in a CSV file, one row per epoch; a resumed run extends it."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def on_train_epoch_end(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        if not trainer.is_global_zero:
            return

        # A resumed run repeats an epoch that was written here, but not yet in a checkpoint.
        epoch = trainer.current_epoch
        rows = [row for row in self._read() if int(row["epoch"]) < epoch]
        rows.append({"epoch": epoch, **_metrics(trainer)})

        columns: dict[str, None] = {}  # in the order in which they first appear
        for row in rows:
            columns.update(dict.fromkeys(row))

        with atomic_write(self.path) as part, part.open("w", newline="") as file:
            table = csv.DictWriter(file, list(columns))
            table.writeheader()
            table.writerows(rows)

    def _read(self) -> list[dict[str, Any]]:
        if not self.path.is_file():
            return []
        with self.path.open(newline="") as file:
            return list(csv.DictReader(file))


class SeedBatches(Callback):
    """Seeds PyTorch before each training batch, so that a resumed run repeats the random draws."""

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


class Speed(Callback):
    """Measures the speed of the current epoch so far.

    Attributes:
        rate: scans (or points, for the head) per second, over all processes.
    """

    def __init__(self) -> None:
        self.rate = 0.0
        self._units = 0  # scans or points so far
        self._start = 0.0

    def on_train_epoch_start(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        self._units = 0
        self._start = time.perf_counter()

    def on_train_batch_end(
        self, trainer: L.Trainer, pl_module: Any, outputs: Any, batch: Any, batch_idx: int
    ) -> None:
        self._units += pl_module.size_of(batch) * trainer.world_size
        self.rate = self._units / (time.perf_counter() - self._start)
        pl_module.log(f"{pl_module.unit}/s", self.rate, prog_bar=True, batch_size=1)

    @property
    def elapsed(self) -> str:
        """How long the current epoch has taken so far, with its validation, as h:mm:ss."""
        return str(timedelta(seconds=round(time.perf_counter() - self._start)))

    def time_left(self, trainer: L.Trainer) -> str:
        """Return how long the rest of the training takes at this rate, as h:mm:ss."""
        batches = trainer.fit_loop.epoch_loop.batch_progress.current.completed
        done = batches / max(trainer.num_training_batches, 1)  # share of the epoch
        if not done:
            return "?"

        elapsed = time.perf_counter() - self._start
        epochs = trainer.max_epochs or trainer.current_epoch
        ahead = epochs - trainer.current_epoch - done
        return str(timedelta(seconds=round(ahead * elapsed / done)))


class Trial(Callback):
    """Ends a training after two steps.

    Attributes:
        ends: when each step ended, in seconds.
    """

    def __init__(self) -> None:
        self.ends: list[float] = []

    def on_train_batch_end(
        self, trainer: L.Trainer, pl_module: Any, outputs: Any, batch: Any, batch_idx: int
    ) -> None:
        # A step may take several batches, whose gradients are accumulated.
        if trainer.global_step > len(self.ends):
            self.ends.append(time.perf_counter())
        trainer.should_stop = len(self.ends) == 2


class Bar(RichProgressBar):
    """Progress bar of an epoch with loss, mIoU, speed and the time left of the whole training."""

    def __init__(self, speed: Speed) -> None:
        super().__init__()
        self.speed = speed

    def get_metrics(self, trainer: L.Trainer, pl_module: L.LightningModule) -> dict[str, Any]:
        metrics = super().get_metrics(trainer, pl_module)
        metrics.pop("v_num", None)
        return {**metrics, "left": self.speed.time_left(trainer)}


class EpochLines(Callback):
    """Prints one line per epoch; used if there is no terminal for a progress bar."""

    def __init__(self, speed: Speed, say: Say, name: str) -> None:
        self.speed = speed
        self.say = say
        self.name = name

    def on_train_epoch_end(self, trainer: L.Trainer, pl_module: Any) -> None:
        metrics = _metrics(trainer)

        loss = metrics.get("train/loss", float("nan"))
        results = f"loss {loss:.3f}"
        if "val/miou" in metrics:
            miou = metrics["val/miou"]
            miou_present = metrics["val/miou_present"]
            results += f", val mIoU {miou:.4f} (classes present {miou_present:.4f})"

        pace = f"{self.speed.rate:.3g} {pl_module.unit}/s"
        times = f"epoch in {self.speed.elapsed}, {self.speed.time_left(trainer)} left"
        epoch = f"{self.name} epoch {trainer.current_epoch + 1}/{trainer.max_epochs}"
        self.say(f"{epoch}: {results}; {pace}, {times}")


def _metrics(trainer: L.Trainer) -> dict[str, float]:
    """Return the logged metrics of the epoch as plain numbers."""
    return {name: float(value) for name, value in trainer.callback_metrics.items()}


@contextmanager
def _weights_to_keep(trainer: L.Trainer, part: nn.Module) -> Iterator[nn.Module]:
    """Yield the trained part, with the averaged weights within the block if there are any."""
    for callback in trainer.callbacks:  # type: ignore[attr-defined]
        if isinstance(callback, AverageWeights):
            with callback.inserted(part):
                yield part
            return
    yield part


def _copies(tensors: dict[str, Tensor]) -> dict[str, Tensor]:
    return {name: tensor.clone() for name, tensor in tensors.items()}
