"""Whose scores the point head learns to settle: frozen networks, or two other models' scores in files."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar, Protocol

import torch
from torch import Tensor

from amvnet.data.datasets.base import ScanRecord
from amvnet.errors import InputError
from amvnet.inference.score_files import SURE, ScorePair
from amvnet.models.assertions import Disagreement
from amvnet.models.point_head import PointHead
from amvnet.models.views.points import PointBatch
from amvnet.scan import Scan
from amvnet.weights.file import Weights

Scorer = Callable[
    [ScanRecord, Scan, PointBatch], tuple[Tensor, Tensor]
]  # f and g of a scan's valid points, (P, K)


class ScoreSource(Protocol):
    """Anything that gives f and g of some scans.

    Attributes:
        records: the scans.
        augmented: whether it can score them augmented, too.
    """

    @property
    def records(self) -> Sequence[ScanRecord]: ...

    @property
    def augmented(self) -> bool: ...

    def scorer(self, device: str) -> Scorer:
        """What scores a scan on a device, when it is asked."""


@dataclass(frozen=True)
class NetworkScores:
    """Frozen networks, and the scans that they score."""

    weights: Weights
    records: Sequence[ScanRecord]
    augmented: ClassVar[bool] = True

    def scorer(self, device: str) -> Scorer:
        model = self.weights.build().to(device)
        return lambda record, scan, batch: (
            model.score_range_view(batch),
            model.score_polar_view(batch),
        )


@dataclass(frozen=True)
class FileScores:
    """Two other models' scores in files, of the scans as they are."""

    pair: ScorePair
    records: Sequence[ScanRecord]
    classes: int
    augmented: ClassVar[bool] = False

    def scorer(self, device: str) -> Scorer:
        def score(record: ScanRecord, scan: Scan, batch: PointBatch) -> tuple[Tensor, Tensor]:
            found = self.pair.read(Path(record.prediction), scan, self.classes)
            f, g = (torch.from_numpy(one[scan.valid]).clamp_min(SURE).to(device) for one in found)
            return f, g

        return score


def score_source(
    networks: Weights, scores: ScorePair | None, records: Sequence[ScanRecord]
) -> ScoreSource:
    """The networks, or files of scores where there are any.

    Raises:
        InputError: where there are no files, and a network is missing.
    """
    if scores is not None:
        return FileScores(scores, records, networks.taxonomy.size)
    if missing := [part for part in ("range_net", "polar_net") if part not in networks.parts]:
        raise InputError(
            f"expected trained networks for the head, found no {missing[0]}; train it, or give --init"
        )
    return NetworkScores(networks, records)


def scorer_with_head(networks: Weights, head: PointHead) -> Callable[[PointBatch], Tensor]:
    """The (P, K) scores of a batch by AMVNet whose head is being trained."""
    model = networks.build()
    model.point_head = head
    if (
        networks.model.assertion.name == "loss"
    ):  # which needs labels, that a picture of a prediction must not know
        model.assertion = Disagreement()
    return lambda batch: model.to(batch.points.device)(batch).merged
