"""Score weights place by place, as an easy place may hide what the others lack.

    python benchmarks/places.py DATA WEIGHTS [--no-intensity] [--methods M,...] [--every N]

DATA is a dataset such as semantickitti:PATH; each of its sequences is a place. Print mIoU over all
classes and accuracy of each method, and the share of uncertain points, for each place and for all.
With --no-intensity, the intensities of all scans are set to 0. --methods are those of
`amvnet evaluate`. With --every N, only every Nth scan is scored.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from rich.console import Console
from rich.table import Table

import amvnet
from amvnet.data.datasets.base import Dataset, ScanRecord
from amvnet.data.datasets.open import open_dataset
from amvnet.evaluation.metrics import Evaluation
from amvnet.evaluation.scoring import labels_by_method
from amvnet.inference.segmenter import Segmenter
from amvnet.models.methods import PAPER_METHODS
from amvnet.scan import Scan


def score(
    dataset: Dataset,
    records: Sequence[ScanRecord],
    segmenter: Segmenter,
    methods: Sequence[str],
    intensity: bool,
) -> Evaluation:
    """Score some methods on some scans."""
    evaluation = Evaluation(dataset.taxonomy)
    for record in records:
        scan = dataset.read(record)
        shown = scan if intensity else without_intensity(scan)
        ids, uncertain = labels_by_method(segmenter, shown, methods)
        assert scan.labels is not None
        evaluation.add(scan.points, scan.labels, ids, uncertain)
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
    parser.add_argument("--methods", default=",".join(PAPER_METHODS))
    parser.add_argument("--every", type=int, default=1)
    options = parser.parse_args()

    dataset = open_dataset(options.data)
    segmenter = amvnet.load(options.weights)
    methods = options.methods.split(",")
    chosen = dataset.records(dataset.sequences("all"))[:: options.every]
    table = Table("place", *methods, "uncertain, %")
    total = Evaluation(dataset.taxonomy)
    for place in dataset.sequences("all"):
        records = [record for record in chosen if record.sequence == place]
        if not records:
            continue
        evaluation = score(
            dataset, records, segmenter, methods=methods, intensity=not options.no_intensity
        )
        add_row(table, place, evaluation, dataset.taxonomy.size)
        total += evaluation
    add_row(table, "all", total, dataset.taxonomy.size)
    Console().print(table)


if __name__ == "__main__":
    main()
