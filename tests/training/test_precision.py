"""The precision that `auto` stands for."""

import pytest
import torch

from amvnet.config.recipes import load_recipe
from amvnet.config.schema import TrainingConfig
from amvnet.training.stage import precision_of


@pytest.mark.parametrize(
    ("capabilities", "expected"),
    [({"avx512_bf16": True}, "bf16-mixed"), ({"avx512_f": True}, "32-true"), ({}, "32-true")],
)
def test_auto_is_bfloat16_where_the_processor_multiplies_it(
    monkeypatch: pytest.MonkeyPatch, capabilities: dict[str, bool], expected: str
) -> None:
    monkeypatch.setattr(torch.cpu, "get_capabilities", lambda: capabilities, raising=False)
    assert precision_of(TrainingConfig(precision="auto", accelerator="cpu")) == expected


def test_a_torch_that_does_not_tell_trains_in_32_bits(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delattr(torch.cpu, "get_capabilities", raising=False)
    assert precision_of(TrainingConfig(precision="auto", accelerator="cpu")) == "32-true"


@pytest.mark.parametrize("includes_bfloat16", [True, False])
def test_a_gpu_is_asked_without_emulation(
    monkeypatch: pytest.MonkeyPatch, includes_bfloat16: bool
) -> None:
    def is_bf16_supported(including_emulation: bool = True) -> bool:
        return including_emulation or includes_bfloat16

    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "is_bf16_supported", is_bf16_supported)
    expected = "bf16-mixed" if includes_bfloat16 else "32-true"
    assert precision_of(TrainingConfig(precision="auto", accelerator="gpu")) == expected


def test_a_named_precision_stays(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch.cpu, "get_capabilities", dict, raising=False)
    training = TrainingConfig(precision="bf16-mixed", accelerator="cpu")
    assert precision_of(training) == "bf16-mixed"


@pytest.mark.parametrize("recipe", ["simulated-compact", "semantickitti-compact", "finetune"])
def test_the_recipes_for_small_machines_leave_it_to_the_device(recipe: str) -> None:
    assert load_recipe(recipe).training.precision == "auto"
