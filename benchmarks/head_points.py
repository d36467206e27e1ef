"""Score the points that the head classifies by several leads and cells, place by place.

    python benchmarks/head_points.py DATA WEIGHTS [--leads 1,2.5] [--cells 0.1] [--every N]

In the paper, the head classifies all uncertain points; with `model.assertion.lead`, it classifies
only disputed ones, and with `model.point_head.cell` only the first of them in each cube of space.
The table shows AMVNet's mIoU over all classes and its accuracy for the paper, for each lead, and
for each cell with the last lead; the share of the uncertain points that the head leaves out, and
the share of the labels that change, for each sequence of a dataset and for all scans together. With
--every N, only every Nth scan is scored.
"""

from __future__ import annotations

import argparse
from collections import Counter
from dataclasses import replace

import numpy as np
import torch
from rich.console import Console
from rich.table import Table

import amvnet
from amvnet.data.datasets.open import open_dataset
from amvnet.evaluation.metrics import Evaluation
from amvnet.inference.segmentation import Segmentation
from amvnet.models.assertion import disputed_points
from amvnet.models.point_head import first_in_cubes

Choice = tuple[float, float]  # a lead and a cell
PAPER = (0.0, 0.0)  # with which the head classifies all uncertain points


def add_row(table: Table, name: str, evaluation: Evaluation, counts: Counter[str]) -> None:
    """Add the figures of one place to a table, in percent."""
    cells = [name, f"{100 * counts['uncertain'] / counts['points']:.1f}"]
    for choice, figures in evaluation.report(name)["methods"].items():
        cells.append(f"{100 * figures['miou']:.2f} ({100 * figures['accuracy']:.2f})")
        if choice != str(PAPER):
            left_out = 100 * (1 - counts[f"classified {choice}"] / max(counts["uncertain"], 1))
            changed = 100 * counts[f"changed {choice}"] / counts["points"]
            cells[-1] += f", {left_out:.1f}, {changed:.3f}"
    table.add_row(*cells)


def labels_by(result: Segmentation, lead: float, cell: float) -> tuple[np.ndarray, int]:
    """Return the labels (N,) by a lead and a cell, and how many points the head classifies.

    In the result, the head has classified all uncertain points.
    """
    assert result.rv is not None
    assert result.bev is not None
    f, g = torch.from_numpy(result.rv), torch.from_numpy(result.bev)
    uncertain = torch.from_numpy(result.uncertain)
    ensemble = (f * g).argmax(dim=1).numpy() + 1
    disputed = disputed_points(f, g, uncertain, lead)
    labels = np.where(uncertain & ~disputed, ensemble, result.labels)
    points = torch.from_numpy(result.require_origin().scan.points)
    index = disputed.nonzero()[:, 0]
    first, cube = first_in_cubes(points, index, cell)
    labels[index] = result.labels[first][cube]
    return labels, len(first)


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser()
    parser.add_argument("data")
    parser.add_argument("weights")
    parser.add_argument("--leads", default="1,2.5")
    parser.add_argument("--cells", default="0.1")
    parser.add_argument("--every", type=int, default=1)
    options = parser.parse_args()
    leads = list(map(float, options.leads.split(",")))
    choices: list[Choice] = [PAPER, *((lead, 0.0) for lead in leads)]
    choices += [(leads[-1], float(cell)) for cell in options.cells.split(",")]

    dataset = open_dataset(options.data)
    segmenter = amvnet.load(options.weights)
    model = segmenter.model
    assert model.point_head is not None
    model.lead, cell = PAPER
    model.point_head.config = replace(model.point_head.config, cell=cell)
    chosen = dataset.records(dataset.sequences("all"))[:: options.every]
    titles = [
        f"lead {lead:g}, cell {cell:g}: mIoU (accuracy), left out, changed"
        for lead, cell in choices[1:]
    ]
    table = Table("place", "uncertain", "paper", *titles)
    total = Evaluation(dataset.taxonomy)
    total_counts: Counter[str] = Counter()

    for place in dataset.sequences("all"):
        evaluation = Evaluation(dataset.taxonomy)
        counts: Counter[str] = Counter()
        for record in chosen:
            if record.sequence != place:
                continue
            scan = dataset.read(record)
            result = segmenter(scan)
            assert scan.labels is not None
            counts["points"] += int(np.count_nonzero(result.labels))
            counts["uncertain"] += int(np.count_nonzero(result.uncertain))
            ids = {}
            for choice in choices:
                labels, classified = labels_by(result, *choice)
                counts[f"classified {choice}"] += classified
                counts[f"changed {choice}"] += int(np.count_nonzero(labels != result.labels))
                ids[str(choice)] = labels
            evaluation.add(scan.points, scan.labels, ids)
        if counts["points"]:
            add_row(table, place, evaluation, counts)
        total += evaluation
        total_counts += counts
    add_row(table, "all", total, total_counts)
    Console(width=150).print(table)


if __name__ == "__main__":
    main()
