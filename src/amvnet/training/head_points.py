"""What the point head learns from: uncertain points gathered once, then batches of them drawn at random."""

from __future__ import annotations

import functools
import shutil
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor
from torch.utils import data

from amvnet.config.schema import ModelConfig, PointHeadConfig, TrainingConfig
from amvnet.data.datasets.base import Dataset
from amvnet.distributed import ALONE, Processes, device_of
from amvnet.errors import InputError
from amvnet.evaluation.metrics import confusion
from amvnet.models.assertions import Assertion, build_assertion
from amvnet.models.methods import geometric_mean
from amvnet.models.point_head import POINT_VALUES, head_features, nearest_neighbours, point_table
from amvnet.models.views.points import PointBatch
from amvnet.scan import Scan
from amvnet.training.head_scores import ScoreSource
from amvnet.training.loaders import ScanSet, collate

# p_i (U, 2 K + 4), S_i (U, n, 2 K + 4), train ids (U,), and for how many points of its scan each stands (U,)
HeadBatch = tuple[Tensor, Tensor, Tensor, Tensor]


def row_of(classes: int, neighbours: int) -> np.dtype:
    """What is kept of a point."""
    width = 2 * classes + POINT_VALUES
    return np.dtype(
        [
            ("point", np.float16, width),
            ("rows", np.float16, (neighbours, width)),
            ("labels", np.uint8),
            ("stands_for", np.float32),
        ]
    )


@dataclass(frozen=True)
class HeadPoints:
    """The labelled uncertain points of some scans as the head sees them, and what is known of the others.

    Attributes:
        path: the file of U rows of `row_of`.
        row: their type.
        size: U.
        certain: (K + 1, K + 1) confusion matrix of the ensemble over the points that are certain.
        uncertain: share of the labelled points that are not.
    """

    path: Path
    row: np.dtype
    size: int
    certain: np.ndarray
    uncertain: float

    def __len__(self) -> int:
        return self.size

    def __getitem__(self, index: np.ndarray) -> HeadBatch:
        """The points of some indices, in this order."""
        found = np.memmap(self.path, self.row, "r", shape=(self.size,))[index]
        point, rows, labels, stands_for = (
            torch.from_numpy(found[name].copy()) for name in self.row.names or ()
        )
        return point.float(), rows.float(), labels.long(), stands_for


