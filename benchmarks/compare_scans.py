"""Two data sets side by side, say real and simulated scans: points, beams, ranges, classes, intensity, height.

python benchmarks/compare_scans.py DATA_A DATA_B
"""

from __future__ import annotations

import sys
from dataclasses import dataclass, field

import numpy as np
from rich.console import Console
from rich.table import Table

from amvnet.data.catalog import open_dataset
from amvnet.data.labels import Taxonomy

RANGES = (0, 1, 5, 10, 15, 20, 30, 40, 50, 80)  # metres
ELEVATIONS = np.arange(-32, 14, 2)  # degrees


@dataclass
class Figures:
    """What is measured over the scans of one data set; arrays are over the classes unless they say otherwise."""

    taxonomy: Taxonomy
    points: list[int] = field(default_factory=list)  # per scan
    ranges: list[np.ndarray] = field(default_factory=list)  # share of the points in each bin, per scan
    elevations: list[np.ndarray] = field(default_factory=list)
    shares: list[np.ndarray] = field(default_factory=list)
    values: list[np.ndarray] = field(default_factory=list)  # (n, 4) train id, intensity, z, range of some points


def measure(spec: str) -> Figures:
    """Read every scan once; the points of one without labels count as unlabelled."""
    dataset = open_dataset(spec)
    rng = np.random.default_rng(0)
    found = Figures(dataset.taxonomy)
    for record in dataset.records(dataset.sequences("all")):
        scan = dataset.read(record)
        ids = np.zeros(len(scan), dtype=np.uint8) if scan.labels is None else scan.labels
        xyz, count = scan.points[:, :3], len(scan)
        distance = np.linalg.norm(xyz, axis=1)
        elevation = np.degrees(np.arctan2(xyz[:, 2], np.linalg.norm(xyz[:, :2], axis=1)))
        found.points.append(count)
        found.ranges.append(np.histogram(distance, RANGES)[0] / count)
        found.elevations.append(np.histogram(elevation, ELEVATIONS)[0] / count)
        found.shares.append(np.bincount(ids, minlength=dataset.taxonomy.size + 1) / count)
        some = rng.choice(count, min(count, 20_000), replace=False)
        columns = (ids[some], scan.points[some, 3], scan.points[some, 2], distance[some])
        found.values.append(np.column_stack(columns).astype(np.float32))
    return found


def table(title: str, rows: list[tuple[str, ...]], names: tuple[str, ...]) -> Table:
    shown = Table(title=title, show_edge=False)
    for name in names:
        shown.add_column(name, justify="left" if name == names[0] else "right")
    for row in rows:
        shown.add_row(*row)
    return shown


def percent(a: float, b: float) -> tuple[str, str]:
    return f"{100 * a:.2f}", f"{100 * b:.2f}"


def quantiles(values: np.ndarray) -> str:
    return " ".join(f"{q:.2f}" for q in np.quantile(values, (0.1, 0.5, 0.9))) if len(values) > 50 else "–"


def main(first: str, second: str) -> None:
    a, b = measure(first), measure(second)
    console = Console(width=140)
    console.print(f"A is {first}, B is {second}")
    counts = [(f"{name} points a scan", *(f"{f(x.points):,.0f}" for x in (a, b)))
              for name, f in (("mean", np.mean), ("least", np.min), ("most", np.max))]  # fmt: skip
    console.print(table("points", counts, ("", "A", "B")))
    for title, key, edges in (("range, m", "ranges", RANGES), ("elevation, degrees", "elevations", ELEVATIONS)):
        means = [np.mean(getattr(x, key), axis=0) for x in (a, b)]
        rows = [(f"{low} to {high}", *percent(p, q))
                for low, high, p, q in zip(edges[:-1], edges[1:], *means, strict=True)]  # fmt: skip
        console.print(table(f"share of the points by {title}, %", rows, ("", "A", "B")))
    names = ("unlabelled", *a.taxonomy.classes)
    shares = [np.mean(x.shares, axis=0) for x in (a, b)]
    values = [np.concatenate(x.values) for x in (a, b)]
    rows = []
    for c, name in enumerate(names):
        of_class = [v[v[:, 0] == c] for v in values]
        columns = [quantiles(v[:, i]) for i in (1, 2, 3) for v in of_class]
        rows.append((name, *percent(shares[0][c], shares[1][c]), *columns))
    heads = ("class", "% A", "% B", *(f"{what} {x}" for what in ("intensity", "z", "range") for x in "AB"))
    console.print(table("classes; 10, 50 and 90 % quantiles", rows, heads))


if __name__ == "__main__":
    main(sys.argv[1], sys.argv[2])
