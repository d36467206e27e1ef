"""The stages compute their loss on what the recipe says."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, Literal

import numpy as np
import pytest
import torch
from torch import nn
from torch.nn import functional as F

from amvnet.config.nested import from_dict
from amvnet.config.schema import ModelConfig, NetworkName, NetworkTraining, Recipe, TrainingConfig
from amvnet.data.datasets.training_data import Source, TrainingData
from amvnet.data.recordings import Recording, ScanFile
from amvnet.data.taxonomy import SEMANTICKITTI
from amvnet.models.amvnet import build_amvnet
from amvnet.models.layers import RingConv2d
from amvnet.models.views.points import PointBatch
from amvnet.scan import Scan
from amvnet.sensors.expectation import Expectation
from amvnet.training.loaders import ScanSet
from amvnet.training.losses import Targets, dice, distillation_loss, lovasz_softmax
from amvnet.training.networks import PolarStage, make_loaders, make_stage
from amvnet.training.plan import Plan
from amvnet.training.stage import Precision, StageContext

from fixtures.tiny import MODEL, fresh_weights, street

CONFIG = NetworkTraining(epochs=1, batch=2, lr=1e-3)
MODEL_CONFIG = from_dict(ModelConfig, MODEL)
# Of two datasets, the first does not teach the class 4.
RIVALS = np.ones((2, 19), bool)
RIVALS[0, 4] = False


def plan_with(config: NetworkTraining) -> Plan:
    """Return a plan without scans, in which both networks are trained further alike."""
    training = replace(TrainingConfig(), rv=config, bev=config)
    dataset: Any = SimpleNamespace(taxonomy=SEMANTICKITTI)
    data = TrainingData([Source(dataset, [])])
    return Plan(Recipe(training=training), data, Path("run"), init=fresh_weights())


def polar_stage() -> PolarStage:
    torch.manual_seed(0)
    model = build_amvnet(MODEL_CONFIG, SEMANTICKITTI.size)
    return PolarStage(StageContext(CONFIG, SEMANTICKITTI), model.polar_view, model.polar_net.eval())


def batch_of_two() -> tuple[PointBatch, torch.Tensor]:
    scans = [Scan(street(seed, 400)[0]) for seed in range(2)]
    raw = [street(seed, 400)[1] for seed in range(2)]
    labels = torch.cat([torch.from_numpy(SEMANTICKITTI.to_train(values)) for values in raw])
    return PointBatch.of(scans), labels.long()


def test_the_voxels_of_a_batch_equal_a_loop_over_its_points() -> None:
    batch, labels = batch_of_two()
    stage = polar_stage()
    with torch.no_grad():
        voxels = stage.compare((batch, labels, torch.zeros_like(labels)))
        point_logits = stage.score(batch)

    # The voxels of each scan by their logits and labels, in any order.
    grid = stage.view.project(batch)
    for scan in range(2):
        members: dict[tuple[int, int], list[int]] = {}
        for point in (batch.scan == scan).nonzero()[:, 0].tolist():
            key = (int(grid.slot[point]), int(grid.voxel[point]))
            members.setdefault(key, []).append(point)

        expected = []
        for points in members.values():
            inside = [label for label in labels[points].tolist() if label]
            majority = min(inside, key=lambda label: (-inside.count(label), label)) if inside else 0
            expected.append((point_logits[points[0]].tolist(), majority))

        of_scan = voxels.scan == scan
        rows = voxels.logits[of_scan].tolist()
        assert sorted(zip(rows, voxels.labels[of_scan].tolist(), strict=True)) == sorted(expected)


@pytest.mark.parametrize("stage", ["rv", "bev"])
def test_pixels_and_voxels_have_the_source_of_their_points(stage: NetworkName) -> None:
    """The source is the scan here, so that no pixel and no voxel has points of two sources."""
    batch, labels = batch_of_two()
    made = make_stage(plan_with(CONFIG), stage, build_amvnet(MODEL_CONFIG, 19)).eval()
    with torch.no_grad():
        scored = made.compare((batch, labels, batch.scan))
    assert scored.source is not None
    assert set(scored.source.tolist()) == {0, 1}
    assert scored.source.tolist() == scored.scan.tolist()


def test_a_voxel_with_points_of_two_datasets_has_the_first_as_its_source() -> None:
    scan = Scan(np.array([[9, 0, 0, 1], [9.01, 0, 0, 1], [30, 0, 0, 1]], np.float32))
    with torch.no_grad():
        scored = polar_stage().compare(
            (PointBatch.of([scan]), torch.tensor([1, 1, 2]), torch.tensor([2, 1, 2]))
        )
    assert scored.source is not None
    assert dict(zip(scored.labels.tolist(), scored.source.tolist(), strict=True)) == {1: 1, 2: 2}


@pytest.mark.parametrize("stage", ["rv", "bev"])
def test_on_a_cpu_all_convolutions_of_a_step_have_channels_last(stage: NetworkName) -> None:
    config = replace(MODEL_CONFIG, range_net=replace(MODEL_CONFIG.range_net, steps=True))
    plan = plan_with(CONFIG)
    plan = replace(plan, recipe=Recipe(training=replace(plan.recipe.training, accelerator="cpu")))
    made = make_stage(plan, stage, build_amvnet(config, 19))
    are_last: list[bool] = []

    def note(net: nn.Module, inputs: Any, output: torch.Tensor) -> None:
        are_last.append(output.is_contiguous(memory_format=torch.channels_last))

    for layer in made.trained.modules():
        if isinstance(layer, RingConv2d):
            layer.register_forward_hook(note)
    points, labels = batch_of_two()
    made.compare((points, labels, points.scan))
    assert are_last
    assert all(are_last)


@pytest.mark.parametrize("stage", ["rv", "bev"])
@pytest.mark.parametrize(
    ("precision", "lower"), [("bf16-mixed", torch.bfloat16), ("16-mixed", torch.float16)]
)
def test_a_network_alone_computes_in_the_lower_precision(
    stage: NetworkName, precision: Precision, lower: torch.dtype
) -> None:
    """What the network returns has the lower precision; what the loss compares is float32."""
    view = replace(MODEL_CONFIG.range_view, hidden=0.5)
    model = build_amvnet(replace(MODEL_CONFIG, range_view=view), 19)
    plan = plan_with(CONFIG)
    training = replace(plan.recipe.training, precision=precision)
    made = make_stage(replace(plan, recipe=Recipe(training=training)), stage, model)
    types: list[torch.dtype] = []

    def note(net: nn.Module, inputs: Any, output: torch.Tensor) -> None:
        types.append(output.dtype)

    made.trained.register_forward_hook(note)
    points, labels = batch_of_two()
    scored = made.compare((points, labels, points.scan))
    assert types == [lower]
    assert scored.logits.dtype == made.loss(scored).dtype == torch.float32
    assert made.score(points).dtype == torch.float32


@pytest.mark.parametrize("stage", ["rv", "bev"])
def test_only_datasets_with_points_of_a_class_lower_its_scores(stage: NetworkName) -> None:
    model = build_amvnet(MODEL_CONFIG, 19)
    made: Any = make_stage(plan_with(CONFIG), stage, model, None, RIVALS).eval()
    made.log = lambda *_, **__: None
    made.step_factor = lambda *_: 1.0
    batch, labels = batch_of_two()
    labels[labels == 5] = 1

    gradients = []
    for number in range(2):
        made.zero_grad()
        made.training_step((batch, labels, torch.full_like(labels, number)), 0).backward()
        gradients.append(made.trained.scores.bias.grad.unflatten(0, (-1, 19)).clone())
    assert (gradients[0][:, 4] == 0).all()
    assert (gradients[1][:, 4] > 0).any()
    assert (gradients[0][:, 5] > 0).any()


@pytest.mark.parametrize("stage", ["rv", "bev"])
def test_a_stage_distils_its_initial_network_where_data_lack_a_class(stage: NetworkName) -> None:
    plan, model = plan_with(replace(CONFIG, distill=2.0)), build_amvnet(MODEL_CONFIG, 19)
    assert not make_stage(plan, stage, model).teachers
    made: Any = make_stage(plan, stage, model, None, RIVALS)
    made.log = lambda *_, **__: None
    made.step_factor = lambda *_: 1.0
    (teacher,) = made.teachers
    assert not any(value.requires_grad for value in teacher.parameters())
    assert {name.split(".")[0] for name in made.state_dict()} == {"trained"}

    batch, labels = batch_of_two()
    labels[labels == 5] = 1
    made.trained.scores.bias.data += torch.randn(len(made.trained.scores.bias))
    made.eval()
    source = torch.zeros_like(labels)
    with torch.no_grad():
        scored = made.compare((batch, labels, source))
        expected = made.compare((batch, labels, source), teacher).logits
        distillation = distillation_loss(scored, expected, made.rivals)
        loss = made.training_step((batch, labels, source), 0)
    assert (scored.logits != expected).any()
    assert loss == made.loss(scored) + 2 * distillation


@pytest.mark.parametrize("name", ["default", "dice", "lovasz"])
@pytest.mark.parametrize("stage", ["rv", "bev"])
def test_the_loss_of_a_stage_equals_its_formula_with_all_weights(
    stage: NetworkName, name: Literal["default", "dice", "lovasz"]
) -> None:
    """Class weights, the weight of the region loss, and the recipe's region loss or the paper's."""
    config = replace(CONFIG, region=0.3, region_loss=name)
    of_paper = {"rv": dice, "bev": lovasz_softmax}[stage]
    region_loss = {"default": of_paper, "dice": dice, "lovasz": lovasz_softmax}[name]
    weights = np.linspace(0.2, 3, 19, dtype=np.float32)
    made = make_stage(plan_with(config), stage, build_amvnet(MODEL_CONFIG, 19), weights)

    batch, labels = batch_of_two()
    with torch.no_grad():
        scored = made.eval().compare((batch, labels, torch.zeros_like(labels)))
        losses = []
        for scan in range(2):
            logits = scored.logits[(scored.scan == scan) & (scored.labels > 0)]
            target = scored.labels[(scored.scan == scan) & (scored.labels > 0)] - 1
            cross_entropy = F.cross_entropy(logits, target, torch.from_numpy(weights))
            targets = Targets.of(target, torch.zeros_like(target), (1, 19))
            losses.append(cross_entropy + 0.3 * region_loss(logits.softmax(1), targets))
        torch.testing.assert_close(made.loss(scored), torch.stack(losses).mean())


def test_validation_scans_are_read_like_training_scans_and_not_augmented() -> None:
    view = replace(MODEL_CONFIG.range_view, rows="laser")
    recipe = Recipe(model=replace(MODEL_CONFIG, range_view=view))
    dataset: Any = SimpleNamespace(taxonomy=SEMANTICKITTI)
    records = [
        ScanFile(name, Recording("00"), Path(f"{name}.bin"), prediction=f"{name}.label")
        for name in ("a", "b")
    ]
    expects = Expectation(view)
    data = TrainingData([Source(dataset, records[:1], records[1:])])
    train, val = make_loaders(Plan(recipe, data, Path("run")), CONFIG, expects)
    assert val is not None
    for loader, is_augmented in ((train, True), (val, False)):
        loaded = loader.dataset
        assert isinstance(loaded, ScanSet)
        assert loaded.expects is expects
        assert (loaded.augment is not None) == is_augmented
