"""Scans a second that are read, augmented and collated for training, on 0, 1, 2, ... reading processes.

python benchmarks/loading.py DATA [RECIPE] [PROCESSES]
"""

from __future__ import annotations

import sys
import time

from amvnet.config.recipes import load_recipe
from amvnet.data.datasets.open import open_dataset
from amvnet.training.loaders import ScanSet, make_loader

ROUNDS = 2  # the first one starts the processes and fills the disk's cache


def main(data: str, recipe: str = "semantickitti", processes: str = "2") -> None:
    dataset, training = open_dataset(data), load_recipe(recipe).training
    scans = ScanSet(dataset, dataset.records(dataset.sequences("all")), training.augment)
    for workers in range(int(processes) + 1):
        batches = make_loader(scans, training.bev.batch, workers, shuffle=True)
        for _ in range(ROUNDS):
            started, points = time.perf_counter(), 0
            for batch, _labels in batches:
                points += len(batch.points)
            seconds = time.perf_counter() - started
        print(
            f"{workers} processes: {len(scans) / seconds:.1f} scans/s of {points // len(scans)} points"
        )


if __name__ == "__main__":
    main(*sys.argv[1:])
