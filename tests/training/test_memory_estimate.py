"""The memory of a training step is known before it is taken."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor, nn

from amvnet.config.nested import from_dict, replace_values
from amvnet.config.recipes import load_recipe
from amvnet.config.schema import ModelConfig, Recipe
from amvnet.models.polar_net import PolarNet
from amvnet.models.range_net import RangeNet
from amvnet.models.views.points import PointBatch
from amvnet.models.views.polar_view import PolarView
from amvnet.models.views.range_view import RangeView
from amvnet.scan import Scan
from amvnet.training import memory_estimate
from amvnet.training.memory_estimate import GIB, check_memory, polar_memory, range_memory

from fixtures.worlds import fails, street

CLASSES = 19
SCAN = Scan(street(0)[0])
MODEL = from_dict(
    ModelConfig,
    {
        "range_view": {"height": 16, "width": 512},
        "polar_view": {"radial": 60, "angular": 48, "vertical": 8},
        "range_net": {
            "stem": 8,
            "widths": [8, 16, 16],
            "blocks": [1, 1, 1],
            "height_strides": [1, 1, 2],
            "decoder": 8,
            "head": 8,
        },
        "polar_net": {"point_widths": [8, 16], "pillar": 8, "widths": [8, 16]},
    },
)


def measured(net: nn.Module, inputs: Any) -> int:
    """Return the bytes of real tensors that a forward pass keeps, without the weights."""
    sizes: dict[int, int] = {}
    alive: list[Tensor] = []

    def keep(tensor: Tensor) -> Tensor:
        alive.append(tensor)
        sizes[tensor.untyped_storage().data_ptr()] = tensor.untyped_storage().nbytes()
        return tensor

    with torch.autograd.graph.saved_tensors_hooks(keep, lambda tensor: tensor):
        net.train()(inputs)
    for parameter in net.parameters():
        sizes.pop(parameter.untyped_storage().data_ptr(), None)
    return sum(sizes.values())


def test_the_range_view_keeps_what_is_estimated() -> None:
    view = RangeView(MODEL.range_view).project(PointBatch.of([SCAN]))
    estimate, parameters = range_memory(MODEL, SCAN, CLASSES)
    net = RangeNet(MODEL.range_net, CLASSES)
    assert estimate == pytest.approx(measured(net, view.image), rel=0.1)
    assert parameters == sum(parameter.numel() for parameter in net.parameters())


def test_the_polar_view_keeps_what_is_estimated() -> None:
    grid = PolarView(MODEL.polar_view).project(PointBatch.of([SCAN]))
    estimate, _ = polar_memory(MODEL, SCAN, CLASSES)
    net = PolarNet(MODEL.polar_net, MODEL.polar_view.vertical, CLASSES)
    assert estimate == pytest.approx(measured(net, grid), rel=0.02)


def test_mixed_precision_keeps_less() -> None:
    assert range_memory(MODEL, SCAN, CLASSES, "bf16-mixed")[0] < (
        0.9 * range_memory(MODEL, SCAN, CLASSES)[0]
    )


def test_the_copies_of_the_weights_in_mixed_precision_do_not_grow_with_the_width() -> None:
    # Of the paper's sizes for nuScenes the weights are large and the image is small.
    sizes = load_recipe("nuscenes").model
    mixed, parameters = range_memory(sizes, SCAN, CLASSES, "bf16-mixed")
    assert mixed < 0.6 * range_memory(sizes, SCAN, CLASSES)[0] + 2 * parameters


def test_the_sizes_of_the_paper_need_what_the_page_says_and_take_none() -> None:
    # docs/training.md: 3.6 GiB for a scan.
    before = memory_estimate.free_memory("cpu")
    assert range_memory(ModelConfig(), SCAN, CLASSES)[0] / GIB == pytest.approx(3.6, rel=0.05)
    after = memory_estimate.free_memory("cpu")
    assert before is not None
    assert after is not None
    assert before - after < GIB


def test_steps_that_do_not_fit_are_refused_with_what_would(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    recipe = replace_values(Recipe(model=MODEL), {"training": {"accelerator": "cpu"}}, "")
    per_scan, _ = range_memory(MODEL, SCAN, CLASSES)

    monkeypatch.setattr(memory_estimate, "free_memory", lambda accelerator: 100 * per_scan)
    assert "32 scans at a time need about" in check_memory(recipe, "rv", SCAN, CLASSES, 1)

    monkeypatch.setattr(memory_estimate, "free_memory", lambda accelerator: 20 * per_scan)
    fails(lambda: check_memory(recipe, "rv", SCAN, CLASSES, 1), "--training.rv.accumulate 2", "32")
    monkeypatch.setattr(memory_estimate, "free_memory", lambda accelerator: per_scan // 2)
    fails(lambda: check_memory(recipe, "rv", SCAN, CLASSES, 1), "compact recipe")
    assert not list(tmp_path.iterdir())


def test_memory_that_holds_copies_of_files_is_free(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(memory_estimate, "CGROUP", tmp_path)
    (tmp_path / "memory.max").write_text("1000\n")
    (tmp_path / "memory.current").write_text("900\n")
    (tmp_path / "memory.stat").write_text("anon 200\ninactive_file 400\nactive_file 300\n")
    assert memory_estimate.free_memory("cpu") == 800


def test_unknown_free_memory_refuses_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(memory_estimate, "free_memory", lambda accelerator: None)
    recipe = replace_values(Recipe(model=MODEL), {"training": {"accelerator": "cpu"}}, "")
    assert "GiB" in check_memory(recipe, "bev", SCAN, CLASSES, 1)
