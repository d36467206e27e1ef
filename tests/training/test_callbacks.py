"""The weights that are averaged and kept, and the draws of each batch."""

from __future__ import annotations

import time
from copy import deepcopy
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from torch import nn

from amvnet.config.schema import HeadTraining, NetworkTraining, Recipe, TrainingConfig
from amvnet.training.callbacks import AverageWeights, EpochLines, KeepWeights, SeedBatches
from amvnet.training.run_folder import RunFolder, StageFolder
from amvnet.training.stage import _epochs_after
from amvnet.weights.file import DONE, load

from fixtures.tiny import fresh_weights


def small_net() -> nn.Module:
    torch.manual_seed(0)
    return nn.Sequential(nn.Linear(3, 2), nn.BatchNorm1d(2))


def take_steps(net: nn.Module, callback: AverageWeights, first: int, count: int) -> list[Any]:
    """Change the weights in some steps, as an optimizer would; return the weights after each."""
    module: Any = SimpleNamespace(trained=net)
    history = []
    for step in range(first, first + count):
        torch.manual_seed(step)
        with torch.no_grad():
            for parameter in net.parameters():
                parameter.add_(torch.randn_like(parameter))
        net(torch.randn(5, 3))  # changes the statistics of the batch norm

        trainer: Any = SimpleNamespace(global_step=step + 1)
        for _ in range(2):  # the second batch belongs to the next step
            callback.on_train_batch_end(trainer, module, None, None, 0)
        history.append(deepcopy(net.state_dict()))
    return history


def begin(net: nn.Module, callback: AverageWeights) -> None:
    module: Any = SimpleNamespace(trained=net)
    callback.on_fit_start(SimpleNamespace(), module)  # type: ignore[arg-type]


def test_the_average_of_weights_and_statistics_equals_a_loop() -> None:
    net = small_net()
    callback = AverageWeights(0.5)
    begin(net, callback)
    expected = deepcopy(net.state_dict())

    for step, weights in enumerate(take_steps(net, callback, 0, 12)):
        decay = min(0.5, (1 + step) / (10 + step))
        for name, value in weights.items():
            if value.is_floating_point():
                expected[name] = decay * expected[name] + (1 - decay) * value

    assert callback.average["1.num_batches_tracked"] == 12
    del expected["1.num_batches_tracked"]
    for name, value in expected.items():
        torch.testing.assert_close(callback.average[name], value)
    assert not torch.equal(callback.average["1.running_mean"], net.state_dict()["1.running_mean"])


def test_an_average_that_is_saved_and_loaded_goes_on_as_before() -> None:
    net = small_net()
    whole = AverageWeights(0.9)
    begin(net, whole)
    take_steps(net, whole, 0, 3)
    state = deepcopy(whole.state_dict())
    half_way = deepcopy(net.state_dict())
    take_steps(net, whole, 3, 3)

    net.load_state_dict(half_way)
    resumed = AverageWeights(0.9)
    resumed.load_state_dict(state)
    begin(net, resumed)
    take_steps(net, resumed, 3, 3)
    for name, value in whole.average.items():
        assert torch.equal(resumed.average[name], value)


def test_a_network_has_the_averaged_weights_only_in_the_validation() -> None:
    net = small_net()
    callback = AverageWeights(0.9)
    begin(net, callback)
    take_steps(net, callback, 0, 4)

    before = deepcopy(net.state_dict())
    trainer: Any = SimpleNamespace()
    module: Any = SimpleNamespace(trained=net)
    callback.on_validation_start(trainer, module)
    for name, value in net.state_dict().items():
        assert torch.equal(value, callback.average[name])
    callback.on_validation_end(trainer, module)
    for name, value in net.state_dict().items():
        assert torch.equal(value, before[name])


