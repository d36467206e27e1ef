"""Measure how many scans a second are read, augmented and collated for training.

Measured with 0, 1, 2, ... reading processes:

    python benchmarks/loading.py DATA [RECIPE] [PROCESSES]
"""

from __future__ import annotations

import sys
import time

from amvnet.config.recipes import load_recipe
from amvnet.data.datasets.open import open_dataset
from amvnet.training.loaders import ScanSet, make_loader

ROUNDS = 2  # the last one counts; the first starts the processes and fills the disk's cache


def main(data: str, recipe: str = "semantickitti", processes: str = "2") -> None:
    dataset = open_dataset(data)
    training = load_recipe(recipe).training
    scans = ScanSet(dataset, dataset.records(dataset.sequences("all")), training.augment)

    for workers in range(int(processes) + 1):
        batches = make_loader(scans, training.bev.batch, workers, shuffle=True)
        for _ in range(ROUNDS):
            started = time.perf_counter()
            points = 0
            for batch, _labels in batches:
                points += len(batch.points)
            seconds = time.perf_counter() - started

        rate = len(scans) / seconds
        print(f"{workers} processes: {rate:.1f} scans/s of {points // len(scans)} points")


if __name__ == "__main__":
    main(*sys.argv[1:])
