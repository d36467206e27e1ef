"""The precision that `auto` stands for, and trainings in mixed precision on the CPU."""

from pathlib import Path
from typing import Any

import pytest
import torch

from amvnet.config.recipes import load_recipe, recipe_names
from amvnet.config.schema import PARTS, TrainingConfig
from amvnet.runtime.distributed import device_of
from amvnet.training.callbacks import KeepWeights
from amvnet.training.stage import precision_of
from amvnet.weights.file import load, save

from fixtures.commands import run_cli
from fixtures.tiny import GOLDEN, fresh_weights, make_streets, with_model, write_recipe

MIXED = ("bf16-mixed", "16-mixed")
AUTO = TrainingConfig(precision="auto")
# Pixels in a row of the range image. The deepest maps then have 4 columns. With 1 or 2, in 16 bits,
# oneDNN reads beyond the map on processors with AMX, and what it finds there may make the loss NaN.
WIDTH = 256


@pytest.mark.parametrize(
    ("capabilities", "expected"),
    [({"avx512_bf16": True}, "bf16-mixed"), ({"avx512_f": True}, "32-true"), ({}, "32-true")],
)
def test_auto_is_bfloat16_where_the_processor_multiplies_it(
    monkeypatch: pytest.MonkeyPatch, capabilities: dict[str, bool], expected: str
) -> None:
    monkeypatch.setattr(torch.cpu, "get_capabilities", lambda: capabilities, raising=False)
    assert precision_of(AUTO, "cpu") == expected


def test_a_torch_that_does_not_tell_trains_in_32_bits(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delattr(torch.cpu, "get_capabilities", raising=False)
    assert precision_of(AUTO, "cpu") == "32-true"


@pytest.mark.parametrize("includes_bfloat16", [True, False])
def test_a_gpu_emulates_nothing(monkeypatch: pytest.MonkeyPatch, includes_bfloat16: bool) -> None:
    def is_bf16_supported(including_emulation: bool = True) -> bool:
        return including_emulation or includes_bfloat16

    monkeypatch.setattr(torch.cuda, "is_bf16_supported", is_bf16_supported)
    expected = "bf16-mixed" if includes_bfloat16 else "32-true"
    assert precision_of(AUTO, "cuda") == expected


def test_a_mac_trains_on_its_gpu_in_32_bits(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    monkeypatch.setattr(torch.backends.mps, "is_available", lambda: True)
    assert [device_of(name) for name in ("auto", "gpu", "cpu")] == ["mps", "mps", "cpu"]
    assert precision_of(AUTO, "mps") == "32-true"


def recipes_in_mixed_precision() -> list[Any]:
    cases = []
    for recipe in recipe_names():
        for precision in MIXED:
            is_quick = (recipe, precision) == ("finetune", "bf16-mixed")
            marks = () if is_quick else pytest.mark.full
            cases.append(pytest.param(recipe, precision, marks=marks))
    return cases


@pytest.mark.parametrize(("recipe", "precision"), recipes_in_mixed_precision())
def test_each_stage_of_each_recipe_trains_and_resumes_in_mixed_precision(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, recipe: str, precision: str
) -> None:
    """Each stage is interrupted once, in its second epoch, and so is resumed from a checkpoint."""
    over: dict[str, Any] = {
        "training": {"rv": {"epochs": 2}, "bev": {"epochs": 2}, "precision": precision}
    }
    if not load_recipe(recipe).from_init:
        over["model"] = {"range_view": {"width": WIDTH}}
    words: list[object] = ["train", write_recipe(tmp_path / "recipe.yaml", recipe, **over)]
    words += ["--out", tmp_path / "run", "--data"]
    if load_recipe(recipe).taxonomy == "semantickitti":
        words += [make_streets(tmp_path / "data")]
    else:
        words += [GOLDEN / "nuscenes", "--train-sequences", "scene-0103"]
        words += ["--val-sequences", "scene-0916"]
    if load_recipe(recipe).from_init:
        # The built-in weights show hidden points as well.
        start = with_model(fresh_weights(), "range_view", width=WIDTH, hidden=0.5)
        save(start, tmp_path / "start.safetensors")
        words += ["--init", tmp_path / "start.safetensors"]

    stages = load_recipe(recipe).stages
    interrupted: list[str] = []
    keep = KeepWeights.on_train_epoch_end

    def stop_once(self: KeepWeights, trainer: Any, stage: Any) -> None:
        if trainer.current_epoch == 1 and stage.name not in interrupted:
            interrupted.append(stage.name)
            raise RuntimeError("the power is gone")
        keep(self, trainer, stage)

    monkeypatch.setattr(KeepWeights, "on_train_epoch_end", stop_once)
    for _ in stages:
        with pytest.raises(RuntimeError, match="power"):
            assert run_cli(*words, "--resume") == (0, "")
    assert run_cli(*words, "--resume") == (0, "")
    assert interrupted == list(stages)

    weights = load(tmp_path / "run")
    assert weights.parts == PARTS
    assert all(value.isfinite().all() for value in weights.tensors.values())
    assert weights.training["range_net"]["precision"] == precision
