"""A model of 20 lines: how often each class is at a height, a distance and an intensity. Learns from 00 to 03."""

import sys
from pathlib import Path

import numpy as np

from amvnet.data.datasets.open import open_dataset


def cell(points):
    """(N, 4) -> (N,) which of 40 x 20 x 10 cells of height, distance and intensity each point is in."""
    values = [(points[:, 2] + 3) / 8, np.hypot(points[:, 0], points[:, 1]) / 60, points[:, 3]]
    return np.ravel_multi_index(
        [(v * n).astype(int) for v, n in zip(values, SIZE, strict=True)], SIZE, mode="clip"
    )


SIZE, (data, out) = (40, 20, 10), sys.argv[1:]
city, counts = open_dataset(data), np.full((np.prod(SIZE), 20), 0.1)
for record in city.records(["00", "01", "02", "03"]):
    scan = city.read(record)
    np.add.at(counts, (cell(scan.points), scan.labels), 1)
table = counts[:, 1:] / counts[:, 1:].sum(axis=1, keepdims=True)  # column c is class c + 1
for record in city.records(city.sequences("all")):
    path = Path(out, record.prediction).with_suffix(".npy")
    path.parent.mkdir(parents=True, exist_ok=True)
    np.save(path, table[cell(city.read(record).points)].astype(np.float16))
