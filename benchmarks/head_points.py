"""Score the points that the head classifies by several leads, place by place.

    python benchmarks/head_points.py DATA WEIGHTS [--leads 1,2.5] [--every N]

In the paper, the head classifies all uncertain points; with `model.assertion.lead`, it classifies
only disputed ones. The table shows AMVNet's mIoU over all classes and its accuracy for the paper
and for each lead, the share of the uncertain points that the head leaves out, and the share of the
labels that change, for each sequence of a dataset and for all scans together. With --every N, only
every Nth scan is scored.
"""

from __future__ import annotations

import argparse
from collections import Counter

import numpy as np
import torch
from rich.console import Console
from rich.table import Table

import amvnet
from amvnet.data.datasets.open import open_dataset
from amvnet.evaluation.metrics import Evaluation
from amvnet.models.assertion import disputed_points

PAPER = 0.0  # the lead with which all uncertain points are disputed


def add_row(table: Table, name: str, evaluation: Evaluation, counts: Counter[str]) -> None:
    """Add the figures of one place to a table, in percent."""
    cells = [name, f"{100 * counts['uncertain'] / counts['points']:.1f}"]
    for lead, figures in evaluation.report(name)["methods"].items():
        cells.append(f"{100 * figures['miou']:.2f} ({100 * figures['accuracy']:.2f})")
        if float(lead) != PAPER:
            left_out = 100 * (1 - counts[f"disputed {lead}"] / max(counts["uncertain"], 1))
            changed = 100 * counts[f"changed {lead}"] / counts["points"]
            cells[-1] += f", {left_out:.1f}, {changed:.3f}"
    table.add_row(*cells)


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser()
    parser.add_argument("data")
    parser.add_argument("weights")
    parser.add_argument("--leads", default="1,2.5")
    parser.add_argument("--every", type=int, default=1)
    options = parser.parse_args()
    leads = [PAPER, *map(float, options.leads.split(","))]

    dataset = open_dataset(options.data)
    segmenter = amvnet.load(options.weights)
    segmenter.model.lead = PAPER
    chosen = dataset.records(dataset.sequences("all"))[:: options.every]
    titles = [f"lead {lead:g}: mIoU (accuracy), left out, changed" for lead in leads[1:]]
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
            assert result.rv is not None
            assert result.bev is not None

            # Undisputed points have the label of the ensemble.
            f, g = torch.from_numpy(result.rv), torch.from_numpy(result.bev)
            uncertain = torch.from_numpy(result.uncertain)
            ensemble = (f * g).argmax(dim=1).numpy() + 1
            counts["points"] += int(np.count_nonzero(result.labels))
            counts["uncertain"] += int(uncertain.sum())
            ids = {}
            for lead in leads:
                disputed = disputed_points(f, g, uncertain, lead).numpy()
                labels = np.where(result.uncertain & ~disputed, ensemble, result.labels)
                counts[f"disputed {lead}"] += int(np.count_nonzero(disputed))
                counts[f"changed {lead}"] += int(np.count_nonzero(labels != result.labels))
                ids[str(lead)] = labels
            evaluation.add(scan.points, scan.labels, ids)
        if counts["points"]:
            add_row(table, place, evaluation, counts)
        total += evaluation
        total_counts += counts
    add_row(table, "all", total, total_counts)
    Console(width=150).print(table)


if __name__ == "__main__":
    main()
