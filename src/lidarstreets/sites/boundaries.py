"""Hedges, walls and fences along the borders of plots and along streets."""

from dataclasses import dataclass, replace

import numpy as np

from lidarstreets.bodies.fences import SHARES, Fence, draw_fence, gate
from lidarstreets.bodies.plants import Hedge, draw_hedge
from lidarstreets.sites.site import Plot

# Metres: length of a segment of a boundary, and width of the drive to a garage.
SEGMENT = 2.5
DRIVE_WIDTH = 3.0
# Chances that a boundary is a hedge, that a fence has a hedge in front of or behind it, and that a
# low wall stands in front of the boundary of a garden.
HEDGE = 0.55
FENCE_AND_HEDGE = 0.25
LOW_WALL = 0.2


@dataclass(frozen=True)
class Boundary:
    """One kind of boundary: a low wall, a fence, a hedge, or several, one behind the other.

    Attributes:
        layers: each of them, and its distance from the line of the boundary in metres.
        missing: share of the segments that are not there.
    """

    layers: tuple[tuple[Fence | Hedge, float], ...]
    missing: float


def draw_boundary(rng: np.random.Generator, where: str = "garden") -> Boundary:
    """Draw a kind of boundary for a place in fences.toml; only gardens have hedges alone."""
    missing = float(rng.choice([0.0, 0.03, 0.2], p=[0.6, 0.3, 0.1]))
    hedge_height = float(rng.uniform(0.4, 1.4) if rng.random() < 0.4 else rng.uniform(1.2, 3.0))
    layers: list[tuple[Fence | Hedge, float]] = []
    if where == "garden" and rng.random() < LOW_WALL:
        wall = draw_fence(rng, SHARES["low"])
        layers.append((replace(wall, height=rng.uniform(0.25, 0.9)), -rng.uniform(0.1, 0.5)))

    if where == "garden" and rng.random() < HEDGE:
        layers.append((draw_hedge(rng, hedge_height), 0.0))
        return Boundary(tuple(layers), missing)

    layers.append((draw_fence(rng, SHARES[where]), 0.0))
    if rng.random() < FENCE_AND_HEDGE:
        offset = rng.choice([-1, 1]) * rng.uniform(0.05, 0.7)
        layers.append((draw_hedge(rng, hedge_height), offset))
    return Boundary(tuple(layers), missing)


def line_up(
    plot: Plot,
    boundary: Boundary,
    start: tuple[float, float],
    end: tuple[float, float],
    gap: tuple[float, float] | None = None,
) -> None:
    """Put the segments of a boundary in a straight line.

    `start` and `end` are x along the street and the distance from its middle line. `gap` is the
    two x between which a drive is, which no segment closes off.
    """
    rng = plot.rng
    line = np.array(end) - np.array(start)
    length = float(np.linalg.norm(line))
    if length < 1:
        return

    count = max(1, round(length / SEGMENT))
    piece = length / count
    yaw = np.arctan2(plot.side * line[1], line[0])

    for index in range(count):
        x, distance = np.array(start) + (index + 0.5) / count * line
        closes_gap = gap is not None and gap[0] - piece / 2 < x < gap[1] + piece / 2
        if closes_gap or rng.random() < boundary.missing:
            continue

        for layer, offset in boundary.layers:
            segment = layer.segment(rng, piece)
            plot.put_as_is(segment, x, distance + offset, yaw, margin=1.5)


def enclose(plot: Plot, drive_x: float | None, depth: float) -> None:
    """Put boundaries around a plot, with a gap for a drive that begins at `drive_x`."""
    rng = plot.rng
    boundary = draw_boundary(rng)
    front = plot.front + rng.choice([0.15, 0.5, 1.0, 2.5], p=[0.3, 0.35, 0.2, 0.15])
    back = plot.front + depth

    gap = None
    if drive_x is not None:
        gap = (drive_x, drive_x + DRIVE_WIDTH)
        if rng.random() < 0.12:
            closed = gate(rng, DRIVE_WIDTH, rng.uniform(0.8, 2.0))
            plot.put(closed, drive_x + DRIVE_WIDTH / 2, front, margin=1.5)
    line_up(plot, boundary, (plot.x, front), (plot.end, front), gap)

    sides = boundary if rng.random() < 0.6 else draw_boundary(rng)
    if rng.random() < 0.5:
        line_up(plot, sides, (plot.x, front), (plot.x + rng.normal(scale=0.5), back))
    if rng.random() < 0.3:
        line_up(plot, sides, (plot.x, back), (plot.end, back))
