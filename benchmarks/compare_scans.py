"""Two data sets side by side, say real and simulated scans: points, lasers, ranges, classes, intensity, height, relief.

python benchmarks/compare_scans.py DATA_A DATA_B [PICTURE.png]
"""

from __future__ import annotations

import sys
from dataclasses import dataclass, field

import numpy as np
from matplotlib import pyplot as plt
from rich.console import Console
from rich.table import Table

from amvnet.data.datasets.open import open_dataset
from amvnet.data.taxonomy import Taxonomy
from amvnet.scan import Scan

RANGES = (0, 1, 5, 10, 15, 20, 30, 40, 50, 80)  # metres
ELEVATIONS = np.arange(-32, 14, 2)  # degrees


@dataclass
class Figures:
    """What is measured over the scans of one data set; arrays are over the classes unless they say otherwise."""

    taxonomy: Taxonomy
    points: list[int] = field(default_factory=list)  # per scan
    ranges: list[np.ndarray] = field(
        default_factory=list
    )  # share of the points in each bin, per scan
    elevations: list[np.ndarray] = field(default_factory=list)
    lasers: list[np.ndarray] = field(default_factory=list)  # returns of each laser, from the top
    relief: list[np.ndarray] = field(
        default_factory=list
    )  # (n, 2) train id, metres off the middle of both neighbours
    shares: list[np.ndarray] = field(default_factory=list)
    values: list[np.ndarray] = field(
        default_factory=list
    )  # (n, 4) train id, intensity, z, range of some points


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
        if (laser := lasers_of(scan)) is not None:
            found.lasers.append(np.bincount(laser, minlength=laser.max() + 1))
            found.relief.append(relief_of(scan, laser, ids, distance))
        found.shares.append(np.bincount(ids, minlength=dataset.taxonomy.size + 1) / count)
        some = rng.choice(count, min(count, 20_000), replace=False)
        columns = (ids[some], scan.points[some, 3], scan.points[some, 2], distance[some])
        found.values.append(np.column_stack(columns).astype(np.float32))
    return found


def lasers_of(scan: Scan) -> np.ndarray | None:
    """(N,) laser of each point, 0 = top: by the ring, or where the azimuth begins anew, as KITTI's files have it."""
    if scan.ring is not None:
        return scan.ring.max() - scan.ring.astype(int)
    azimuth = np.arctan2(scan.points[:, 1], scan.points[:, 0]) % (2 * np.pi)
    laser = np.cumsum(np.diff(azimuth, prepend=azimuth[:1]) < -np.pi)
    return laser if laser[-1] == 63 else None


def relief_of(scan: Scan, laser: np.ndarray, ids: np.ndarray, distance: np.ndarray) -> np.ndarray:
    """Of points 5 to 25 m away: class, and how far each is off the middle of its two neighbours. (n, 2)."""
    azimuth = np.arctan2(scan.points[:, 1], scan.points[:, 0]) % (2 * np.pi)
    order = np.lexsort((azimuth, laser))
    ids, distance, laser, azimuth = ids[order], distance[order], laser[order], azimuth[order]
    close = (laser[1:] == laser[:-1]) & (ids[1:] == ids[:-1]) & (np.diff(azimuth) < np.radians(0.8))
    middle = (
        np.flatnonzero(close[1:] & close[:-1] & (distance[1:-1] > 5) & (distance[1:-1] < 25)) + 1
    )
    off = np.abs(distance[middle] - (distance[middle - 1] + distance[middle + 1]) / 2)
    return np.column_stack([ids[middle], off]).astype(np.float32)


def range_images(scans: list[Scan]) -> np.ndarray:
    """Range and intensity of some scans as pictures one below the other. (rows, 1024)."""
    rows = []
    for scan in scans:
        laser = lasers_of(scan)
        assert laser is not None
        distance = np.linalg.norm(scan.points[:, :3], axis=1)
        column = (
            (np.arctan2(-scan.points[:, 1], -scan.points[:, 0]) / (2 * np.pi) + 0.5) * 2048
        ).astype(int) % 2048
        shown = np.log(distance / 3) / np.log(25), scan.points[:, 3] / 0.7
        for values in shown:
            image = np.full((laser.max() + 1, 2048), np.nan)
            image[laser, 2047 - column] = values
            rows += [image[:, 512:1536], np.full((4, 1024), np.nan)]
        rows.append(np.full((10, 1024), np.nan))
    return np.concatenate(rows)


