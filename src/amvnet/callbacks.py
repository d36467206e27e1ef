"""What is done in the course of a training: weights and curves are kept, lines said, batches seeded."""

from __future__ import annotations

import csv
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import lightning as L
import numpy as np
import torch
from lightning.pytorch.callbacks import Callback
from torch import nn

from amvnet.data.files import whole_file


@dataclass(frozen=True)
class Kept:
    """Where a stage's run keeps its weights, and what they reached."""

    best: Path
    last: Path


class KeepWeights(Callback):
    """After each epoch writes the trained part as `last`, and as `best` where its mIoU is the highest yet."""

    def __init__(self, write: Callable[[nn.Module, Path, dict[str, float]], None], folder: Path) -> None:
        self.write, self.kept, self.highest = (
            write,
            Kept(folder / "best.safetensors", folder / "last.safetensors"),
            -1.0,
        )

    def state_dict(self) -> dict[str, Any]:
        return {"highest": self.highest}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        self.highest = state_dict["highest"]

    def on_validation_end(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        reached = {k: float(v) for k, v in trainer.callback_metrics.items() if k.startswith("val/")}
        reached["epoch"] = trainer.current_epoch
        self.write(_trained(pl_module), self.kept.last, reached)
        if reached["val/miou"] > self.highest:
            self.highest = reached["val/miou"]
            self.write(_trained(pl_module), self.kept.best, reached)


class Curves(Callback):
    """Keeps the figures of each epoch in a table, one row an epoch; those of a resumed run go on in it."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def on_validation_end(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        now = {"epoch": trainer.current_epoch, **{k: float(v) for k, v in trainer.callback_metrics.items()}}
        rows = [row for row in self._kept() if int(row["epoch"]) < now["epoch"]] + [now]
        with whole_file(self.path) as part, part.open("w", newline="") as file:
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

    def __init__(self, seed: int) -> None:
        self.seed = seed

    def on_train_batch_start(self, trainer: L.Trainer, pl_module: L.LightningModule, batch: Any, index: int) -> None:
        place = np.random.SeedSequence([self.seed, trainer.current_epoch, index])
        torch.manual_seed(int(place.generate_state(1)[0]))


class EpochLines(Callback):
    """Says one line an epoch, where there is no terminal for a progress bar."""

    def __init__(self, say: Callable[[str], None], name: str) -> None:
        self.say, self.name = say, name

    def on_validation_end(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        values = {k: float(v) for k, v in trainer.callback_metrics.items()}
        loss, miou, present = (values.get(k, float("nan")) for k in ("train/loss", "val/miou", "val/miou_present"))
        self.say(
            f"{self.name} epoch {trainer.current_epoch + 1}/{trainer.max_epochs}: "
            f"loss {loss:.3f}, val mIoU {miou:.4f} (classes present {present:.4f})"
        )


def _trained(module: L.LightningModule) -> nn.Module:
    """The part that a stage trains."""
    trained = module.trained
    assert isinstance(trained, nn.Module)
    return trained
