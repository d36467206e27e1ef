"""What a scan says of its sensor: lasers, field of view, height over the ground."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.ndimage import maximum_filter1d

NEAREST = 1.0  # metres: nearer returns are of what carries the sensor
ENDS = (0.5, 99.5)  # percentiles of the elevation that are the ends of the field of view
FEWEST = 100  # points that say something

FULL_TURN = 350  # degrees
JUMP = 0.7  # of the width of a scan that is no full turn: where the azimuth goes back by so much, another laser begins
STEP = 0.05  # of the width: most steps of the azimuth are smaller where a file is in an order
MOSTLY = 0.9
FEWEST_BEAMS, MOST_BEAMS = 4, 256
BIN = 0.02  # degrees, of the histogram of elevations
AROUND = 1.5  # degrees: a laser's peak is compared with the highest so near
PEAK = 0.15  # of that height
CRISP = 0.1  # share of the field of view that the peaks of lasers cover at most; where it is more they blur
SECTORS = 12  # of the turn
UNSPLIT = 0.75  # share of the peaks that a good sector has at least
INSIDE = 0.9  # share of the points that the peaks hold at least

CELL = 1.0  # metres: side of the cells of which the lowest points are looked at
REACH = 20.0  # metres: the ground is looked for so far
FADE = 8.0  # metres: a cell so far away counts half
TRIES = 400  # planes through three low points
THICKNESS = 0.1  # metres that the ground's points are off its plane
STEEPEST = 10.0  # degrees
DEEPEST = -0.5  # metres: what is higher over the origin is a ceiling
LARGE = 1.0  # square metres, twice the area of the triangle that a plane is laid through
FEWEST_CELLS = 30
AGREEING = 0.25  # weighted share of the cells that must be of the plane


@dataclass(frozen=True)
class Measured:
    """What was found; None where the scan does not tell.

    Attributes:
        beams: lasers.
        fov_up, fov_down: degrees above the horizon.
        height: metres of the sensor over the ground.
    """

    beams: int | None = None
    fov_up: float | None = None
    fov_down: float | None = None
    height: float | None = None


def measure(points: np.ndarray, ring: np.ndarray | None = None) -> Measured:
    """Measure a scan: (N, 3 or more) finite x, y, z in the sensor's frame and the file's order, (N,) ring or None."""
    xyz = points[:, :3].astype(np.float64)
    distant = np.hypot(xyz[:, 0], xyz[:, 1]) > NEAREST
    if distant.sum() < FEWEST:
        return Measured()
    elevation = elevations(xyz[distant])
    down, up = np.percentile(elevation, ENDS)
    beams = (
        len(np.unique(ring))
        if ring is not None
        else beams_by_order(xyz) or beams_by_peaks(xyz[distant])
    )
    return Measured(beams, float(up), float(down), ground_height(xyz[distant]))


def elevations(xyz: np.ndarray) -> np.ndarray:
    """(N,) degrees above the horizon."""
    return np.degrees(np.arctan2(xyz[:, 2], np.hypot(xyz[:, 0], xyz[:, 1])))


def beams_by_order(xyz: np.ndarray) -> int | None:
    """How many lasers there are in a file that has one after the other; None where it is in another order."""
    azimuth = np.degrees(np.arctan2(xyz[:, 1], xyz[:, 0]))
    low, high = np.percentile(azimuth, (0.1, 99.9))
    steps, width = np.diff(azimuth), high - low
    turned = (steps + 180) % 360 - 180
    if width > FULL_TURN:
        beams = round(abs(float(turned.sum())) / 360)
    else:  # near the ends it may tremble to and fro: what counts is how often it went back more than forth
        beams = 1 + abs(int((steps > JUMP * width).sum()) - int((steps < -JUMP * width).sum()))
        turned = steps
    in_order = np.mean(np.abs(turned) < STEP * width) > MOSTLY
    return beams if in_order and FEWEST_BEAMS <= beams <= MOST_BEAMS else None


def beams_by_peaks(xyz: np.ndarray) -> int | None:
    """How many lasers make peaks in the histogram of the elevations of (N, 3) points; None where they blur.

    Where the motion during the turn was taken out, a laser's peak is split: most sectors then have fewer than all.
    """
    elevation = elevations(xyz)
    sector = ((np.arctan2(xyz[:, 1], xyz[:, 0]) / (2 * np.pi) + 0.5) * SECTORS).astype(int)
    beams, covered = _peaks(elevation)
    in_sector = [
        _peaks(elevation[sector == k])[0] for k in range(SECTORS) if (sector == k).sum() >= FEWEST
    ]
    parts = np.percentile(in_sector or [0], 75)
    crisp = covered < CRISP and parts >= UNSPLIT * beams
    return beams if crisp and FEWEST_BEAMS <= beams <= MOST_BEAMS else None


def _peaks(elevation: np.ndarray) -> tuple[int, float]:
    """How many peaks hold nearly all of some elevations, and the share of the field of view that they cover."""
    low, high = np.percentile(elevation, (0.05, 99.95))
    counts, _ = np.histogram(elevation, np.arange(low - AROUND, high + AROUND, BIN))
    peak = counts > np.maximum(PEAK * maximum_filter1d(counts, int(2 * AROUND / BIN)), 1)
    if counts[peak].sum() < INSIDE * len(elevation):
        return 0, 1.0
    return int((np.diff(peak.astype(int), prepend=0) == 1).sum()), peak.sum() * BIN / max(
        high - low, BIN
    )


def ground_height(xyz: np.ndarray) -> float | None:
    """Metres of the origin over the ground plane; None where there is none.

    The plane is the one through three low points that most low points agree with, near ones counting
    more, and few are below; then least squares.
    """
    low = _lowest(xyz)
    if len(low) < FEWEST_CELLS:
        return None
    weight = 1 / (1 + np.hypot(low[:, 0], low[:, 1]) / FADE)
    plane = _best_plane(low, weight)
    if plane is None:
        return None
    across = np.column_stack([low[:, :2], np.ones(len(low))])
    for _ in range(3):
        near = np.abs(low[:, 2] - across @ plane) < THICKNESS
        if near.sum() < FEWEST_CELLS / 2:
            return None
        plane = np.linalg.lstsq(across[near], low[near, 2], rcond=None)[0]
    agreed = weight[near].sum() > AGREEING * weight.sum()
    return float(-plane[2]) if agreed and -plane[2] > DEEPEST else None


def _lowest(xyz: np.ndarray) -> np.ndarray:
    """(M, 3) the lowest point of each cell around the sensor."""
    xyz = xyz[np.hypot(xyz[:, 0], xyz[:, 1]) < REACH]
    column, row = np.floor((xyz[:, :2] + REACH) / CELL).astype(np.int64).T
    cell = column * int(2 * REACH / CELL + 1) + row
    order = np.lexsort((xyz[:, 2], cell))
    first = np.diff(cell[order], prepend=-1) > 0
    return xyz[order][first]


def _best_plane(low: np.ndarray, weight: np.ndarray) -> np.ndarray | None:
    """(3,) a, b, c of z = a x + b y + c; the same for the same points."""
    rng = np.random.default_rng(0)
    three = low[rng.choice(len(low), (TRIES, 3), p=weight / weight.sum())]
    corners = np.concatenate([three[:, :, :2], np.ones((TRIES, 3, 1))], axis=2)
    large = np.abs(np.linalg.det(corners)) > LARGE
    planes = np.linalg.solve(corners[large], three[large][:, :, 2:])[:, :, 0]
    planes = planes[np.hypot(planes[:, 0], planes[:, 1]) < np.tan(np.radians(STEEPEST))]
    if not len(planes):
        return None
    above = low[:, 2] - planes @ np.column_stack([low[:, :2], np.ones(len(low))]).T  # (planes, M)
    score = (np.abs(above) < THICKNESS) @ weight - (above < -3 * THICKNESS) @ weight
    return planes[score.argmax()]