class PointSampler(data.Sampler[np.ndarray]):
    """Batches of indices; for training in an order drawn from (seed, epoch), and without a last small batch.

    Of several processes each takes its part of every batch.
    """

    def __init__(
        self, size: int, batch: int, seed: int, shuffle: bool, processes: Processes = ALONE
    ) -> None:
        self.size, self.batch, self.seed, self.shuffle, self.epoch = size, batch, seed, shuffle, 0
        self.processes = processes

    def set_epoch(self, epoch: int) -> None:
        self.epoch = epoch

    def __len__(self) -> int:
        # Batch norm learns nothing good of a last batch of a few points.
        return max(self.size // self.batch, 1) if self.shuffle else -(-self.size // self.batch)

    def __iter__(self) -> Iterator[np.ndarray]:
        rng = np.random.default_rng([self.seed, self.epoch])
        order = rng.permutation(self.size) if self.shuffle else np.arange(self.size)
        for i in range(len(self)):
            yield order[i * self.batch : (i + 1) * self.batch][
                self.processes.rank :: self.processes.size
            ]


def make_head_loader(
    points: HeadPoints, batch: int, seed: int, shuffle: bool, processes: Processes = ALONE
) -> data.DataLoader[HeadBatch]:
    """Batches of uncertain points, of each process its own part."""
    sampler = PointSampler(len(points), batch, seed, shuffle, processes)
    return data.DataLoader(points, batch_size=None, sampler=sampler)  # type: ignore[arg-type]


def gather_points(
    sources: Sequence[ScoreSource],
    dataset: Dataset,
    model: ModelConfig,
    training: TrainingConfig,
    views: int,
    folder: Path,
    say: Callable[[str], None] = lambda line: None,
    processes: Processes = ALONE,
) -> HeadPoints:
    """Score scans by two models, and keep on disk what the head needs of their uncertain points.

    Args:
        sources: what scores which scans.
        model: says which points are uncertain, and what the head sees of them.
        views: how often each scan is scored, each time augmented anew; 0: once, as it is. Of sources that only
            know the scans as they are: once.
        folder: is made anew; all processes must see it.
        say: told how far it is.

    Where the networks agree everywhere, as they do before they have learnt anything, points are drawn from all.

    Raises:
        InputError: where the scans have no labelled points.
    """
    views = views if all(source.augmented for source in sources) else 0
    gather = functools.partial(
        _gather, sources, dataset, model.point_head, training, views, folder, say, processes
    )
    found, least = (
        gather(build_assertion(model.assertion)),
        max(2, processes.size),
    )  # batch norm needs two
    if len(found) < least:
        say("head: the networks agree everywhere; it learns from points drawn from all")
        found = gather(_everywhere)
    if len(found) < least:
        raise InputError(
            f"{folder}: expected labelled points to train the head with, found none; name other scans"
        )
    return found


def _everywhere(f: Tensor, g: Tensor, points: Tensor, labels: Tensor | None = None) -> Tensor:
    """The assertion that doubts every point."""
    return torch.ones(len(f), dtype=torch.bool, device=f.device)


def _gather(
    sources: Sequence[ScoreSource],
    dataset: Dataset,
    config: PointHeadConfig,
    training: TrainingConfig,
    views: int,
    folder: Path,
    say: Callable[[str], None],
    processes: Processes,
    assertion: Assertion,
) -> HeadPoints:
    """As `gather_points`, of the points that an assertion doubts."""
    _empty(folder, processes)
    classes, device = dataset.taxonomy.size, device_of(training.accelerator)
    row, matrices = (
        row_of(classes, config.neighbours),
        np.zeros((2, classes + 1, classes + 1), dtype=np.int64),
    )
    jobs = [
        (s, *job)
        for s, one in enumerate(sources)
        for job in np.ndindex(max(views, 1), len(one.records))
    ]
    sets = [
        ScanSet(dataset, one.records, training.augment if views else None, training.seed)
        for one in sources
    ]
    scorer_of = functools.lru_cache(1)(lambda s: sources[s].scorer(device))
    most, counts, mine = -(-training.head.points // len(jobs)), [], processes.share(jobs)
    with (folder / str(processes.rank)).open("wb") as file:
        for done, (source, epoch, place) in enumerate(mine, start=1):
            rng, scan = (
                np.random.default_rng([training.seed, epoch, place]),
                sets[source][epoch, place],
            )
            score = functools.partial(scorer_of(source), sources[source].records[place], scan)
            rows, matrix = _gather_scan(score, config, assertion, scan, most, row, rng, device)
            rows.tofile(file)
            counts.append(len(rows))
            matrices += matrix
            if done * 10 // len(mine) != (done - 1) * 10 // len(mine):
                say(f"head: scored {done * len(jobs) // len(mine)} of {len(jobs)} scans")
    by_rank = processes.gather((counts, matrices))
    path = _join(folder, [one for one, _ in by_rank], row, processes)
    certain, uncertain = np.sum([one for _, one in by_rank], axis=0)
    share = float(uncertain.sum() / max(certain[1:].sum() + uncertain.sum(), 1))
    return HeadPoints(path, row, sum(sum(one) for one, _ in by_rank), certain, share)


def _empty(folder: Path, processes: Processes) -> None:
    if processes.first:
        shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir(parents=True)
    processes.wait()


def _join(
    folder: Path, counts: Sequence[Sequence[int]], row: np.dtype, processes: Processes
) -> Path:
    """One file of the rows of all processes, in the order of the scans, which they took in turns."""
    path = folder / "points"
    if processes.first:
        with ExitStack() as stack, path.open("wb") as joined:
            parts = [
                stack.enter_context((folder / str(rank)).open("rb")) for rank in range(len(counts))
            ]
            for place in range(sum(map(len, counts))):
                turn, rank = divmod(place, len(counts))
                joined.write(parts[rank].read(counts[rank][turn] * row.itemsize))
        for part in parts:
            Path(part.name).unlink()
    processes.wait()
    return path


@torch.inference_mode()
def _gather_scan(
    score: Callable[[PointBatch], tuple[Tensor, Tensor]],
    config: PointHeadConfig,
    assertion: Assertion,
    scan: Scan,
    most: int,
    row: np.dtype,
    rng: np.random.Generator,
    device: str,
) -> tuple[np.ndarray, np.ndarray]:
    """The rows of one scan's kept points, and (2, K + 1, K + 1) of the ensemble: its certain points, and the others."""
    batch, labels = collate([scan])
    batch, labels = batch.to(device), labels.to(device)
    f, g = score(batch)
    uncertain = assertion(f, g, batch.points, labels) & (labels > 0)
    agreed = (geometric_mean(f, g).argmax(dim=1) + 1).cpu().numpy()
    truth, doubted = labels.cpu().numpy(), uncertain.cpu().numpy()
    matrices = np.stack(
        [confusion(truth[kept], agreed[kept], f.shape[1]) for kept in (~doubted, doubted)]
    )
    index = uncertain.nonzero()[:, 0]
    chosen = rng.permutation(len(index))[:most]
    stands_for = len(index) / max(len(chosen), 1)
    index = index[torch.from_numpy(np.sort(chosen)).to(device)]
    near = nearest_neighbours(batch.points, index, config.neighbours)
    point, near_rows = head_features(config, point_table(batch.points, f, g), index, near)
    found = np.empty(len(index), dtype=row)
    for name, values in (("point", point), ("rows", near_rows), ("labels", labels[index])):
        found[name] = values.cpu().numpy()
    found["stands_for"] = stands_for
    return found, matrices
