"""Gather the uncertain points that the point head learns from, and load them in random batches.

The points are gathered once, before the first epoch. Sections 3.2 and 3.3 of the paper define them.
"""

from __future__ import annotations

import shutil
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import product
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from amvnet.config.schema import HeadTraining
from amvnet.data.datasets.training_data import TrainingData
from amvnet.data.recordings import ScanFile
from amvnet.errors import InputError
from amvnet.evaluation.metrics import confusion
from amvnet.inference.scores import LEAST_PROBABILITY
from amvnet.models.assertion import Assertion, Disagreement
from amvnet.models.methods import geometric_mean
from amvnet.models.point_head import POINT_VALUES, head_features, nearest_neighbours, point_table
from amvnet.models.views.points import PointBatch
from amvnet.progress import Reporter, Tenths, report_nothing
from amvnet.runtime.distributed import ALONE, Processes, device_of
from amvnet.scan import Scan
from amvnet.training.augment import disturb
from amvnet.training.loaders import EpochOrder, Key, ScanSet, collate
from amvnet.training.plan import Plan
from amvnet.weights.file import Weights

# Takes a scan and the batch of its P valid points. Returns the probabilities f and g, (P, K).
Scorer = Callable[[ScanFile, Scan, PointBatch], tuple[Tensor, Tensor]]

# U uncertain points: their features p_i (U, 2 K + 4), the features of their neighbours S_i
# (U, n, 2 K + 4), their train ids (U,), and the number of uncertain points of its scan that each
# stands for (U,). Only some of the uncertain points of a scan are drawn.
HeadBatch = tuple[Tensor, Tensor, Tensor, Tensor]


@dataclass(eq=False)
class HeadPoints:
    """The labelled uncertain points of some scans on disk, and statistics of all labelled points.

    Attributes:
        paths: the files of the points, one for each process that scored scans.
        files: (U,) index of each point's file. The points of a file are in the same order here.
        labels: (U,) train ids of the points.
        certain: (K + 1, K + 1) confusion matrix of the ensemble over the certain points.
        uncertain_share: share of the labelled points that are uncertain, in [0, 1].
        are_uncertain: whether the points are uncertain. If the networks agree everywhere, they are
            points of all kinds, for which AMVNet takes the labels of the ensemble.
    """

    paths: Sequence[Path]
    dtype: np.dtype
    files: np.ndarray
    labels: np.ndarray
    certain: np.ndarray
    uncertain_share: float
    are_uncertain: bool = True

    def __post_init__(self) -> None:
        self._rows = np.empty(len(self.files), np.int64)  # the place of each point in its file
        for number in range(len(self.paths)):
            is_here = self.files == number
            self._rows[is_here] = np.arange(np.count_nonzero(is_here))

    def __len__(self) -> int:
        return len(self.labels)

    def __getitem__(self, index: np.ndarray) -> HeadBatch:
        points = np.empty(len(index), dtype=self.dtype)
        for number, path in enumerate(self.paths):
            is_here = self.files[index] == number
            if is_here.any():
                on_disk = np.memmap(path, self.dtype, "r")
                points[is_here] = on_disk[self._rows[index[is_here]]]

        point = torch.from_numpy(points["point"].copy())
        rows = torch.from_numpy(points["rows"].copy())
        labels = torch.from_numpy(self.labels[index])
        stands_for = torch.from_numpy(points["stands_for"].copy())
        return point.float(), rows.float(), labels.long(), stands_for


