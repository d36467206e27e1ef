"""The stages compute their loss on what the recipe says."""

from __future__ import annotations

from dataclasses import replace
from typing import Literal

import pytest
import torch

from amvnet.config.nested import from_dict
from amvnet.config.schema import ModelConfig, NetworkTraining
from amvnet.data.taxonomy import SEMANTICKITTI
from amvnet.models.amvnet import build_amvnet
from amvnet.models.views.points import PointBatch
from amvnet.scan import Scan
from amvnet.training.losses import dice, lovasz_softmax, polar_view_loss, range_view_loss
from amvnet.training.networks import REGION_LOSSES, PolarStage, RangeStage

from fixtures.worlds import MODEL, street

CONFIG = NetworkTraining(epochs=1, batch=2, lr=1e-3)
OVER_VOXELS = replace(CONFIG, loss_over="voxels")
MODEL_CONFIG = from_dict(ModelConfig, MODEL)


def range_stage(config: NetworkTraining = CONFIG) -> RangeStage:
    model = build_amvnet(MODEL_CONFIG, SEMANTICKITTI.size)
    return RangeStage(model.range_view, model.range_net, config, SEMANTICKITTI, None)


def polar_stage(config: NetworkTraining = CONFIG) -> PolarStage:
    torch.manual_seed(0)
    model = build_amvnet(MODEL_CONFIG, SEMANTICKITTI.size)
    return PolarStage(model.polar_view, model.polar_net.eval(), config, SEMANTICKITTI, None)


def batch_of_two() -> tuple[PointBatch, torch.Tensor]:
    scans = [Scan(street(seed, 400)[0]) for seed in range(2)]
    raw = [street(seed, 400)[1] for seed in range(2)]
    labels = torch.cat([torch.from_numpy(SEMANTICKITTI.to_train(values)) for values in raw])
    return PointBatch.of(scans), labels.long()


def test_the_voxels_of_a_batch_equal_a_loop_over_its_points() -> None:
    batch, labels = batch_of_two()
    stage = polar_stage(OVER_VOXELS)
    with torch.no_grad():
        logits, voxel_labels, point_logits = stage.logits(batch, labels)
        _, _, expected_points = polar_stage().logits(batch, labels)
    torch.testing.assert_close(point_logits, expected_points)

    # The voxels of each scan by their logits and labels, in any order.
    grid = stage.view.project(batch)
    for scan in range(2):
        members: dict[tuple[int, int], list[int]] = {}
        for point in (batch.scan == scan).nonzero()[:, 0].tolist():
            key = (int(grid.pillar[point]), int(grid.voxel[point]))
            members.setdefault(key, []).append(point)

        expected = []
        for points in members.values():
            inside = [label for label in labels[points].tolist() if label]
            majority = min(inside, key=lambda label: (-inside.count(label), label)) if inside else 0
            expected.append((point_logits[points[0]].tolist(), majority))

        rows = logits[scan].tolist()
        assert sorted(zip(rows, voxel_labels[scan].tolist(), strict=True)) == sorted(expected)


def test_the_loss_over_voxels_learns() -> None:
    batch, labels = batch_of_two()
    stage = polar_stage(OVER_VOXELS)
    optimizer = torch.optim.Adam(stage.trained.parameters(), 0.02)
    losses = []
    for _ in range(8):
        logits, voxel_labels, _ = stage.logits(batch, labels)
        loss = stage.loss(logits[0], voxel_labels[0])
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        losses.append(loss.item())
    assert losses[-1] < 0.8 * losses[0]


@pytest.mark.parametrize("name", ["default", "dice", "lovasz"])
def test_a_stage_has_the_region_loss_of_its_recipe(
    name: Literal["default", "dice", "lovasz"],
) -> None:
    logits = torch.randn(50, 19)
    labels = torch.randint(0, 20, (50,))
    region_loss = REGION_LOSSES[name]
    config = replace(CONFIG, region_loss=name)

    expected = range_view_loss(logits, labels, None, 1.0, region_loss or dice)
    assert range_stage(config).loss(logits, labels) == expected
    expected = polar_view_loss(logits, labels, None, 1.0, region_loss or lovasz_softmax)
    assert polar_stage(config).loss(logits, labels) == expected
