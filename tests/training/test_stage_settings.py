"""What the recipe says reaches the stages: class weights, weights of the losses, the schedule."""

from __future__ import annotations

import math
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import lightning as L
import numpy as np
import pytest
import torch

from amvnet.config.schema import HeadTraining, NetworkTraining, PointHeadConfig
from amvnet.data.datasets.open import open_dataset
from amvnet.data.taxonomy import SEMANTICKITTI
from amvnet.errors import InputError
from amvnet.models.point_head import PointHead
from amvnet.training import networks
from amvnet.training.head import HeadStage
from amvnet.training.losses import class_weights
from amvnet.training.networks import NetworkStage
from amvnet.training.stage import StageContext
from amvnet.weights.file import save

from fixtures.commands import not_none, run_cli
from fixtures.tiny import fresh_weights, make_streets, write_recipe


@pytest.fixture(scope="module")
def world(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("world")
    make_streets(root / "data", ("00", "01", "02", "03", "04"), scans=1)
    write_recipe(root / "recipe.yaml")
    save(fresh_weights(), root / "start.safetensors")
    return root


def arguments(world: Path, out: Path, stage: str, *options: object) -> list[object]:
    shared = ["--data", world / "data", "--out", out, "--stage", stage, "--with-val"]
    shared += ["--train-sequences", "00,01,02,03,04", "--init", world / "start.safetensors"]
    return ["train", world / "recipe.yaml", *shared, *options]


@pytest.mark.parametrize("power", [pytest.param(0, marks=pytest.mark.full), 0.4])
@pytest.mark.parametrize("name", ["rv", pytest.param("bev", marks=pytest.mark.full)])
def test_a_stage_has_the_class_weights_of_its_scans_if_the_recipe_says_so(
    world: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str, power: float
) -> None:
    stages: list[NetworkStage] = []

    def stop(stage: NetworkStage, *_: object, **options: object) -> None:
        stages.append(stage)
        raise InputError("enough")

    monkeypatch.setattr(networks, "fit", stop)
    option = (f"--training.{name}.class_weights", power)
    assert run_cli(*arguments(world, tmp_path, name, *option))[0] == 2

    (stage,) = stages
    if not power:
        assert stage.class_weights is None
        return
    counts = np.zeros(20, dtype=np.int64)
    dataset = open_dataset(str(world / "data"))
    for record in dataset.records(("00", "01", "02", "03", "04")):
        counts += np.bincount(not_none(dataset.read(record).labels), minlength=20)
    np.testing.assert_array_equal(not_none(stage.class_weights), class_weights(counts[1:], power))


def test_the_loss_of_the_head_equals_its_formula() -> None:
    net = PointHead(PointHeadConfig(neighbours=4, hidden=(8, 8), fc=8), 19)
    points: Any = None  # the batch is given
    stage = HeadStage(StageContext(HeadTraining(epochs=1), SEMANTICKITTI), net, points, None)
    stage.trainer = L.Trainer(accelerator="cpu", logger=False, enable_checkpointing=False)
    stage.log = lambda *_, **options: None  # type: ignore[method-assign]

    torch.manual_seed(0)
    point, rows = torch.randn(30, 42), torch.randn(30, 4, 42)
    labels = torch.randint(1, 20, (30,))
    loss = stage.eval().training_step((point, rows, labels, torch.ones(30)), 0)

    log_probabilities = net.eval()(point, rows).log_softmax(dim=1)
    total = 0.0
    for row, label in zip(log_probabilities.tolist(), labels.tolist(), strict=True):
        total -= row[label - 1]
    assert loss.item() == pytest.approx(total / 30, rel=1e-5)


def one_cycle(step: int, steps: int, peak: float, warmup: float, held: int = 0) -> float:
    """Return the learning rate of a step: a cosine up to the peak, and one down to almost 0."""
    top = warmup * steps - 1
    # The held steps repeat the one at the peak.
    step -= min(max(step - math.ceil(top), 0), held)
    steps -= held
    first, last = peak / 25, peak / 25e4

    def cosine(start: float, end: float, share: float) -> float:
        return end + (start - end) / 2 * (1 + math.cos(math.pi * share))

    if step <= top:
        return cosine(first, peak, step / top)
    return cosine(peak, last, (step - top) / (steps - 1 - top))


@pytest.mark.parametrize("accumulate", [1, pytest.param(2, marks=pytest.mark.full)])
@pytest.mark.parametrize(
    ("warmup", "hold", "held"),
    [
        pytest.param(0.2, 0, 0, marks=pytest.mark.full),
        pytest.param(0.5, 0, 0, marks=pytest.mark.full),
        (0.2, 0.5, 6),
    ],
)
def test_the_learning_rate_of_a_whole_run_is_one_cycle(
    world: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    accumulate: int,
    warmup: float,
    hold: float,
    held: int,
) -> None:
    """Five scans in batches of two: the last step of each epoch is incomplete."""
    rates: list[float] = []
    momenta: list[float] = []

    def note(self: NetworkStage, optimizer: torch.optim.Optimizer) -> None:
        rates.append(optimizer.param_groups[0]["lr"])
        momenta.append(optimizer.param_groups[0]["betas"][0])

    monkeypatch.setattr(NetworkStage, "on_before_optimizer_step", note)
    options = ["--training.bev.accumulate", accumulate, "--training.bev.warmup", warmup]
    options += ["--training.bev.hold", hold]
    options += ["--training.bev.lr", 0.003, "--training.bev.epochs", 4]
    assert run_cli(*arguments(world, tmp_path, "bev", *options)) == (0, "")

    steps = 4 * 3
    expected = [one_cycle(step, steps, 0.003, warmup, held) for step in range(steps)]
    assert rates == pytest.approx(expected)
    assert momenta[0] == max(momenta) == pytest.approx(0.95)
    assert 0.85 <= min(momenta) < 0.87


@pytest.mark.parametrize(("scans", "batch", "parts"), [(5, 2, 1), (5, 2, 2), (7, 2, 3), (8, 4, 2)])
def test_each_scan_has_the_same_share_of_the_gradient(scans: int, batch: int, parts: int) -> None:
    """Also in the last step of an epoch, which may have fewer parts, and one with fewer scans."""
    config = NetworkTraining(epochs=1, batch=batch * parts, lr=1e-3)
    view: Any = None
    stage = NetworkStage(StageContext(config, SEMANTICKITTI), view, torch.nn.Linear(1, 1))
    loader = SimpleNamespace(batch_size=batch, sampler=range(scans))
    trainer: Any = SimpleNamespace(accumulate_grad_batches=parts, train_dataloader=loader)
    stage._trainer = trainer

    sizes = [min(batch, scans - first) for first in range(0, scans, batch)]
    for step in range(0, len(sizes), parts):
        in_step = sizes[step : step + parts]
        for index, size in enumerate(in_step, start=step):
            # Lightning divides by the number of parts, and the loss is a mean over the part.
            share_of_scan = stage.step_factor(size, index) / parts / size
            assert share_of_scan == pytest.approx(1 / sum(in_step))
