"""End to end, the head's loss reaches both networks, through the points that the head sees."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor
from torch.nn import functional as F

from amvnet.config.nested import from_dict
from amvnet.config.schema import JointTraining, ModelConfig, TrainingConfig
from amvnet.data.taxonomy import SEMANTICKITTI
from amvnet.models.amvnet import build_amvnet
from amvnet.models.views.points import PointBatch
from amvnet.scan import Scan
from amvnet.training.joint_stage import JointStage

from fixtures.worlds import MODEL, street

K = SEMANTICKITTI.size
DULL = 0.5  # points of a higher intensity are uncertain
NEIGHBOURS = MODEL["point_head"]["neighbours"]


def bright(f: Tensor, g: Tensor, points: Tensor, labels: Tensor | None = None) -> Tensor:
    """Stand in for an assertion, with points that do not depend on the networks."""
    return points[:, 3] > DULL


def joint_stage(points: int = 10_000) -> JointStage:
    torch.manual_seed(0)
    model = build_amvnet(from_dict(ModelConfig, MODEL), K).eval()
    training = replace(TrainingConfig(), joint=JointTraining(points=points))
    return JointStage(model, bright, training, SEMANTICKITTI, None).double()


def streets(*seeds: int) -> tuple[PointBatch, Tensor]:
    """Return a batch of streets, and its labels."""
    drawn = [street(seed, 300) for seed in seeds]
    batch = PointBatch.of([Scan(points) for points, _ in drawn])
    labels = [SEMANTICKITTI.to_train(raw) for _, raw in drawn]
    return batch.to(torch.float64), torch.from_numpy(np.concatenate(labels)).long()


def random_scores(count: int) -> Tensor:
    """Return (P, K) class probabilities that can have a gradient."""
    return torch.randn(count, K, dtype=torch.float64).softmax(dim=1).requires_grad_()


def brute_neighbours(xyz: Tensor, index: int, n: int) -> list[int]:
    distances = (xyz - xyz[index]).norm(dim=1)
    return [other for other in distances.argsort().tolist() if other != index][:n]


def test_the_gradient_of_the_heads_loss_alone_reaches_every_layer_of_both_networks() -> None:
    stage = joint_stage()
    batch, labels = streets(1, 2)
    _, _, f_logits = stage.rv.logits(batch, labels)
    _, _, g_logits = stage.bev.logits(batch, labels)
    stage.head_loss(batch, labels, f_logits.softmax(1), g_logits.softmax(1)).backward()

    for part in (stage.trained.range_net, stage.trained.polar_net, stage.trained.point_head):
        assert part is not None
        for name, parameter in part.named_parameters():
            assert parameter.grad is not None, name
            assert parameter.grad.abs().sum() > 0, name


def test_points_that_are_neither_drawn_nor_neighbours_have_no_gradient(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    stage = joint_stage(points=5)
    batch, labels = streets(1, 2)
    f = random_scores(len(labels))
    g = random_scores(len(labels))

    drawn: list[list[int]] = []
    find = stage.trained.find_neighbours

    def spy(points: Tensor, index: Tensor) -> Tensor:
        drawn.append(index.tolist())
        return find(points, index)

    monkeypatch.setattr(stage.trained, "find_neighbours", spy)
    stage.head_loss(batch, labels, f, g).backward()

    seen = torch.zeros(len(labels), dtype=torch.bool)
    for scan, indices in zip(batch.slices(), drawn, strict=True):
        assert len(set(indices)) == 5
        assert (batch.points[scan][indices, 3] > DULL).all()
        assert (labels[scan][indices] > 0).all()
        for index in indices:
            near = brute_neighbours(
                batch.points[scan][:, :3], index, MODEL["point_head"]["neighbours"]
            )
            seen[scan.start + torch.tensor([index, *near])] = True

    for scores in (f, g):
        assert scores.grad is not None
        touched = scores.grad.abs().sum(dim=1) > 0
        assert not touched[~seen].any()
        for scan, indices in zip(batch.slices(), drawn, strict=True):
            assert touched[scan][indices].all()


def test_the_heads_loss_is_the_mean_over_scans_of_its_cross_entropy_at_uncertain_points() -> None:
    stage = joint_stage()
    head = stage.trained.point_head
    assert head is not None
    batch, labels = streets(3, 4)
    f = random_scores(len(labels)).detach()
    g = random_scores(len(labels)).detach()

    means = []
    for scan in batch.slices():
        x = batch.points[scan]
        losses = []
        for index in range(len(x)):
            label = int(labels[scan][index])
            if x[index, 3] <= DULL or not label:
                continue
            near = brute_neighbours(x[:, :3], index, head.config.neighbours)
            own = x[index].clone()
            own[:3] *= head.config.position_scale
            point = torch.cat([f[scan][index], g[scan][index], own])
            rows = torch.cat([f[scan][near], g[scan][near], x[near] - x[index]], dim=1)
            losses.append(-F.log_softmax(head(point[None], rows[None])[0], dim=0)[label - 1])
        means.append(torch.stack(losses).mean())

    torch.testing.assert_close(stage.head_loss(batch, labels, f, g), torch.stack(means).mean())


def test_without_uncertain_points_the_heads_loss_is_zero_and_has_gradients() -> None:
    stage = joint_stage()
    batch, labels = streets(5)
    f = random_scores(len(labels))
    loss = stage.head_loss(batch, labels * 0, f, f)
    loss.backward()
    assert loss == 0
    assert stage.trained.point_head is not None
    assert all(parameter.grad is not None for parameter in stage.trained.point_head.parameters())


def test_the_scores_of_the_validation_are_those_of_the_model() -> None:
    stage = joint_stage().float()
    batch, _ = streets(6, 7)
    batch = batch.to(torch.float32)
    with torch.no_grad():
        torch.testing.assert_close(stage.score(batch).merged, stage.trained(batch).merged)
