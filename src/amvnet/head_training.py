"""The training of the point head: uncertain points gathered once, then batches of them drawn at random."""

from __future__ import annotations

import shutil
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional as F
from torch.utils import data

from amvnet.config import HeadTraining, PointHeadConfig, TrainingConfig
from amvnet.data.records import Dataset, ScanRecord
from amvnet.errors import InputError
from amvnet.evaluation import confusion
from amvnet.loading import ScanSet, collate
from amvnet.models.amvnet import AMVNet, geometric_mean
from amvnet.models.point_head import PointHead, head_features, nearest_neighbours
from amvnet.training import Stage
from amvnet.views.points import PointBatch
from amvnet.weights import Weights

COLUMNS = {"point": np.float16, "rows": np.float16, "labels": np.uint8}
HeadBatch = tuple[Tensor, Tensor, Tensor]  # p_i (U, 2 K + 4), S_i (U, n, 2 K + 4), train ids (U,)


class HeadStage(Stage):
    """Stage `head`: the networks are frozen, in that only their scores are here."""

    part = "point_head"
    config: HeadTraining

    def __init__(self, head: PointHead, certain: np.ndarray, share: float, *args: Any) -> None:
        super().__init__(*args)
        self.trained, self.certain, self.share = head, certain, share

    def training_step(self, batch: HeadBatch, _: int) -> Tensor:
        point, rows, labels = batch
        loss = F.cross_entropy(self.trained(point, rows), labels - 1, self.class_weights)
        self.log("train/loss", loss, prog_bar=True, batch_size=len(labels))
        return loss

    def on_validation_epoch_start(self) -> None:
        self.matrix = self.certain.astype(float)

    def validation_step(self, batch: HeadBatch, _: int) -> None:
        point, rows, labels = batch
        self.count(labels, self.trained(point, rows).argmax(dim=1) + 1, self.share)

    def configure_optimizers(self) -> Any:
        c = self.config
        parameters = self.trained.parameters()
        return self.one_cycle(torch.optim.SGD(parameters, c.lr, c.momentum, weight_decay=c.weight_decay))


@dataclass(frozen=True)
class HeadPoints:
    """The labelled uncertain points of some scans as the head sees them, and what is known of the others.

    Attributes:
        folder: holds p_i, S_i and labels of U points, column by column, on disk.
        certain: (K + 1, K + 1) confusion matrix of the ensemble over the points that are certain.
        share: how many uncertain points each kept one stands for.
        shapes: of each column.
    """

    folder: Path
    certain: np.ndarray
    share: float
    shapes: dict[str, tuple[int, ...]]

    def __len__(self) -> int:
        return self.shapes["labels"][0]

    def __getitem__(self, index: np.ndarray) -> HeadBatch:
        """The points of some indices, in this order."""
        point, rows, labels = (
            np.memmap(self.folder / name, kind, "r", shape=self.shapes[name])[index] for name, kind in COLUMNS.items()
        )
        return torch.from_numpy(point).float(), torch.from_numpy(rows).float(), torch.from_numpy(labels).long()


class PointSampler(data.Sampler[np.ndarray]):
    """Batches of indices; for training in an order drawn from (seed, epoch), and without a last small batch."""

    def __init__(self, size: int, batch: int, seed: int, shuffle: bool) -> None:
        self.size, self.batch, self.seed, self.shuffle, self.epoch = size, batch, seed, shuffle, 0

    def set_epoch(self, epoch: int) -> None:
        self.epoch = epoch

    def __len__(self) -> int:
        # Batch norm learns nothing good of a last batch of a few points.
        return max(self.size // self.batch, 1) if self.shuffle else -(-self.size // self.batch)

    def __iter__(self) -> Iterator[np.ndarray]:
        rng = np.random.default_rng([self.seed, self.epoch])
        order = rng.permutation(self.size) if self.shuffle else np.arange(self.size)
        for i in range(len(self)):
            yield order[i * self.batch : (i + 1) * self.batch]


def head_loader(points: HeadPoints, batch: int, seed: int, shuffle: bool) -> data.DataLoader[HeadBatch]:
    """Batches of uncertain points."""
    sampler = PointSampler(len(points), batch, seed, shuffle)
    return data.DataLoader(points, batch_size=None, sampler=sampler)  # type: ignore[arg-type]


def gather_points(
    sources: Sequence[tuple[Weights, Sequence[ScanRecord]]],
    dataset: Dataset,
    training: TrainingConfig,
    views: int,
    folder: Path,
) -> HeadPoints:
    """Score scans by frozen networks, and keep on disk what the head needs of their uncertain points.

    Args:
        sources: networks, and the scans that they score.
        views: how often each scan is scored, each time augmented anew; 0: once, as it is.
        folder: is made anew.

    Raises:
        InputError: where the networks agree everywhere.
    """
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    size = dataset.taxonomy.size
    certain, found = np.zeros((size + 1, size + 1), dtype=np.int64), 0
    shapes: dict[str, tuple[int, ...]] = dict.fromkeys(COLUMNS, (0,))
    for weights, records in sources:
        model = weights.build()
        scans = ScanSet(dataset, records, training.augment if views else None, training.seed)
        for epoch, place in np.ndindex(max(views, 1), len(scans)):
            rng = np.random.default_rng([training.seed, epoch, place])
            batch, labels = collate([scans[epoch, place]])
            columns, matrix, uncertain = _gather_scan(
                model, weights.model.point_head, batch, labels, training.head.points_per_scan, size, rng
            )
            shapes = {name: _append(folder / name, values, shapes[name]) for name, values in columns.items()}
            certain, found = certain + matrix, found + uncertain
    if not found:
        raise InputError(f"{folder}: expected points that the networks disagree on, found none; raise the threshold")
    return HeadPoints(folder, certain, found / shapes["labels"][0], shapes)


@torch.inference_mode()
def _gather_scan(
    model: AMVNet,
    config: PointHeadConfig,
    batch: PointBatch,
    labels: Tensor,
    most: int,
    size: int,
    rng: np.random.Generator,
) -> tuple[dict[str, np.ndarray], np.ndarray, int]:
    """The columns of one scan's kept points, the confusion of its certain ones, the number of uncertain ones."""
    f, g = model.score_range_view(batch), model.score_polar_view(batch)
    uncertain = model.assertion(f, g, batch.points, labels) & (labels > 0)
    agreed = geometric_mean(f, g).argmax(dim=1) + 1
    matrix = confusion(labels[~uncertain].numpy(), agreed[~uncertain].numpy(), size)
    index = uncertain.nonzero()[:, 0]
    chosen = rng.permutation(len(index))[:most]
    index = index[torch.from_numpy(np.sort(chosen))]
    near = nearest_neighbours(batch.points, index, config.neighbours)
    point, rows = head_features(config, batch.points, f, g, index, near)
    columns = {"point": point.numpy(), "rows": rows.numpy(), "labels": labels[index].numpy()}
    return columns, matrix, int(uncertain.sum())


def _append(path: Path, values: np.ndarray, shape: tuple[int, ...]) -> tuple[int, ...]:
    with path.open("ab") as file:
        values.astype(COLUMNS[path.name]).tofile(file)
    return (shape[0] + len(values), *values.shape[1:])
