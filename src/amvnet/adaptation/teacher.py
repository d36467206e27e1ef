"""A teacher: weights that label the scans without labels."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch

from amvnet.adaptation.agreement import Opinion, Trust, opinion, pseudo_labels, trust
from amvnet.config.schema import AdaptConfig
from amvnet.data.datasets.base import Dataset, ScanRecord
from amvnet.data.datasets.joined import Part
from amvnet.data.datasets.open import check_classes
from amvnet.data.datasets.select import TrainingScans
from amvnet.data.datasets.taught import Taught, write_pseudo_labels
from amvnet.data.taxonomy import Taxonomy
from amvnet.inference.segmenter import Segmenter, expand_to_scan
from amvnet.progress import Progress, Say, no_progress, say_nothing
from amvnet.scan import Scan
from amvnet.weights.file import Weights


def opinion_on(scan: Scan, segmenter: Segmenter) -> Opinion:
    """Return what both networks say about the N points of a scan; 0 for points that are not valid.

    Raises:
        InputError: if the weights lack a network.
    """
    scores, uncertain = segmenter.scores_by_method(scan, ())
    assert uncertain is not None
    valid = opinion(scores["rv"], scores["bev"], uncertain)

    def expand(values: np.ndarray) -> np.ndarray:
        return expand_to_scan(torch.from_numpy(values), scan.valid)

    return Opinion(
        expand(valid.labels), expand(valid.agreed), expand(valid.confidence), valid.uncertain
    )


def opinions_on(
    dataset: Dataset,
    records: Sequence[ScanRecord],
    segmenter: Segmenter,
    step: Progress = no_progress,
) -> Iterator[Opinion]:
    """Yield what both networks say about some scans, whose labels are not read."""
    for number, record in enumerate(records, start=1):
        yield opinion_on(dataset.read(record, labels=False), segmenter)
        step(number, len(records))


@dataclass(frozen=True)
class Labeller:
    """Gives pseudo-labels to scans without labels, for a semi-supervised training.

    Attributes:
        segmenter: of the teacher.
        config: what is trusted of it.
        folder: receives the pseudo-labels.
        step: is told the progress of each dataset.
        say: is told what was labelled.
    """

    segmenter: Segmenter
    config: AdaptConfig
    folder: Path
    step: Progress = no_progress
    say: Say = say_nothing

    def label(
        self, scans: TrainingScans, parts: Sequence[Part]
    ) -> tuple[TrainingScans, list[Part]]:
        """Return the scans to train on, and the datasets to mix in, with pseudo-labels.

        Raises:
            InputError: if the teacher has other classes, or a scan cannot be read.
        """
        dataset = self._label(scans.dataset, scans.train, self.folder / "1")
        labelled = []
        for number, part in enumerate(parts, start=2):
            taught = self._label(part.dataset, part.records, self.folder / str(number))
            labelled.append(replace(part, dataset=taught))
        return replace(scans, dataset=dataset), labelled

    def _label(self, dataset: Dataset, records: Sequence[ScanRecord], folder: Path) -> Dataset:
        """Return a dataset with pseudo-labels, or as it is if no scan needs them."""
        unlabelled = [record for record in records if not _has_labels(record)]
        if not unlabelled:
            return dataset

        check_classes(dataset, self.segmenter.taxonomy)
        opinions = list(opinions_on(dataset, unlabelled, self.segmenter, self.step))
        trusted = trust(opinions, dataset.taxonomy.size, self.config)
        share = write_trusted(unlabelled, opinions, trusted, folder)
        self.say(
            f"{dataset.root}: {len(unlabelled)} of {len(records)} scans have no labels; the "
            f"teacher is trusted on {share:.0%} of their points"
            f"{untold_text(trusted, dataset.taxonomy)}"
        )
        return Taught(dataset, folder)


def write_trusted(
    records: Sequence[ScanRecord], opinions: Sequence[Opinion], trusted: Trust, folder: Path
) -> float:
    """Write the pseudo-labels of some scans, and return which share of the points has one."""
    points = 0
    labelled = 0
    for record, scan in zip(records, opinions, strict=True):
        ids = pseudo_labels(scan, trusted)
        write_pseudo_labels(folder, record, ids)
        points += int(np.count_nonzero(scan.labels))
        labelled += int(np.count_nonzero(ids))
    return labelled / max(points, 1)


def _has_labels(record: ScanRecord) -> bool:
    """Return whether a scan has a file of labels."""
    path = record.labels_path
    # A street that is not simulated yet has neither points nor labels.
    return path is not None and (path.is_file() or not record.points_path.exists())


def untold_text(trusted: Trust, taxonomy: Taxonomy) -> str:
    """Return which classes get no pseudo-labels, to end a line with."""
    names = []
    for name, told in zip(taxonomy.classes, trusted.told, strict=True):
        if not told:
            names.append(name)
    return f"; not told, and left alone: {', '.join(names)}" if names else ""


def teacher_of(weights: Weights, device: str = "cpu") -> Segmenter:
    """Return the segmenter of a teacher.

    Raises:
        InputError: if the weights lack a network.
    """
    return Segmenter(weights, device, "ensemble")
