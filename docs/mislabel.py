"""Give 1 % of the things in a labelled data set another class; with a ranking, say how many of them it found.

python mislabel.py DATA WRONG SEED [alike]     writes WRONG, a copy with wrong labels
python mislabel.py WRONG RANKING.csv           the share of the wrong things in the first rows
"""

import csv
import shutil
import sys
from pathlib import Path

import numpy as np

from amvnet.data.datasets.open import open_dataset
from amvnet.data.scan_files import write_labels
from amvnet.ranking.clusters import cluster

SHARE, LEAST = 0.01, 10  # of the things that have so many points
ALIKE = [
    (1, 2, 3, 4, 5),
    (6, 7, 8),
    (9, 10, 11, 12, 17),
    (13, 14),
    (15, 16, 18, 19),
]  # car and truck, pole and trunk, ...


def mislabel(data, wrong, seed, alike):
    shutil.copytree(data, wrong)
    right, copy, rng = open_dataset(data), open_dataset(wrong), np.random.default_rng(seed)
    records, things, marks = [one.records(one.sequences("all")) for one in (right, copy)], [], {}
    for place, record in enumerate(records[0]):
        scan = right.read(record)
        thing, first = connected(scan), np.unique(connected(scan), return_index=True)[1]
        things += [
            (place, k)
            for k in np.flatnonzero((np.bincount(thing) >= LEAST) & (scan.labels[first] > 0))
        ]
    for number in rng.permutation(len(things))[: round(SHARE * len(things))]:
        place, k = things[number]
        scan = right.read(records[0][place])
        points = connected(scan) == k
        own = scan.labels[points][0]
        others = (
            next(group for group in ALIKE if own in group)
            if alike
            else range(1, right.taxonomy.size + 1)
        )
        now = copy.read(records[1][place]).labels
        now[points] = rng.choice([other for other in others if other != own])
        write_labels(records[1][place].labels_path, right.taxonomy.to_raw(now))
        marks.setdefault(records[1][place].name, np.zeros(len(points), dtype=int))[points] = (
            number + 1
        )
    np.savez(Path(wrong, "wrong.npz"), things=len(things), **marks)


def connected(scan):
    return cluster(scan.points[:, :3], scan.labels)  # points of one class


def score(wrong, ranking):
    with np.load(Path(wrong, "wrong.npz")) as file:
        things, marks = (
            int(file["things"]),
            {name: file[name] for name in file.files if name != "things"},
        )
    with open(ranking, newline="") as file:
        rows = [(row["scan"], int(row["point"])) for row in csv.DictReader(file)]
    found = [marks[scan][point] if scan in marks else 0 for scan, point in rows]
    wrong = set(np.concatenate(list(marks.values())).tolist()) - {0}
    print(f"{len(wrong)} of {things} things are wrong; {len(rows)} rows")
    for share in (0.01, 0.05, 0.1, 1):
        hit = wrong & set(found[: round(share * len(rows))])
        print(
            f"in the first {share:.0%} of the rows: {len(hit)} of them, {len(hit) / len(wrong):.0%}"
        )


if len(sys.argv) > 3:
    mislabel(sys.argv[1], sys.argv[2], int(sys.argv[3]), "alike" in sys.argv)
else:
    score(*sys.argv[1:])
