"""Score weights on nuScenes scans that have boxes, but no labels of the points.

    python benchmarks/boxes.py DATA BOXES WEIGHTS

DATA is a nuScenes dataset. BOXES is a folder with a file NAME_boxseg.bin for each NAME.pcd.bin: one
uint8 per point, which is the train id of the box around the point, 0 in a box of another class, and
255 outside of all boxes. For each class, and for cars, trucks and buses together, the table shows
the share of the points in its boxes to which each method gives this class. These shares tell less
than an IoU, because a box also contains some points of the ground, and the classes outside of the
boxes are unknown.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.table import Table

import amvnet
from amvnet.data.datasets.open import open_dataset
from amvnet.evaluation.scoring import labels_by_method
from amvnet.models.methods import PAPER_METHODS

BOXED = 10  # number of classes that have boxes; they are the first classes
LARGE_VEHICLES = ("car", "truck", "bus")


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser()
    parser.add_argument("data")
    parser.add_argument("boxes", type=Path)
    parser.add_argument("weights")
    options = parser.parse_args()

    dataset = open_dataset(options.data)
    segmenter = amvnet.load(options.weights)
    size = dataset.taxonomy.size + 1
    matrices = {method: np.zeros((size, size), np.int64) for method in PAPER_METHODS}
    uncertain_points = 0
    points = 0
    for record in dataset.records(dataset.sequences("all")):
        scan = dataset.read(record, labels=False)
        labels, uncertain, _ = labels_by_method(segmenter, scan, PAPER_METHODS)
        assert uncertain is not None
        uncertain_points += int(uncertain.sum())
        points += len(scan)

        name = record.points_path.name.removesuffix(".pcd.bin")
        boxes = np.fromfile(options.boxes / f"{name}_boxseg.bin", np.uint8)
        is_boxed = (boxes >= 1) & (boxes <= BOXED)
        for method, matrix in matrices.items():
            np.add.at(matrix, (boxes[is_boxed], labels[method][is_boxed]), 1)

    table = Table("points in boxes of", "points", *PAPER_METHODS)
    names = dataset.taxonomy.classes
    rows = {name: [train_id] for train_id, name in enumerate(names[:BOXED], start=1)}
    rows[", ".join(LARGE_VEHICLES)] = [names.index(name) + 1 for name in LARGE_VEHICLES]
    for title, train_ids in rows.items():
        count = matrices["amvnet"][train_ids].sum()
        cells = []
        for matrix in matrices.values():
            right = matrix[np.ix_(train_ids, train_ids)].sum()
            cells.append(f"{100 * right / max(count, 1):.0f} %")
        table.add_row(title, str(count), *cells)
    Console().print(table)
    print(f"{100 * uncertain_points / points:.1f} % of the points are uncertain")


if __name__ == "__main__":
    main()
