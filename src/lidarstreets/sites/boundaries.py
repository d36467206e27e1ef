"""Put hedges, walls and fences along the borders of plots and along streets."""

from dataclasses import dataclass, replace

import numpy as np

from lidarstreets.bodies.fences import FENCE_SHARES, Fence, draw_fence, gate
from lidarstreets.bodies.plants import Hedge, draw_hedge
from lidarstreets.sites.site import Plot

SEGMENT_LENGTH = 2.5  # length of a segment of a boundary, metres
DRIVE_WIDTH = 3.0  # width of the drive to a garage, metres
HEDGE_CHANCE = 0.55  # chance that the boundary of a garden is a hedge
FENCE_AND_HEDGE_CHANCE = 0.25  # chance that a fence has a hedge in front of or behind it
LOW_WALL_CHANCE = 0.2  # chance that a low wall stands in front of the boundary of a garden


@dataclass(frozen=True)
class Boundary:
    """One kind of boundary: a low wall, a fence or a hedge, or several one behind the other.

    Attributes:
        layers: each wall, fence or hedge, with its distance from the line of the boundary, metres.
        missing: share of the segments that are missing, 0 to 1.
    """

    layers: tuple[tuple[Fence | Hedge, float], ...]
    missing: float


def draw_boundary(rng: np.random.Generator, where: str = "garden") -> Boundary:
    """Draw a kind of boundary. `where` is a table of fences.toml.

    Only the boundary of a garden can be a hedge without a fence.
    """
    missing = float(rng.choice([0.0, 0.03, 0.2], p=[0.6, 0.3, 0.1]))
    hedge_height = float(rng.uniform(0.4, 1.4) if rng.random() < 0.4 else rng.uniform(1.2, 3.0))
    layers: list[tuple[Fence | Hedge, float]] = []
    if where == "garden" and rng.random() < LOW_WALL_CHANCE:
        wall = draw_fence(rng, FENCE_SHARES["low"])
        layers.append((replace(wall, height=rng.uniform(0.25, 0.9)), -rng.uniform(0.1, 0.5)))

    if where == "garden" and rng.random() < HEDGE_CHANCE:
        layers.append((draw_hedge(rng, hedge_height), 0.0))
        return Boundary(tuple(layers), missing)

    layers.append((draw_fence(rng, FENCE_SHARES[where]), 0.0))
    if rng.random() < FENCE_AND_HEDGE_CHANCE:
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

    Args:
        plot: the plot that the boundary belongs to.
        start, end: ends of the line: x along the street and distance from its middle line, metres.
        gap: x where a drive begins and ends; no segment lies between them.
    """
    rng = plot.rng
    line = np.array(end) - np.array(start)
    length = float(np.linalg.norm(line))
    if length < 1:
        return

    count = max(1, round(length / SEGMENT_LENGTH))
    piece = length / count
    yaw = np.arctan2(plot.side * line[1], line[0])

    for index in range(count):
        x, distance = np.array(start) + (index + 0.5) / count * line
        closes_gap = gap is not None and gap[0] - piece / 2 < x < gap[1] + piece / 2
        if closes_gap or rng.random() < boundary.missing:
            continue

        for layer, offset in boundary.layers:
            segment = layer.segment(rng, piece)
            plot.put_piece(segment, x, distance + offset, yaw, margin=1.5)


def enclose(plot: Plot, drive_x: float | None, depth: float) -> None:
    """Put boundaries around a plot that is `depth` metres deep.

    The drive that begins at x = `drive_x` gets a gap, unless `drive_x` is None.
    """
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
