"""A tiny model that counts how often each class has a height, a distance and an intensity.

python tiny_model.py DATA OUT     learns from the sequences 00 to 03, writes scores of all sequences
"""

import sys
from pathlib import Path

import numpy as np

from amvnet.data.datasets.open import open_dataset

SIZE = (40, 20, 10)  # the numbers of cells of height, distance and intensity


def cells(points: np.ndarray) -> np.ndarray:
    """Return (N,) the index of the cell of each of (N, 4) points."""
    height = (points[:, 2] + 3) / 8
    distance = np.hypot(points[:, 0], points[:, 1]) / 60
    shares = np.stack([height, distance, points[:, 3]])
    indices = (shares * np.array(SIZE)[:, None]).astype(int)
    return np.ravel_multi_index(indices, SIZE, mode="clip")


data, out = sys.argv[1:]
city = open_dataset(data)

counts = np.full((np.prod(SIZE), 20), 0.1)
for record in city.records(["00", "01", "02", "03"]):
    scan = city.read(record)
    assert scan.labels is not None
    np.add.at(counts, (cells(scan.points), scan.labels), 1)
scores = counts[:, 1:] / counts[:, 1:].sum(axis=1, keepdims=True)  # column c is class c + 1

for record in city.records(city.sequences("all")):
    path = Path(out, record.prediction).with_suffix(".npy")
    path.parent.mkdir(parents=True, exist_ok=True)
    points = city.read(record).points
    np.save(path, scores[cells(points)].astype(np.float16))
