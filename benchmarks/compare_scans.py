"""Compare the scans of two datasets, for example real and simulated ones.

    python benchmarks/compare_scans.py DATA_A DATA_B [PICTURE.png]

Print points, lasers, ranges, classes, intensity, height and relief of both; draw a few scans of
each side by side if a picture is asked for.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from matplotlib import pyplot as plt
from rich.console import Console
from rich.table import Table

from amvnet.data.datasets.open import open_dataset
from amvnet.data.taxonomy import Taxonomy
from amvnet.scan import Scan

RANGES = (0, 1, 5, 10, 15, 20, 30, 40, 50, 80)  # metres
ELEVATIONS = tuple(range(-32, 14, 2))  # degrees
SAMPLE = 20_000  # points of each scan whose values are kept
FEWEST = 50  # values that quantiles need
HDL64E_LASERS = 64
IMAGE_WIDTH = 2048  # columns of a range image, of which the front half is drawn
DRAWN_SCANS = 3


@dataclass
class Figures:
    """Measurements of the scans of one dataset; one array per scan."""

    taxonomy: Taxonomy
    # Number of points.
    points: list[int] = field(default_factory=list)
    # Share of the points in each bin of `RANGES` and of `ELEVATIONS`.
    ranges: list[np.ndarray] = field(default_factory=list)
    elevations: list[np.ndarray] = field(default_factory=list)
    # Share of the points in each class.
    shares: list[np.ndarray] = field(default_factory=list)
    # Returns of each laser, from the top.
    lasers: list[np.ndarray] = field(default_factory=list)
    # (n, 2) train id and relief, see `relief_of`.
    relief: list[np.ndarray] = field(default_factory=list)
    # (n, 4) train id, intensity, z and range of a sample of the points.
    values: list[np.ndarray] = field(default_factory=list)


def measure(spec: str) -> Figures:
    """Measure every scan of a dataset; points without labels count as unlabelled."""
    dataset = open_dataset(spec)
    rng = np.random.default_rng(0)
    figures = Figures(dataset.taxonomy)
    for record in dataset.records(dataset.sequences("all")):
        add_scan(figures, dataset.read(record), rng)
    return figures


def add_scan(figures: Figures, scan: Scan, rng: np.random.Generator) -> None:
    """Add the measurements of one scan."""
    count = len(scan)
    labels = np.zeros(count, dtype=np.uint8) if scan.labels is None else scan.labels
    x, y, z, intensity = scan.points[:, :4].T
    distance = np.linalg.norm(scan.points[:, :3], axis=1)
    elevation = np.degrees(np.arctan2(z, np.linalg.norm(scan.points[:, :2], axis=1)))

    classes = figures.taxonomy.size + 1
    figures.points.append(count)
    figures.ranges.append(np.histogram(distance, RANGES)[0] / count)
    figures.elevations.append(np.histogram(elevation, ELEVATIONS)[0] / count)
    figures.shares.append(np.bincount(labels, minlength=classes) / count)

    laser = lasers_of(scan)
    if laser is not None:
        figures.lasers.append(np.bincount(laser))
        figures.relief.append(relief_of(laser, np.arctan2(y, x), labels, distance))

    sample = rng.choice(count, min(count, SAMPLE), replace=False)
    values = np.column_stack([labels, intensity, z, distance])[sample]
    figures.values.append(values.astype(np.float32))


def lasers_of(scan: Scan) -> np.ndarray | None:
    """Return the (N,) laser of each point, 0 = top; None if it cannot be told.

    The ring tells or, in KITTI's files, where the azimuth starts again from 0.
    """
    if scan.ring is not None:
        return scan.ring.max() - scan.ring.astype(int)

    azimuth = np.arctan2(scan.points[:, 1], scan.points[:, 0]) % (2 * np.pi)
    laser = np.cumsum(np.diff(azimuth, prepend=azimuth[:1]) < -np.pi)
    if laser[-1] != HDL64E_LASERS - 1:
        return None
    return laser


def relief_of(
    laser: np.ndarray, azimuth: np.ndarray, labels: np.ndarray, distance: np.ndarray
) -> np.ndarray:
    """Return how rough the surfaces 5 to 25 m away are.

    Returns:
        (n, 2) train id of a point, and how far its range is from the mean of its two neighbours'.
    """
    azimuth = azimuth % (2 * np.pi)
    order = np.lexsort((azimuth, laser))
    labels = labels[order]
    distance = distance[order]

    is_close = np.diff(azimuth[order]) < np.radians(0.8)
    is_close &= (np.diff(laser[order]) == 0) & (labels[1:] == labels[:-1])
    in_range = (distance > 5) & (distance < 25)

    middle = np.flatnonzero(is_close[1:] & is_close[:-1] & in_range[1:-1]) + 1
    mean = (distance[middle - 1] + distance[middle + 1]) / 2
    relief = np.abs(distance[middle] - mean)
    return np.column_stack([labels[middle], relief]).astype(np.float32)


def range_images(scans: list[Scan]) -> np.ndarray:
    """Return range and intensity of scans as pictures one below the other: (rows, width / 2)."""
    front = slice(IMAGE_WIDTH // 4, 3 * IMAGE_WIDTH // 4)
    rows = []
    for scan in scans:
        laser = lasers_of(scan)
        assert laser is not None
        azimuth = np.arctan2(-scan.points[:, 1], -scan.points[:, 0])
        column = ((azimuth / (2 * np.pi) + 0.5) * IMAGE_WIDTH).astype(int) % IMAGE_WIDTH

        # Both from 0 (dark) to 1 (bright): the range from 3 to 75 m, the intensity up to 0.7.
        distance = np.linalg.norm(scan.points[:, :3], axis=1)
        for values in (np.log(distance / 3) / np.log(25), scan.points[:, 3] / 0.7):
            image = np.full((laser.max() + 1, IMAGE_WIDTH), np.nan)
            image[laser, IMAGE_WIDTH - 1 - column] = values
            rows.append(image[:, front])
            rows.append(np.full((4, IMAGE_WIDTH // 2), np.nan))
        rows.append(np.full((10, IMAGE_WIDTH // 2), np.nan))
    return np.concatenate(rows)


def draw(specs: tuple[str, str], path: str) -> None:
    """Draw the front of a few scans of each dataset side by side: range above, intensity below."""
    figure, axes = plt.subplots(1, 2, figsize=(18, 6))
    for axis, spec in zip(axes, specs, strict=True):
        dataset = open_dataset(spec)
        records = dataset.records(dataset.sequences("all"))
        scans = []
        for index in range(DRAWN_SCANS):
            record = records[int((index + 0.5) * len(records) / DRAWN_SCANS)]
            scans.append(dataset.read(record))

        axis.imshow(range_images(scans), cmap="cividis", vmin=0, vmax=1, aspect="auto")
        axis.set_axis_off()
    figure.tight_layout(pad=0.3)
    figure.savefig(path, dpi=110)


def table(title: str, columns: tuple[str, ...], rows: Sequence[tuple[str, ...]]) -> Table:
    """Return a table whose first column is aligned to the left."""
    result = Table(title=title, show_edge=False)
    for name in columns:
        result.add_column(name, justify="left" if name == columns[0] else "right")
    for row in rows:
        result.add_row(*row)
    return result


def points_table(a: Figures, b: Figures) -> Table:
    rows = []
    for name, function in (("mean", np.mean), ("least", np.min), ("most", np.max)):
        points_a = f"{function(a.points):,.0f}"
        points_b = f"{function(b.points):,.0f}"
        rows.append((f"{name} points a scan", points_a, points_b))
    return table("points", ("", "A", "B"), rows)


def bins_table(
    title: str, edges: Sequence[int], bins_a: list[np.ndarray], bins_b: list[np.ndarray]
) -> Table:
    """Return the mean share of the points in each bin."""
    means_a = np.mean(bins_a, axis=0)
    means_b = np.mean(bins_b, axis=0)
    rows = []
    for index in range(len(edges) - 1):
        name = f"{edges[index]} to {edges[index + 1]}"
        rows.append((name, percent(means_a[index]), percent(means_b[index])))
    return table(f"share of the points by {title}, %", ("", "A", "B"), rows)


def lasers_table(a: Figures, b: Figures) -> Table:
    means_a = np.mean(a.lasers, axis=0)
    means_b = np.mean(b.lasers, axis=0)
    rows = []
    for laser, (returns_a, returns_b) in enumerate(zip(means_a, means_b, strict=True)):
        ratio = returns_b / returns_a
        rows.append((str(laser), f"{returns_a:.0f}", f"{returns_b:.0f}", f"{ratio:.2f}"))
    return table("returns a scan by laser, from the top", ("", "A", "B", "B / A"), rows)


def classes_table(a: Figures, b: Figures) -> Table:
    heads = ["class", "% A", "% B"]
    for value in ("intensity", "z", "range", "relief"):
        heads += [f"{value} A", f"{value} B"]

    shares_a = np.mean(a.shares, axis=0)
    shares_b = np.mean(b.shares, axis=0)
    rows = []
    for train_id, name in enumerate(("unlabelled", *a.taxonomy.classes)):
        values_a = values_of(a.values, train_id, columns=3)
        values_b = values_of(b.values, train_id, columns=3)
        cells = [name, percent(shares_a[train_id]), percent(shares_b[train_id])]
        for column in range(3):
            cells.append(quantiles(values_a[:, column]))
            cells.append(quantiles(values_b[:, column]))

        for figures in (a, b):
            relief = values_of(figures.relief, train_id, columns=1)
            cells.append(quantiles(relief, (0.5, 0.9), decimals=3))
        rows.append(tuple(cells))

    title = "classes; 10, 50 and 90 % quantiles (relief in metres: 50 and 90 %)"
    return table(title, tuple(heads), rows)


def values_of(rows: list[np.ndarray], train_id: int, columns: int) -> np.ndarray:
    """Return the (n, columns) values of one class, from rows of train id and values."""
    table = np.concatenate([np.zeros((0, columns + 1)), *rows])
    return table[table[:, 0] == train_id, 1:]


def percent(share: float) -> str:
    return f"{100 * share:.2f}"


def quantiles(
    values: np.ndarray, levels: tuple[float, ...] = (0.1, 0.5, 0.9), decimals: int = 2
) -> str:
    if len(values) <= FEWEST:
        return "–"
    return " ".join(f"{quantile:.{decimals}f}" for quantile in np.quantile(values, levels))


def main(first: str, second: str) -> None:
    a = measure(first)
    b = measure(second)
    console = Console(width=200)
    console.print(f"A is {first}, B is {second}")
    console.print(points_table(a, b))
    console.print(bins_table("range, m", RANGES, a.ranges, b.ranges))
    console.print(bins_table("elevation, degrees", ELEVATIONS, a.elevations, b.elevations))

    difference = np.mean(a.ranges, axis=0) - np.mean(b.ranges, axis=0)
    distance = np.abs(difference).sum() / 2
    console.print(f"total variation distance of the ranges: {distance:.3f}")

    if a.lasers and b.lasers:
        console.print(lasers_table(a, b))
    console.print(classes_table(a, b))


if __name__ == "__main__":
    main(sys.argv[1], sys.argv[2])
    if len(sys.argv) > 3:
        draw((sys.argv[1], sys.argv[2]), sys.argv[3])
