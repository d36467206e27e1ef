"""The points of the head's epochs are drawn from those on disk."""

from __future__ import annotations

import numpy as np

from amvnet.distributed import Processes
from amvnet.training.head_points import PointDraw, PointSampler


def epoch(sampler: PointSampler, number: int) -> list[int]:
    sampler.set_epoch(number)
    return [index for batch in sampler for index in batch.tolist()]


def test_an_epoch_has_all_points_once_unless_fewer_are_drawn() -> None:
    sampler = PointSampler(PointDraw(1000), batch=100, seed=0, shuffle=True)
    assert sorted(epoch(sampler, 0)) == list(range(1000))


def test_each_epoch_draws_other_points_each_once() -> None:
    sampler = PointSampler(PointDraw(1000, drawn=200), batch=50, seed=0, shuffle=True)
    assert len(sampler) == 4
    epochs = [epoch(sampler, number) for number in range(20)]
    for points in epochs:
        assert len(set(points)) == len(points) == 200
    assert epochs[0] == epoch(sampler, 0)  # a resumed run repeats its epoch
    assert len(set(epochs[0]) & set(epochs[1])) < 100
    assert len(set(np.concatenate(epochs).tolist())) > 950  # almost all are seen


def test_balanced_draws_have_all_classes_equally_often() -> None:
    labels = np.repeat([1, 2, 5], [9000, 900, 100])
    rng = np.random.default_rng(0)
    square_roots = [94.87 / 134.87, 30 / 134.87, 10 / 134.87]
    for balance, expected in ((1.0, [1 / 3] * 3), (0.5, square_roots)):
        draw = PointDraw(len(labels), 6000, labels, balance)
        counts = np.bincount(labels[draw(rng)], minlength=6)[[1, 2, 5]]
        np.testing.assert_allclose(counts / 6000, expected, atol=0.03)


def test_processes_share_each_batch_of_the_drawn_points() -> None:
    draw = PointDraw(1000, drawn=200)
    alone = PointSampler(draw, batch=50, seed=0, shuffle=True)
    shares = []
    for rank in range(2):
        shares.append(PointSampler(draw, 50, 0, True, Processes(rank, 2)))
    for whole, first, second in zip(alone, *shares, strict=True):
        assert sorted(whole) == sorted([*first, *second])
