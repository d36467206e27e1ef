"""The training of the point head: uncertain points gathered once, then batches of them drawn at random."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Iterator, Sequence
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
from amvnet.models.assertions import Assertion
from amvnet.models.point_head import PointHead, head_features, nearest_neighbours, point_table
from amvnet.scan import Scan
from amvnet.training import Stage
from amvnet.weights import Weights

COLUMNS = {"point": np.float16, "rows": np.float16, "labels": np.uint8, "stands_for": np.float32}
# p_i (U, 2 K + 4), S_i (U, n, 2 K + 4), train ids (U,), and for how many points of its scan each stands (U,)
HeadBatch = tuple[Tensor, Tensor, Tensor, Tensor]


class HeadStage(Stage):
    """Stage `head`: the networks are frozen, in that only their scores are here."""

    name = "head"
    config: HeadTraining

    def __init__(self, head: PointHead, certain: np.ndarray, *args: Any) -> None:
        super().__init__(*args)
        self.trained, self.certain = head, certain

    def training_step(self, batch: HeadBatch, index: int) -> Tensor:
        point, rows, labels, _ = batch
        loss = F.cross_entropy(self.trained(point, rows), labels - 1, self.class_weights)
        self.log("train/loss", loss, prog_bar=True, batch_size=len(labels))
        return loss

    def on_validation_epoch_start(self) -> None:
        self.matrix = self.certain.astype(float)

    def validation_step(self, batch: HeadBatch, index: int) -> None:
        point, rows, labels, stands_for = batch
        found = self.trained(point, rows).argmax(dim=1) + 1
        size = len(self.matrix)
        place = (labels * size + found).cpu().numpy()
        self.matrix += np.bincount(place, stands_for.cpu().numpy(), size**2).reshape(size, size)

    def configure_optimizers(self) -> Any:
        c = self.config
        parameters = self.trained.parameters()
        return self.one_cycle(torch.optim.SGD(parameters, c.lr, c.momentum, weight_decay=c.weight_decay), c.momentum)


@dataclass(frozen=True)
class HeadPoints:
    """The labelled uncertain points of some scans as the head sees them, and what is known of the others.

    Attributes:
        folder: holds p_i, S_i and labels of U points, column by column, on disk.
        certain: (K + 1, K + 1) confusion matrix of the ensemble over the points that are certain.
        shapes: of each column.
    """

    folder: Path
    certain: np.ndarray
    shapes: dict[str, tuple[int, ...]]

    def __len__(self) -> int:
        return self.shapes["labels"][0]

    def __getitem__(self, index: np.ndarray) -> HeadBatch:
        """The points of some indices, in this order."""
        point, rows, labels, stands_for = (
            torch.from_numpy(np.memmap(self.folder / name, kind, "r", shape=self.shapes[name])[index])
            for name, kind in COLUMNS.items()
        )
        return point.float(), rows.float(), labels.long(), stands_for


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
    say: Callable[[str], None] = lambda line: None,
) -> HeadPoints:
    """Score scans by frozen networks, and keep on disk what the head needs of their uncertain points.

    Args:
        sources: networks, and the scans that they score.
        views: how often each scan is scored, each time augmented anew; 0: once, as it is.
        folder: is made anew.
        say: told how far it is.

    Where the networks agree everywhere, as they do before they have learnt anything, points are drawn from all.

    Raises:
        InputError: where the scans have no labelled points.
    """
    found = _gather(sources, dataset, training, views, folder, say, lambda model: model.assertion)
    if len(found) < 2:
        say("head: the networks agree everywhere; it learns from points drawn from all")
        found = _gather(sources, dataset, training, views, folder, say, lambda model: _everywhere)
    if len(found) < 2:  # batch norm needs two
        raise InputError(f"{folder}: expected labelled points to train the head with, found none; name other scans")
    return found


def _everywhere(f: Tensor, g: Tensor, points: Tensor, labels: Tensor | None = None) -> Tensor:
    """The assertion that doubts every point."""
    return torch.ones(len(f), dtype=torch.bool, device=f.device)


def _gather(
    sources: Sequence[tuple[Weights, Sequence[ScanRecord]]],
    dataset: Dataset,
    training: TrainingConfig,
    views: int,
    folder: Path,
    say: Callable[[str], None],
    assertion_of: Callable[[AMVNet], Assertion],
) -> HeadPoints:
    """As `gather_points`, of the points that an assertion doubts."""
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    size = dataset.taxonomy.size
    certain, done = np.zeros((size + 1, size + 1), dtype=np.int64), 0
    total = max(views, 1) * sum(len(records) for _, records in sources)
    most = -(-training.head.points // total)
    shapes: dict[str, tuple[int, ...]] = dict.fromkeys(COLUMNS, (0,))
    for weights, records in sources:
        model = weights.build().to(_device(training.accelerator))
        scans = ScanSet(dataset, records, training.augment if views else None, training.seed)
        for epoch, place in np.ndindex(max(views, 1), len(scans)):
            rng = np.random.default_rng([training.seed, epoch, place])
            config, assertion = weights.model.point_head, assertion_of(model)
            columns, matrix = _gather_scan(model, config, assertion, scans[epoch, place], most, size, rng)
            shapes = {name: _append(folder / name, values, shapes[name]) for name, values in columns.items()}
            certain, done = certain + matrix, done + 1
            if done * 10 // total != (done - 1) * 10 // total:
                say(f"head: scored {done} of {total} scans")
    return HeadPoints(folder, certain, shapes)


def _device(accelerator: str) -> str:
    """Where the networks score for the head, by Lightning's name of the accelerator."""
    return "cuda" if accelerator in ("auto", "gpu", "cuda") and torch.cuda.is_available() else "cpu"


@torch.inference_mode()
def _gather_scan(
    model: AMVNet,
    config: PointHeadConfig,
    assertion: Assertion,
    scan: Scan,
    most: int,
    size: int,
    rng: np.random.Generator,
) -> tuple[dict[str, np.ndarray], np.ndarray]:
    """The columns of one scan's kept points, and the confusion of its certain ones."""
    device = next(model.parameters()).device
    batch, labels = collate([scan])
    batch, labels = batch.to(device), labels.to(device)
    f, g = model.score_range_view(batch), model.score_polar_view(batch)
    uncertain = assertion(f, g, batch.points, labels) & (labels > 0)
    agreed = geometric_mean(f, g).argmax(dim=1) + 1
    matrix = confusion(labels[~uncertain].cpu().numpy(), agreed[~uncertain].cpu().numpy(), size)
    index = uncertain.nonzero()[:, 0]
    chosen = rng.permutation(len(index))[:most]
    stands_for = np.full(len(chosen), len(index) / max(len(chosen), 1))
    index = index[torch.from_numpy(np.sort(chosen)).to(device)]
    near = nearest_neighbours(batch.points, index, config.neighbours)
    point, rows = head_features(config, point_table(batch.points, f, g), index, near)
    found = {"point": point, "rows": rows, "labels": labels[index]}
    return {**{name: values.cpu().numpy() for name, values in found.items()}, "stands_for": stands_for}, matrix


def _append(path: Path, values: np.ndarray, shape: tuple[int, ...]) -> tuple[int, ...]:
    with path.open("ab") as file:
        values.astype(COLUMNS[path.name]).tofile(file)
    return (shape[0] + len(values), *values.shape[1:])