class PointSampler(EpochOrder):
    """Draws the batches of an epoch from the points on disk, different points in each epoch.

    If there are several processes, each takes its part of every batch. A last batch that is not
    full is left out, because the statistics of a few points would harm batch norm.

    Args:
        config: the number of points in a batch and in an epoch. To balance the classes, a point of
            a class with n points is drawn with a probability proportional to n ** -balance. It may
            then be drawn several times.
    """

    def __init__(
        self, labels: np.ndarray, config: HeadTraining, seed: int, processes: Processes = ALONE
    ) -> None:
        super().__init__(seed, processes)
        self.size = len(labels)
        self.drawn = min(config.drawn or self.size, self.size)
        self.batch = config.batch
        self.cumulative: np.ndarray | None = None
        if config.balance > 0:
            weights = np.bincount(labels)[labels] ** -config.balance
            self.cumulative = np.cumsum(weights / weights.sum())

    def __len__(self) -> int:
        return max(self.drawn // self.batch, 1)

    def __iter__(self) -> Iterator[np.ndarray]:
        order = self._draw(self.rng())
        for number in range(len(self)):
            batch = order[number * self.batch : (number + 1) * self.batch]
            yield batch[self.processes.rank :: self.processes.size]

    def _draw(self, rng: np.random.Generator) -> np.ndarray:
        """Return the (D,) indices of the points of an epoch, in a random order."""
        if self.cumulative is None:
            return rng.permutation(self.size)[: self.drawn]

        index = np.searchsorted(self.cumulative, rng.random(self.drawn), side="right")
        return np.minimum(index, self.size - 1)


@dataclass(frozen=True)
class PointGatherer:
    """Scores scans by two networks, and keeps their uncertain points on disk for the head.

    Attributes:
        plan: the plan of the run. All its processes must see the folder of the points. If it has
            the scores of two other models, these are used instead of the networks.
    """

    plan: Plan
    weights: Weights

    def gather(
        self,
        data: TrainingData,
        folder: Path,
        views: int = 0,
        tau: float = 0.0,
        report: Reporter = report_nothing,
    ) -> HeadPoints:
        """Gather the labelled uncertain points of some scans.

        Networks that have learnt nothing yet agree everywhere. The points are then drawn from all
        labelled points instead.

        Args:
            folder: the folder that receives the points. Its earlier content is removed.
            views: how many times each scan is scored, each time with another augmentation. If it is
                0, or the scores come from other models, each scan is taken once and unchanged.
            tau: the threshold of the assertion; 0 takes the threshold of the model.

        Raises:
            InputError: if the scans have too few labelled points.
        """
        training = self.plan.recipe.training
        if self.plan.scores is not None:
            views = 0
        augment = training.augment if views > 0 else None
        scans = ScanSet(data, self.weights.expects, augment, training.seed)
        keys = list(product(range(max(views, 1)), range(len(scans))))
        least = max(2, self.plan.processes.size)  # batch norm needs two points, a process one

        assertion = Disagreement(tau or self.weights.model.assertion.threshold)
        points = self._gather(scans, keys, folder, assertion, report)
        if len(points) < least:
            report("head: the networks agree everywhere, so it learns from all kinds of points")
            agreed = points
            points = self._gather(scans, keys, folder, _everywhere, report)
            points.uncertain_share = agreed.uncertain_share
            points.certain = agreed.certain
            points.are_uncertain = False

        if len(points) < least:
            raise InputError(
                f"{folder}: expected at least {least} labelled points for the head, "
                f"found {len(points)}; name other scans"
            )
        return points

    def _scorer(self) -> Scorer:
        if self.plan.scores is not None:
            return self._read_scores
        model = self.plan.build(self.weights).to(self._device)

        def score(record: ScanFile, scan: Scan, batch: PointBatch) -> tuple[Tensor, Tensor]:
            return model.score(*model.project(batch))

        return score

    def _read_scores(
        self, record: ScanFile, scan: Scan, batch: PointBatch
    ) -> tuple[Tensor, Tensor]:
        assert self.plan.scores is not None
        classes = self.weights.taxonomy.size
        f, g = self.plan.scores.read(Path(record.prediction), scan, classes)
        f_valid = torch.from_numpy(f[scan.valid]).clamp_min(LEAST_PROBABILITY)
        g_valid = torch.from_numpy(g[scan.valid]).clamp_min(LEAST_PROBABILITY)
        return f_valid.to(self._device), g_valid.to(self._device)

    def _gather(
        self,
        scans: ScanSet,
        keys: Sequence[Key],
        folder: Path,
        assertion: Assertion,
        report: Reporter,
    ) -> HeadPoints:
        """Gather the uncertain points of some views (number of a view, index of a scan)."""
        processes = self.plan.processes
        if processes.first:
            shutil.rmtree(folder, ignore_errors=True)
            folder.mkdir(parents=True)
        processes.wait()

        # Score this process's share of the scans.
        ids = self.weights.taxonomy.size + 1
        matrices = np.zeros((2, ids, ids), dtype=np.int64)
        labels_of_scans = []
        share = processes.share(keys)
        limit = self.plan.recipe.training.head.points
        points_per_scan = -(-limit // len(keys))  # rounded up
        scorer = self._scorer()
        tenths = Tenths()

        with (folder / str(processes.rank)).open("wb") as file:
            for number, key in enumerate(share, start=1):
                points, labels, scan_matrices = self._gather_scan(
                    scans, key, scorer, assertion, points_per_scan
                )
                file.write(points.tobytes())
                labels_of_scans.append(labels)
                matrices += scan_matrices
                if tenths.ends(number, len(share)):
                    report(f"head: scored {number * len(keys) // len(share)} of {len(keys)} scans")

        # Put the points in the order of the scans, which the processes have taken in turns.
        labels_by_rank = processes.gather(labels_of_scans)
        ordered = []
        files = []
        for index in range(len(keys)):
            turn, rank = divmod(index, processes.size)
            ordered.append(labels_by_rank[rank][turn])
            files.append(np.full(len(ordered[-1]), rank))

        certain, uncertain = np.sum(processes.gather(matrices), axis=0)
        labelled = certain[1:].sum() + uncertain.sum()
        return HeadPoints(
            paths=[folder / str(rank) for rank in range(processes.size)],
            dtype=self._dtype,
            files=np.concatenate(files),
            labels=np.concatenate(ordered),
            certain=certain,
            uncertain_share=float(uncertain.sum() / max(labelled, 1)),
        )

    @torch.inference_mode()
    def _gather_scan(
        self, scans: ScanSet, key: Key, scorer: Scorer, assertion: Assertion, points_per_scan: int
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Score one scan, and draw at most `points_per_scan` of its uncertain points.

        Returns:
            (U,) points, their (U,) uint8 train ids, and two confusion matrices of the ensemble,
            (2, K + 1, K + 1): over the certain points of the scan, and over all uncertain points.
        """
        device = self._device
        seeds = [self.plan.recipe.training.seed, *key]
        scan = scans[key]
        batch, labels, _ = collate([scan])
        batch = batch.to(device)
        labels = labels.to(device)

        f, g = scorer(scans.scans.train[key[1]], scan, batch)
        if scans.augment is not None:
            chance = self.plan.recipe.training.head.disturb
            rng = np.random.default_rng([*seeds, 1])
            f = disturb(f, batch.points, rng) if rng.random() < chance else f
            g = disturb(g, batch.points, rng) if rng.random() < chance else g
        uncertain = assertion(f, g, batch.points) & (labels > 0)
        matrices = _ensemble_matrices(f, g, labels, uncertain)

        candidates = uncertain.nonzero()[:, 0]
        rng = np.random.default_rng(seeds)
        drawn = np.sort(rng.permutation(len(candidates))[:points_per_scan])
        index = candidates[torch.from_numpy(drawn).to(device)]

        config = self.weights.model.point_head
        near = nearest_neighbours(batch.points, index, config.neighbours)
        point, rows = head_features(config, point_table(batch.points, f, g), index, near)

        points = np.empty(len(index), dtype=self._dtype)
        points["point"] = point.cpu().numpy()
        points["rows"] = rows.cpu().numpy()
        points["stands_for"] = len(candidates) / max(len(index), 1)
        return points, labels[index].cpu().numpy().astype(np.uint8), matrices

    @property
    def _device(self) -> str:
        return device_of(self.plan.recipe.training.accelerator)

    @property
    def _dtype(self) -> np.dtype:
        """The type of a point on disk; see `HeadBatch`."""
        width = 2 * self.weights.taxonomy.size + POINT_VALUES
        neighbours = self.weights.model.point_head.neighbours
        return np.dtype(
            [
                ("point", np.float16, width),
                ("rows", np.float16, (neighbours, width)),
                ("stands_for", np.float32),
            ]
        )


def _everywhere(f: Tensor, g: Tensor, points: Tensor) -> Tensor:
    """Return (P,) True: an `Assertion` that finds every point uncertain."""
    return torch.ones(len(f), dtype=torch.bool, device=f.device)


def _ensemble_matrices(f: Tensor, g: Tensor, labels: Tensor, uncertain: Tensor) -> np.ndarray:
    """Return (2, K + 1, K + 1) int64 confusion matrices of the ensemble of f and g (P, K).

    The first is over the certain points, the second over the uncertain ones.
    """
    prediction = (geometric_mean(f, g).argmax(dim=1) + 1).cpu().numpy()
    truth = labels.cpu().numpy()
    mask = uncertain.cpu().numpy()

    classes = f.shape[1]
    over_certain = confusion(truth[~mask], prediction[~mask], classes)
    over_uncertain = confusion(truth[mask], prediction[mask], classes)
    return np.stack([over_certain, over_uncertain])
