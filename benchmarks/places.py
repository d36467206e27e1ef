"""Score weights place by place, because a good score of one place may hide others.

    python benchmarks/places.py DATA WEIGHTS [--no-intensity] [--every N]

DATA is a dataset such as semantickitti:PATH. Each of its sequences is a place. The table shows the
mIoU over all classes and the accuracy of each method, and the share of uncertain points, for each
place and for all places together.
With --no-intensity, the intensities of all scans are set to 0. With --every N, only every Nth scan
is scored.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from rich.console import Console
from rich.table import Table

import amvnet
from amvnet.data.datasets.base import Dataset
from amvnet.data.datasets.open import open_dataset
from amvnet.data.recordings import ScanFile
from amvnet.evaluation.metrics import Evaluation
from amvnet.inference.segmenter import Segmenter
from amvnet.scan import Scan


def score(
    dataset: Dataset,
    records: Sequence[ScanFile],
    segmenter: Segmenter,
    intensity: bool,
) -> Evaluation:
    """Score the methods of the paper on some scans."""
    evaluation = Evaluation(dataset.taxonomy)
    for record in records:
        scan = dataset.read(record)
        result = segmenter(scan if intensity else without_intensity(scan))
        assert scan.labels is not None
        assert result.rv is not None
        assert result.bev is not None

        scores = {
            "rv": result.rv,
            "bev": result.bev,
            "ensemble": result.rv * result.bev,
            "amvnet": result.scores,
        }
        ids = {}
        for name, values in scores.items():
            ids[name] = np.where(result.labels > 0, values.argmax(axis=1) + 1, 0)
        evaluation.add(scan.points, scan.labels, ids, result.uncertain)
    return evaluation


def without_intensity(scan: Scan) -> Scan:
    """Return the scan with intensities of 0."""
    points = scan.points.copy()
    points[:, 3] = 0
    return replace(scan, points=points)


def add_row(table: Table, name: str, evaluation: Evaluation, classes: int) -> None:
    """Add the figures of one place to a table, in percent."""
    report = evaluation.report(name)
    cells = [name]
    for values in report["methods"].values():
        ious = [iou for iou in values["iou"].values() if iou is not None]
        cells.append(f"{100 * np.sum(ious) / classes:.1f} ({100 * values['accuracy']:.1f})")
    cells.append(f"{100 * report['uncertain_fraction']:.1f}")
    table.add_row(*cells)


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser()
    parser.add_argument("data")
    parser.add_argument("weights")
    parser.add_argument("--no-intensity", action="store_true")
    parser.add_argument("--every", type=int, default=1)
    options = parser.parse_args()

    dataset = open_dataset(options.data)
    segmenter = amvnet.load(options.weights)
    chosen = dataset.records(dataset.sequences("all"))[:: options.every]
    table = Table("place", "rv", "bev", "ensemble", "amvnet", "uncertain, %")
    total = Evaluation(dataset.taxonomy)
    for place in dataset.sequences("all"):
        records = [record for record in chosen if record.sequence == place]
        if not records:
            continue
        evaluation = score(dataset, records, segmenter, intensity=not options.no_intensity)
        add_row(table, place, evaluation, dataset.taxonomy.size)
        total += evaluation
    add_row(table, "all", total, dataset.taxonomy.size)
    Console().print(table)


if __name__ == "__main__":
    main()
