"""The points of the head's epochs are drawn from those on disk."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from amvnet.config.recipes import load_recipe
from amvnet.config.schema import HeadTraining
from amvnet.data.datasets.open import open_dataset
from amvnet.data.datasets.training_data import Source, TrainingData
from amvnet.runtime.distributed import ALONE, Processes
from amvnet.training.head_points import PointGatherer, PointSampler
from amvnet.training.plan import Plan

from fixtures.tiny import fresh_weights, make_streets, write_recipe

ONE_CLASS = np.ones(1000, dtype=np.uint8)


def sampler_of(
    config: HeadTraining, labels: np.ndarray = ONE_CLASS, processes: Processes = ALONE
) -> PointSampler:
    return PointSampler(labels, config, 0, processes)


def epoch(sampler: PointSampler, number: int) -> list[int]:
    sampler.set_epoch(number)
    return [index for batch in sampler for index in batch.tolist()]


def test_an_epoch_has_all_points_once_unless_fewer_are_drawn() -> None:
    assert sorted(epoch(sampler_of(HeadTraining(batch=100)), 0)) == list(range(1000))


def test_each_epoch_draws_other_points_each_once() -> None:
    sampler = sampler_of(HeadTraining(batch=50, drawn=200))
    assert len(sampler) == 4
    epochs = [epoch(sampler, number) for number in range(20)]
    for points in epochs:
        assert len(set(points)) == len(points) == 200
    assert epochs[0] == epoch(sampler, 0)  # a resumed run repeats its epoch
    assert len(set(epochs[0]) & set(epochs[1])) < 100
    assert len(set(np.concatenate(epochs).tolist())) > 950  # almost all are seen


def test_a_smaller_last_batch_is_left_out_unless_it_is_the_only_one() -> None:
    for batch, sizes in ((300, [300, 300, 300]), (5000, [1000])):
        assert [len(points) for points in sampler_of(HeadTraining(batch=batch))] == sizes


def test_balanced_draws_have_all_classes_equally_often() -> None:
    labels = np.repeat([1, 2, 5], [9000, 900, 100])
    square_roots = [94.87 / 134.87, 30 / 134.87, 10 / 134.87]
    for balance, expected in ((1.0, [1 / 3] * 3), (0.5, square_roots)):
        config = HeadTraining(batch=6000, drawn=6000, balance=balance)
        counts = np.bincount(labels[epoch(sampler_of(config, labels), 0)], minlength=6)[[1, 2, 5]]
        np.testing.assert_allclose(counts / 6000, expected, atol=0.03)


def test_processes_share_each_batch_of_the_drawn_points() -> None:
    config = HeadTraining(batch=50, drawn=200)
    shares: list[Iterator[np.ndarray]] = []
    for rank in range(2):
        shares.append(iter(sampler_of(config, processes=Processes(rank, 2))))
    for whole, first, second in zip(sampler_of(config), *shares, strict=True):
        assert sorted(whole) == sorted([*first, *second])


def test_the_points_that_are_drawn_stand_for_all_uncertain_ones(tmp_path: Path) -> None:
    dataset = open_dataset(str(make_streets(tmp_path / "data", ("00",))))
    data = TrainingData([Source(dataset, dataset.records(["00"]))])
    points = []
    for most in (60, 10**6):
        path = write_recipe(tmp_path / "r.yaml", training={"head": {"points": most}})
        plan = Plan(load_recipe(str(path)), data, tmp_path / "run")
        points.append(PointGatherer(plan, fresh_weights()).gather(data, tmp_path / str(most)))

    few, everything = points
    assert len(few) == 60 < len(everything)
    stand_for = few[np.arange(len(few))][3]
    assert float(stand_for.sum()) == pytest.approx(len(everything))
    assert (everything[np.arange(len(everything))][3] == 1).all()
