"""What is done in the course of a training: weights, curves and pictures are kept, lines said, batches seeded."""

from __future__ import annotations

import csv
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from datetime import timedelta
from pathlib import Path
from typing import Any

import lightning as L
import numpy as np
import torch
from lightning.pytorch.callbacks import Callback, RichProgressBar
from torch import Tensor, nn

from amvnet.data.taxonomy import Taxonomy
from amvnet.evaluation.top_view import scan_figure
from amvnet.files import atomic_write
from amvnet.memory import peak_memory
from amvnet.models.views.points import PointBatch
from amvnet.scan import Scan

PICTURED = 10  # times in a training that the pictures are drawn, at most about
PICTURE_DOTS = 60  # an inch


@dataclass(frozen=True)
class KeptWeights:
    """Where a stage's run keeps its weights, and what they reached."""

    best: Path
    last: Path


class KeepWeights(Callback):
    """After each epoch writes the trained part as `last`, and as `best` where its mIoU is the highest yet.

    Where nothing is validated the last is the best.
    """

    def __init__(
        self, write: Callable[[nn.Module, Path, dict[str, float]], None], folder: Path
    ) -> None:
        self.write, self.highest = write, -1.0
        self.kept = KeptWeights(folder / "best.safetensors", folder / "last.safetensors")

    def state_dict(self) -> dict[str, Any]:
        return {"highest": self.highest}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        self.highest = state_dict["highest"]

    def on_train_epoch_end(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        reached = {k: float(v) for k, v in trainer.callback_metrics.items() if k.startswith("val/")}
        miou, reached["epoch"] = reached.get("val/miou"), trainer.current_epoch
        best = miou is None or miou > self.highest
        self.highest = self.highest if miou is None or not best else miou
        for path in (self.kept.last, *([self.kept.best] if best else [])):
            if trainer.is_global_zero:
                self.write(trained(pl_module), path, reached)


class Curves(Callback):
    """Keeps the figures of each epoch in a table, one row an epoch; those of a resumed run go on in it."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def on_train_epoch_end(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        if not trainer.is_global_zero:
            return
        now = {
            "epoch": trainer.current_epoch,
            **{k: float(v) for k, v in trainer.callback_metrics.items()},
        }
        rows = [row for row in self._kept() if int(row["epoch"]) < now["epoch"]] + [now]
        with atomic_write(self.path) as part, part.open("w", newline="") as file:
            table = csv.DictWriter(file, list(dict.fromkeys(key for row in rows for key in row)))
            table.writeheader()
            table.writerows(rows)

    def _kept(self) -> list[dict[str, Any]]:
        if not self.path.is_file():
            return []
        with self.path.open(newline="") as file:
            return list(csv.DictReader(file))


class SeedBatches(Callback):
    """Seeds torch anew for each batch, so that a resumed run draws what an uninterrupted one does."""

    def __init__(self, seed: int, rank: int = 0) -> None:
        self.seed, self.rank = seed, rank

    def on_train_batch_start(
        self, trainer: L.Trainer, pl_module: L.LightningModule, batch: Any, index: int
    ) -> None:
        place = [self.seed, trainer.current_epoch, index, *([self.rank] if self.rank else [])]
        torch.manual_seed(int(np.random.SeedSequence(place).generate_state(1)[0]))


class Speed(Callback):
    """Measures how fast a training is, over the steps of an epoch so far, and the largest memory that it took.

    Attributes:
        seconds: of each optimizer step, of this epoch.
        rate: scans (or points of the head) a second, of all processes together.
    """

    def __init__(self) -> None:
        self.seconds: list[float] = []
        self.rate = 0.0
        self._units = self._steps = 0
        self._begun = self._last = 0.0

    def on_train_epoch_start(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        self.seconds, self._units, self._steps = [], 0, trainer.global_step
        self._begun = self._last = time.perf_counter()

    def on_train_batch_end(
        self, trainer: L.Trainer, pl_module: Any, outputs: Any, batch: Any, batch_idx: int
    ) -> None:
        now = time.perf_counter()
        self._units += pl_module.size_of(batch) * trainer.world_size
        self.rate = self._units / (now - self._begun)
        pl_module.log(f"{pl_module.unit}/s", self.rate, prog_bar=True, batch_size=1)
        if trainer.global_step > self._steps:
            self._steps = trainer.global_step
            self.seconds.append(now - self._last)
            self._last = now

    def left(self, trainer: L.Trainer) -> str:
        """The time that the rest of the training takes at this rate, as h:mm:ss."""
        elapsed, epoch = time.perf_counter() - self._begun, trainer.current_epoch
        done = trainer.fit_loop.epoch_loop.batch_progress.current.completed / max(
            trainer.num_training_batches, 1
        )
        ahead = (trainer.max_epochs or epoch) - epoch - done
        return str(timedelta(seconds=round(ahead * elapsed / done))) if done else "?"

    @property
    def memory(self) -> int:
        """Bytes: the most that was taken on the CUDA device, or else by this process."""
        if torch.cuda.is_available() and torch.cuda.max_memory_allocated():
            return torch.cuda.max_memory_allocated()
        return peak_memory()


class Bar(RichProgressBar):
    """Progress of an epoch with loss, mIoU, scans a second, and the time left of the whole training."""

    def get_metrics(self, trainer: L.Trainer, pl_module: L.LightningModule) -> dict[str, Any]:
        found = super().get_metrics(trainer, pl_module)
        found.pop("v_num", None)
        return {**found, "left": speed_of(trainer).left(trainer)}


class EpochLines(Callback):
    """Says one line an epoch, where there is no terminal for a progress bar."""

    def __init__(self, say: Callable[[str], None], name: str) -> None:
        self.say, self.name = say, name

    def on_train_epoch_end(self, trainer: L.Trainer, pl_module: Any) -> None:
        values = {k: float(v) for k, v in trainer.callback_metrics.items()}
        reached = f"loss {values.get('train/loss', float('nan')):.3f}"
        if "val/miou" in values:
            reached += f", val mIoU {values['val/miou']:.4f} (classes present {values['val/miou_present']:.4f})"
        speed = speed_of(trainer)
        pace = f"{speed.rate:.3g} {pl_module.unit}/s, {speed.left(trainer)} left"
        self.say(
            f"{self.name} epoch {trainer.current_epoch + 1}/{trainer.max_epochs}: {reached}; {pace}"
        )


class Pictures(Callback):
    """Draws some validation scans from above into TensorBoard, as the part that is trained would label them.

    Args:
        scans: with labels.
        label: the (P,) train ids of a batch of one scan.
    """

    def __init__(
        self, scans: Sequence[Scan], taxonomy: Taxonomy, label: Callable[[PointBatch], Tensor]
    ) -> None:
        self.scans, self.taxonomy, self.label = scans, taxonomy, label

    def on_train_epoch_end(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        every = max((trainer.max_epochs or 1) // PICTURED, 1)
        if not trainer.is_global_zero or (trainer.current_epoch + 1) % every:
            return
        part = trained(pl_module)
        part.eval()
        for scan in self.scans:
            self._draw(trainer, scan, next(part.parameters()))
        part.train()

    @torch.no_grad()
    def _draw(self, trainer: L.Trainer, scan: Scan, like: Tensor) -> None:
        ids = np.zeros(len(scan), dtype=np.uint8)
        ids[scan.valid] = (
            self.label(PointBatch.of([scan]).to(like.device).to(like.dtype)).cpu().numpy()
        )
        figure = scan_figure(
            scan.points, self.taxonomy, {"prediction": ids}, scan.labels, title=scan.name
        )
        figure.set_dpi(PICTURE_DOTS)
        assert trainer.logger is not None
        trainer.logger.experiment.add_figure(scan.name, figure, trainer.current_epoch)  # type: ignore[attr-defined]


def speed_of(trainer: L.Trainer) -> Speed:
    """The callback that measures this training."""
    return next(callback for callback in trainer.callbacks if isinstance(callback, Speed))  # type: ignore[attr-defined]


def trained(module: L.LightningModule) -> nn.Module:
    """The part that a stage trains."""
    found = module.trained
    assert isinstance(found, nn.Module)
    return found
