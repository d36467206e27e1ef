"""Give 1 % of the things in a dataset another class, and score a ranking that looks for them.

python mislabel.py DATA WRONG SEED [alike]     writes WRONG, a copy with wrong labels
python mislabel.py WRONG RANKING.csv           prints the share that the first rows have found
"""

from __future__ import annotations

import csv
import shutil
import sys
from pathlib import Path
from typing import Any

import numpy as np

from amvnet import Scan
from amvnet.data.datasets.base import Dataset
from amvnet.data.datasets.open import open_dataset
from amvnet.data.labels.ids import write_ids
from amvnet.data.recordings import ScanFile
from amvnet.evaluation.label_errors import cluster

SHARE = 0.01  # the share of the things that get another class
MIN_POINTS = 10  # the least number of points of a thing
# Groups of classes that are easily mistaken for each other: car and truck, pole and trunk, ...
ALIKE = [(1, 2, 3, 4, 5), (6, 7, 8), (9, 10, 11, 12, 17), (13, 14), (15, 16, 18, 19)]


def mislabel(data: str, wrong: str, seed: int, alike: bool) -> None:
    """Write a copy of a dataset with wrong labels, and a file that says which points have them."""
    shutil.copytree(data, wrong)
    dataset = open_dataset(data)
    copy = open_dataset(wrong)
    records = dataset.records(dataset.sequences("all"))
    copied_records = copy.records(copy.sequences("all"))
    rng = np.random.default_rng(seed)

    things = list_things(dataset, records)
    marks: dict[str, Any] = {}
    for number in rng.permutation(len(things))[: round(SHARE * len(things))]:
        index, thing = things[number]
        scan = dataset.read(records[index])
        labels = copy.read(copied_records[index]).labels
        assert scan.labels is not None
        assert labels is not None

        points = connected(scan) == thing
        label = scan.labels[points][0]
        labels[points] = rng.choice(other_classes(label, alike, dataset.taxonomy.size))
        raw = dataset.taxonomy.to_raw(labels)
        write_ids(copied_records[index].labels_path, raw)
        mark = marks.setdefault(copied_records[index].name, np.zeros(len(points), dtype=int))
        mark[points] = number + 1
    np.savez(Path(wrong, "wrong.npz"), things=len(things), **marks)


def list_things(dataset: Dataset, records: list[ScanFile]) -> list[tuple[int, int]]:
    """Return (index of the scan, number of the thing) for all labelled things of enough points."""
    things = []
    for index, record in enumerate(records):
        scan = dataset.read(record)
        assert scan.labels is not None
        of_thing, first = np.unique(connected(scan), return_index=True)
        sizes = np.bincount(connected(scan))
        for thing in of_thing[(sizes >= MIN_POINTS) & (scan.labels[first] > 0)]:
            things.append((index, thing))
    return things


def connected(scan: Scan) -> np.ndarray:
    """Return (N,) the number of the thing that each point belongs to.

    A thing is a set of connected points of one class.
    """
    assert scan.labels is not None
    return cluster(scan.points[:, :3], scan.labels)


def other_classes(label: int, alike: bool, count: int) -> list[int]:
    """Return the classes that can replace a label."""
    classes = tuple(range(1, count + 1))
    if alike:
        classes = next(group for group in ALIKE if label in group)
    return [other for other in classes if other != label]


def score(wrong: str, ranking: str) -> None:
    """Print how many of the wrong things are in the first rows of a ranking."""
    with np.load(Path(wrong, "wrong.npz")) as file:
        marks = dict(file)
    things = int(marks.pop("things"))
    with open(ranking, newline="") as file:
        rows = list(csv.DictReader(file))

    found = []
    for row in rows:
        mark = marks.get(row["scan"])
        found.append(0 if mark is None else mark[int(row["point"])])
    wrong_things = set(np.concatenate(list(marks.values())).tolist()) - {0}
    print(f"{len(wrong_things)} of {things} things are wrong; {len(rows)} rows")

    for share in (0.01, 0.05, 0.1, 1):
        hits = wrong_things & set(found[: round(share * len(rows))])
        percent = f"{len(hits) / len(wrong_things):.0%}"
        print(f"in the first {share:.0%} of the rows: {len(hits)} of them, {percent}")


if len(sys.argv) > 3:
    mislabel(sys.argv[1], sys.argv[2], int(sys.argv[3]), "alike" in sys.argv)
else:
    score(*sys.argv[1:])