def test_the_best_weights_are_the_first_with_the_highest_miou(tmp_path: Path) -> None:
    weights = fresh_weights()
    range_net = weights.build().range_net
    module: Any = SimpleNamespace(trained=range_net, check_epoch=lambda: None, own_miou=None)
    keep = object.__new__(KeepWeights)
    keep.folder = StageFolder(tmp_path)
    keep.part = "range_net"
    keep.weights = weights
    keep.settings = {}
    keep.record = {}
    keep.started = 0.0
    keep.seconds_before = 0.0
    keep.highest = -1.0

    for epoch, miou in enumerate((0.2, 0.5, 0.5, 0.3, 0.4)):
        trainer: Any = SimpleNamespace(
            callback_metrics={"val/miou": miou},
            current_epoch=epoch,
            is_global_zero=True,
            callbacks=[],
        )
        keep.on_train_epoch_end(trainer, module)
    kept = {name: load(tmp_path / f"{name}.safetensors").metrics for name in ("best", "last")}
    assert kept["best"]["range_net"] == {"val/miou": 0.5, "epoch": 1}
    assert kept["last"]["range_net"] == {"val/miou": 0.4, "epoch": 4}


def test_the_time_of_a_training_is_that_of_all_its_calls(monkeypatch: pytest.MonkeyPatch) -> None:
    calls = []
    for _ in range(2):
        call = object.__new__(KeepWeights)
        call.highest, call.started, call.seconds_before = 0.5, 1000.0, 0.0
        calls.append(call)
    monkeypatch.setattr(time, "monotonic", lambda: 1100.0)
    calls[1].load_state_dict(calls[0].state_dict())
    calls[1].started = 1070.0
    assert calls[1].state_dict() == {"highest": 0.5, "seconds": 130}


def test_each_batch_has_draws_of_its_own_which_a_resumed_run_repeats() -> None:
    def draw(epoch: int, index: int, rank: int) -> tuple[float, ...]:
        trainer: Any = SimpleNamespace(current_epoch=epoch)
        module: Any = None
        SeedBatches(7, rank).on_train_batch_start(trainer, module, None, index)
        return tuple(torch.rand(3).tolist())

    places = [(epoch, index, rank) for epoch in range(3) for index in range(3) for rank in (0, 1)]
    draws = [draw(*place) for place in places]
    assert len(set(draws)) == len(places)
    assert [draw(*place) for place in places] == draws


def test_a_line_has_percent_and_the_whole_time_left(monkeypatch: pytest.MonkeyPatch) -> None:
    lines: list[str] = []
    times = iter([100.0, 110.0])
    monkeypatch.setattr("amvnet.training.callbacks.time.monotonic", lambda: next(times))
    callback = EpochLines(lines.append, "rv", later=6)
    metrics = {"train/loss": 1.5, "val/miou": 0.1234, "val/miou_present": 0.4}
    trainer: Any = SimpleNamespace(callback_metrics=metrics, max_epochs=5, current_epoch=2)
    module: Any = None
    callback.on_train_epoch_start(trainer, module)
    callback.on_train_epoch_end(trainer, module)
    assert lines == [
        "rv epoch 3/5: loss 1.500, val mIoU 12.3% (classes present 40.0%); epoch in 0:00:10, "
        "0:00:20 left, about 0:01:20 with the stages that follow"
    ]


@pytest.mark.parametrize(
    ("resume", "views", "later"), [(False, 0, 7 + 1), (False, 4, 7 + 4), (True, 4, 4)]
)
def test_the_later_stages_are_those_that_are_not_finished(
    resume: bool, views: int, later: int, tmp_path: Path
) -> None:
    """The head takes as long as scoring all scans once for each view."""
    (tmp_path / "bev").mkdir()
    (tmp_path / "bev" / DONE).touch()
    training = TrainingConfig(
        bev=NetworkTraining(epochs=7, batch=1, lr=0.1), head=HeadTraining(views=views)
    )
    stage: Any = SimpleNamespace(name="rv")
    plan: Any = SimpleNamespace(
        stages=("rv", "bev", "head"),
        recipe=Recipe(training=training),
        resume=resume,
        folder=RunFolder(tmp_path),
    )
    assert _epochs_after(stage, plan) == later
