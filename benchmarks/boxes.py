"""Score weights on nuScenes scans that have boxes and no labels of the points.

    python benchmarks/boxes.py DATA BOXES WEIGHTS

DATA is a nuScenes dataset. BOXES is a folder with a file NAME_boxseg.bin for each NAME.pcd.bin: one
uint8 per point, the train id of the box that the point is in, 0 in a box of another class and 255
in no box. For each class, and for cars, trucks and buses together, print the share of the points in
its boxes that each method labels so. A box also holds some points of the ground, and nothing says
what lies outside of boxes, so that these shares tell less than an IoU.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.table import Table

from amvnet.data.datasets.open import open_dataset
from amvnet.inference.segmenter import Segmenter
from amvnet.models.methods import PAPER_METHODS

BOXED = 10  # classes that have boxes are the first ones
LARGE_VEHICLES = ("car", "truck", "bus")


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser()
    parser.add_argument("data")
    parser.add_argument("boxes", type=Path)
    parser.add_argument("weights")
    options = parser.parse_args()

    dataset = open_dataset(options.data)
    segmenter = Segmenter(options.weights)
    size = dataset.taxonomy.size + 1
    confusion = {method: np.zeros((size, size), np.int64) for method in PAPER_METHODS}
    uncertain_points = 0
    points = 0
    for record in dataset.records(dataset.sequences("all")):
        scan = dataset.read(record, labels=False)
        ids, uncertain = segmenter.labels_by_method(scan, PAPER_METHODS)
        uncertain_points += int(uncertain.sum())
        points += len(scan)

        name = record.points_path.name.removesuffix(".pcd.bin")
        boxes = np.fromfile(options.boxes / f"{name}_boxseg.bin", np.uint8)
        is_boxed = (boxes >= 1) & (boxes <= BOXED)
        for method, predicted in ids.items():
            np.add.at(confusion[method], (boxes[is_boxed], predicted[is_boxed]), 1)

    table = Table("points in boxes of", "points", *PAPER_METHODS)
    classes = dataset.taxonomy.classes
    large = [classes.index(name) + 1 for name in LARGE_VEHICLES]
    rows = {name: [train_id] for train_id, name in enumerate(classes[:BOXED], start=1)}
    for name, ids in {**rows, ", ".join(LARGE_VEHICLES): large}.items():
        count = confusion["amvnet"][ids].sum()
        cells = []
        for method in PAPER_METHODS:
            right = confusion[method][np.ix_(ids, ids)].sum()
            cells.append(f"{100 * right / max(count, 1):.0f} %")
        table.add_row(name, str(count), *cells)
    Console().print(table)
    print(f"{100 * uncertain_points / points:.1f} % of the points are uncertain")


if __name__ == "__main__":
    main()