def draw(specs: tuple[str, str], path: str, count: int = 3) -> None:
    """A few scans of each data set, ahead of the car: range above, intensity below; drawn alike, side by side."""
    figure, axes = plt.subplots(1, 2, figsize=(18, 6))
    for axis, spec in zip(axes, specs, strict=True):
        dataset = open_dataset(spec)
        records = dataset.records(dataset.sequences("all"))
        some = [records[int((i + 0.5) * len(records) / count)] for i in range(count)]
        axis.imshow(
            range_images([dataset.read(record) for record in some]),
            cmap="cividis",
            vmin=0,
            vmax=1,
            aspect="auto",
        )
        axis.set_axis_off()
    figure.tight_layout(pad=0.3)
    figure.savefig(path, dpi=110)


def table(title: str, rows: list[tuple[str, ...]], names: tuple[str, ...]) -> Table:
    shown = Table(title=title, show_edge=False)
    for name in names:
        shown.add_column(name, justify="left" if name == names[0] else "right")
    for row in rows:
        shown.add_row(*row)
    return shown


def percent(a: float, b: float) -> tuple[str, str]:
    return f"{100 * a:.2f}", f"{100 * b:.2f}"


def quantiles(values: np.ndarray, at: tuple[float, ...] = (0.1, 0.5, 0.9)) -> str:
    return (
        " ".join(f"{q:.{2 if len(at) == 3 else 3}f}" for q in np.quantile(values, at))
        if len(values) > 50
        else "–"
    )


def main(first: str, second: str) -> None:
    a, b = measure(first), measure(second)
    console = Console(width=200)
    console.print(f"A is {first}, B is {second}")
    counts = [(f"{name} points a scan", *(f"{f(x.points):,.0f}" for x in (a, b)))
              for name, f in (("mean", np.mean), ("least", np.min), ("most", np.max))]  # fmt: skip
    console.print(table("points", counts, ("", "A", "B")))
    for title, key, edges in (
        ("range, m", "ranges", RANGES),
        ("elevation, degrees", "elevations", ELEVATIONS),
    ):
        means = [np.mean(getattr(x, key), axis=0) for x in (a, b)]
        rows = [(f"{low} to {high}", *percent(p, q))
                for low, high, p, q in zip(edges[:-1], edges[1:], *means, strict=True)]  # fmt: skip
        console.print(table(f"share of the points by {title}, %", rows, ("", "A", "B")))
    both = [np.mean(x.ranges, axis=0) for x in (a, b)]
    console.print(
        f"total variation distance of the ranges: {np.abs(both[0] - both[1]).sum() / 2:.3f}"
    )
    if a.lasers and b.lasers:
        means = [np.mean(x.lasers, axis=0) for x in (a, b)]
        rows = [
            (str(i), f"{p:.0f}", f"{q:.0f}", f"{q / p:.2f}")
            for i, (p, q) in enumerate(zip(*means, strict=True))
        ]
        console.print(table("returns a scan by laser, from the top", rows, ("", "A", "B", "B / A")))
    names = ("unlabelled", *a.taxonomy.classes)
    shares = [np.mean(x.shares, axis=0) for x in (a, b)]
    values = [np.concatenate(x.values) for x in (a, b)]
    relief = [np.concatenate(x.relief or [np.zeros((0, 2))]) for x in (a, b)]
    rows = []
    for c, name in enumerate(names):
        of_class = [v[v[:, 0] == c] for v in values]
        columns = [quantiles(v[:, i]) for i in (1, 2, 3) for v in of_class]
        columns += [quantiles(r[r[:, 0] == c, 1], (0.5, 0.9)) for r in relief]
        rows.append((name, *percent(shares[0][c], shares[1][c]), *columns))
    heads = (
        "class",
        "% A",
        "% B",
        *(f"{what} {x}" for what in ("intensity", "z", "range", "relief") for x in "AB"),
    )
    console.print(
        table("classes; 10, 50 and 90 % quantiles (relief in metres: 50 and 90 %)", rows, heads)
    )


if __name__ == "__main__":
    main(sys.argv[1], sys.argv[2])
    if len(sys.argv) > 3:
        draw((sys.argv[1], sys.argv[2]), sys.argv[3])
