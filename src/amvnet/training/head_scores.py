"""The scores that the point head learns from: of frozen networks, or of two models in files."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar, Protocol

import torch
from torch import Tensor

from amvnet.data.datasets.base import ScanRecord
from amvnet.errors import InputError
from amvnet.inference.scores import SURE, ScorePair
from amvnet.models.point_head import PointHead
from amvnet.models.views.points import PointBatch
from amvnet.scan import Scan
from amvnet.weights.file import Weights

# Takes a scan and the batch of its P valid points; returns f and g, (P, K).
Scorer = Callable[[ScanRecord, Scan, PointBatch], tuple[Tensor, Tensor]]


class ScoreSource(Protocol):
    """Gives f and g of some scans.

    Attributes:
        records: the scans.
        augmented: whether it can score augmented scans too.
    """

    @property
    def records(self) -> Sequence[ScanRecord]: ...

    @property
    def augmented(self) -> bool: ...

    def scorer(self, device: str) -> Scorer:
        """Return what scores a scan on a device."""


@dataclass(frozen=True)
class NetworkScores:
    """Frozen networks, and the scans that they score.

    Attributes:
        weights: the networks.
        records: the scans.
        by_ring: whether `ring` of the scans is the row of each point in the range image.
    """

    weights: Weights
    records: Sequence[ScanRecord]
    by_ring: bool = False
    augmented: ClassVar[bool] = True

    def scorer(self, device: str) -> Scorer:
        model = self.weights.build().to(device)
        if self.by_ring:
            model.range_view = model.range_view.by_ring()

        def score(record: ScanRecord, scan: Scan, batch: PointBatch) -> tuple[Tensor, Tensor]:
            return model.score(*model.project(batch))

        return score


@dataclass(frozen=True)
class FileScores:
    """Two other models' scores in files, of scans without augmentation."""

    pair: ScorePair
    records: Sequence[ScanRecord]
    classes: int
    augmented: ClassVar[bool] = False

    def scorer(self, device: str) -> Scorer:
        def score(record: ScanRecord, scan: Scan, batch: PointBatch) -> tuple[Tensor, Tensor]:
            f, g = self.pair.read(Path(record.prediction), scan, self.classes)
            f_valid = torch.from_numpy(f[scan.valid]).clamp_min(SURE)
            g_valid = torch.from_numpy(g[scan.valid]).clamp_min(SURE)
            return f_valid.to(device), g_valid.to(device)

        return score


def score_source(
    weights: Weights,
    scores: ScorePair | None,
    records: Sequence[ScanRecord],
    by_ring: bool = False,
) -> ScoreSource:
    """Return the scores in files if there are any, else those of the networks.

    Args:
        weights: the networks.
        scores: two other models' scores in files, if there are any.
        records: the scans.
        by_ring: as of `NetworkScores`.

    Raises:
        InputError: if there are no files, and a network is missing.
    """
    if scores is not None:
        return FileScores(scores, records, weights.taxonomy.size)
    for part in ("range_net", "polar_net"):
        if part not in weights.parts:
            raise InputError(
                f"expected trained networks for the head, found no {part}; train it, or give --init"
            )

    return NetworkScores(weights, records, by_ring)


def scorer_with_head(
    weights: Weights, head: PointHead, by_ring: bool = False
) -> Callable[[PointBatch], Tensor]:
    """Return what gives the (P, K) scores of a batch by AMVNet while its head is trained.

    Args:
        weights: the networks.
        head: the head that is trained.
        by_ring: as of `NetworkScores`.
    """
    model = weights.build()
    if by_ring:
        model.range_view = model.range_view.by_ring()
    model.point_head = head

    def score(batch: PointBatch) -> Tensor:
        return model.to(batch.points.device)(batch).merged

    return score
