"""The heads of an ensemble learn in one stage what each would learn alone."""

from __future__ import annotations

import copy
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import torch
from torch.utils import data

from amvnet.config.nested import from_dict
from amvnet.config.schema import PointHeadConfig, TrainingConfig
from amvnet.data.taxonomy import SEMANTICKITTI
from amvnet.models.head_ensemble import Head, build_head, heads_of
from amvnet.training.fit import FitOptions, Loaders, fit
from amvnet.training.head_points import (
    HeadPoints,
    PointDraw,
    PointSampler,
    make_head_loader,
    point_dtype,
)
from amvnet.training.head_stage import HeadStage
from amvnet.training.run_plan import RunOptions

HEADS = 3
TRAINING = from_dict(
    TrainingConfig,
    {"head": {"epochs": 2, "batch": 32, "lr": 0.05}, "accelerator": "cpu"},
)


def random_points(path: Path) -> HeadPoints:
    """Write 300 points with random features and labels."""
    rng = np.random.default_rng(0)
    points = np.empty(300, point_dtype(19, neighbours=4))
    points["point"] = rng.normal(size=points["point"].shape)
    points["rows"] = rng.normal(size=points["rows"].shape)
    points["labels"] = rng.integers(1, 20, 300)
    points["stands_for"] = 1
    points.tofile(path)
    return HeadPoints(path, points.dtype, 300, np.zeros((20, 20)), 0.5)


class OneHeads(PointSampler):
    """The batches that one head of the ensemble sees."""

    index = 0

    def __iter__(self) -> Iterator[np.ndarray]:
        for batch in super().__iter__():
            yield np.split(batch, HEADS)[self.index]


def learn(head: Head, points: HeadPoints, folder: Path, index: int | None = None) -> Head:
    """Train a copy of a head, with all batches or with those of one head of the ensemble."""
    trained = copy.deepcopy(head)
    stage = HeadStage(
        trained, points, None, config=TRAINING.head, taxonomy=SEMANTICKITTI, weights=None
    )
    draw = PointDraw(len(points), heads=HEADS)
    loader = make_head_loader(points, 32, seed=0, shuffle=True, draw=draw)
    if index is not None:
        sampler = OneHeads(draw, 32, seed=0, shuffle=True)
        sampler.index = index
        loader = data.DataLoader(points, batch_size=None, sampler=sampler)  # type: ignore[arg-type]

    options = FitOptions(TRAINING, folder, TRAINING.head.epochs, RunOptions(say=lambda line: None))
    fit(stage, options, Loaders(loader, None))
    return trained


def test_the_heads_of_an_ensemble_learn_as_each_would_alone(tmp_path: Path) -> None:
    points = random_points(tmp_path / "points")
    torch.manual_seed(0)
    ensemble = build_head(PointHeadConfig(neighbours=4, hidden=(8, 8), fc=8, heads=HEADS), 19)
    together = learn(ensemble, points, tmp_path / "together")

    for index, head in enumerate(heads_of(ensemble)):
        alone = learn(head, points, tmp_path / str(index), index)
        changed = heads_of(together)[index].state_dict()
        for name, value in alone.state_dict().items():
            torch.testing.assert_close(changed[name], value)
        assert not torch.allclose(changed["fc.1.weight"], head.state_dict()["fc.1.weight"])
