"""The vote of neighbours equals a loop over the points, and leaves alone what nothing hides."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pytest
import torch
from torch import Tensor

from amvnet.config.schema import RangeViewConfig
from amvnet.models import voting
from amvnet.models.views import range_view
from amvnet.models.views.points import PointBatch
from amvnet.models.views.range_view import RangeView
from amvnet.scan import Scan

RandomScan = Callable[..., Scan]

K = 4
VIEW = RangeViewConfig(height=8, width=16, fov_up=20.0, fov_down=-20.0)
NO_BODY = RangeViewConfig(height=8, width=32, fov_up=60.0, fov_down=-60.0, nearest=9.0)


def at_pixel(row: int, column: float, distance: float) -> list[float]:
    """Return a point in the middle of a pixel of VIEW, with an intensity."""
    elevation = math.radians(20 - (row + 0.5) / 8 * 40)
    azimuth = math.pi * (1 - 2 * (column + 0.5) / 16)
    x = distance * math.cos(elevation) * math.cos(azimuth)
    y = distance * math.cos(elevation) * math.sin(azimuth)
    return [x, y, distance * math.sin(elevation), 0.5]


def crowded(scan: Scan, seed: int) -> Scan:
    """Return the scan with all points between 8 and 14 metres from the sensor."""
    xyz = scan.points[:, :3]
    distance = np.random.default_rng(seed).uniform(8, 14, (len(scan), 1))
    xyz = xyz / np.linalg.norm(xyz, axis=1, keepdims=True) * distance
    return Scan(np.column_stack([xyz, scan.points[:, 3]]).astype(np.float32))


def batch_of(points: list[list[float]]) -> PointBatch:
    return PointBatch.of([Scan(np.array(points, np.float32))])


def scores_of(labels: list[int]) -> Tensor:
    """Return (P, K) probabilities whose largest are those of the labels 0..K - 1."""
    return torch.eye(K)[torch.tensor(labels)] * 0.6 + 0.1


def vote(batch: PointBatch, f: Tensor, view: RangeViewConfig = VIEW) -> Tensor:
    return voting.vote(f, batch, RangeView(view).project(batch))


def vote_by_loop(batch: PointBatch, f: Tensor, view: RangeViewConfig) -> list[int]:
    """Return what each point is labelled by plain loops, with scans as they are and in order."""
    half = range_view.WINDOW // 2
    offsets = range(-half, half + 1)
    kernel = {
        (dy, dx): math.exp(-(dx * dx + dy * dy) / (2 * voting.SIGMA**2))
        for dy in offsets
        for dx in offsets
    }
    total = sum(kernel.values())

    points = batch.points.double().numpy()
    ranges = np.linalg.norm(points[:, :3], axis=1)
    projection = RangeView(view)
    rows = projection.rows(batch).tolist()
    columns = projection.columns(batch).tolist()
    scans = batch.scan.tolist()
    shown: dict[tuple[int, int, int], int] = {}
    for point in sorted(range(len(points)), key=lambda point: -ranges[point]):
        if ranges[point] >= view.nearest:
            shown[scans[point], rows[point], columns[point]] = point

    labels = f.argmax(dim=1).tolist()
    voted = []
    for point in range(len(points)):
        votes = []
        for (dy, dx), gaussian in kernel.items():
            pixel = (scans[point], rows[point] + dy, (columns[point] + dx) % view.width)
            voter = point if dy == dx == 0 else shown.get(pixel)
            if voter is not None:
                weight = 1 - gaussian / total
                votes.append((weight * abs(ranges[voter] - ranges[point]), labels[voter]))

        votes = sorted(votes)[: voting.NEIGHBOURS]
        chosen = [label for difference, label in votes if difference <= voting.CUTOFF]
        # The first of those with the most votes: Python's max and list.index keep the order.
        voted.append(max(chosen, key=chosen.count))
    return voted


@pytest.mark.parametrize(
    "numbers",
    [{}, {"NEIGHBOURS": 9, "CUTOFF": 4.0}, {"WINDOW": 3, "NEIGHBOURS": 3, "SIGMA": 0.5}],
    ids=["as published", "more and farther", "smaller window"],
)
@pytest.mark.parametrize("view", [VIEW, NO_BODY], ids=["all points", "without the car's own body"])
def test_a_vote_equals_a_loop_over_the_points(
    random_scan: RandomScan,
    monkeypatch: pytest.MonkeyPatch,
    numbers: dict[str, float],
    view: RangeViewConfig,
) -> None:
    for name, number in numbers.items():
        monkeypatch.setattr(voting, name, number)
    monkeypatch.setattr(range_view, "WINDOW", numbers.get("WINDOW", range_view.WINDOW))
    batch = PointBatch.of([crowded(random_scan(500), 1), crowded(random_scan(300), 2)])
    f = torch.rand(len(batch.points), K, generator=torch.Generator().manual_seed(0))

    shares = vote(batch, f, view)

    assert shares.argmax(dim=1).tolist() == vote_by_loop(batch, f, view)
    assert torch.allclose(shares.sum(dim=1), torch.ones(len(f)))
    changed = (shares.argmax(dim=1) != f.argmax(dim=1)).float().mean()
    assert 0.05 < changed < 0.95  # else the test would not say much


def test_a_scan_without_occlusion_keeps_labels_that_change_with_the_distance() -> None:
    rng = np.random.default_rng(0)
    labels = rng.integers(0, K, (VIEW.height, VIEW.width))
    points = []
    for (row, column), label in np.ndenumerate(labels):
        points.append(at_pixel(row, column, 5 + 3 * label + rng.uniform(0, 1)))

    flat = labels.flatten().tolist()
    assert vote(batch_of(points), scores_of(flat)).argmax(dim=1).tolist() == flat


def test_a_point_alone_at_its_distance_keeps_its_label(monkeypatch: pytest.MonkeyPatch) -> None:
    far_ones = [at_pixel(4, column, 10) for column in (5, 6, 8, 9)]
    lone = at_pixel(4, 7, 12)
    f = scores_of([2, 2, 2, 2, 1])
    assert vote(batch_of([*far_ones, lone]), f)[-1].argmax() == 1
    monkeypatch.setattr(voting, "CUTOFF", 2.5)
    assert vote(batch_of([*far_ones, lone]), f)[-1].argmax() == 2


def test_of_equal_votes_those_of_least_difference_count(monkeypatch: pytest.MonkeyPatch) -> None:
    row = [at_pixel(4, column, distance) for column, distance in ((5, 10.4), (6, 10), (7, 10.6))]
    f = scores_of([1, 3, 2])
    monkeypatch.setattr(voting, "NEIGHBOURS", 3)
    assert vote(batch_of(row), f)[1].argmax() == 3  # its own vote
    # With another point at its own distance there are two votes of class 1.
    more = [*row, at_pixel(4, 8, 10.5)]
    monkeypatch.setattr(voting, "NEIGHBOURS", 4)
    assert vote(batch_of(more), scores_of([1, 3, 2, 1]))[1].argmax() == 1


def test_a_point_exactly_at_the_cutoff_votes(monkeypatch: pytest.MonkeyPatch) -> None:
    batch = batch_of([at_pixel(4, 7, 10), at_pixel(4, 8, 12)])
    distance = batch.points[:, :3].norm(dim=1)
    next_to_it = voting.window_weights()[13]  # to the right of the middle of a 5 x 5 window
    difference = ((distance[1] - distance[0]) * next_to_it).numpy()
    for cutoff, does_vote in ((difference, True), (np.nextafter(difference, 0), False)):
        monkeypatch.setattr(voting, "CUTOFF", float(cutoff))
        assert (vote(batch, scores_of([1, 2]))[0, 2] > 0) == does_vote
