"""The pooling of the neighbours equals loops over its formulas, and costs little."""

from __future__ import annotations

import dataclasses
import math
from typing import Any

import pytest
import torch
from torch import Tensor
from torch.utils.flop_counter import FlopCounterMode

from amvnet.config.recipes import load_recipe
from amvnet.config.schema import PointHeadConfig
from amvnet.models.head_ensemble import Head
from amvnet.models.neighbour_pooling import QUERIES, AttentionPooling, MaxPooling

from fixtures.networks import trained_head


def attention_by_loop(pooling: AttentionPooling, point: Tensor, rows: list[list[float]]) -> Tensor:
    """Return the means (QUERIES, C) of one point's neighbours, number by number."""
    channels = len(rows[0])
    queries = pooling.query(point[None]).view(QUERIES, channels).tolist()
    positive = [[max(value, 0.0) for value in row] for row in rows]

    means = []
    for query in queries:
        weights = []
        for row in positive:
            product = sum(a * b for a, b in zip(query, row, strict=True))
            weights.append(math.exp(product / math.sqrt(channels)))
        mean = [0.0] * channels
        for weight, row in zip(weights, positive, strict=True):
            for channel, value in enumerate(row):
                mean[channel] += weight / sum(weights) * value
        means.append(mean)
    return torch.tensor(means)


def test_attention_equals_a_loop_of_its_formula() -> None:
    torch.manual_seed(0)
    pooling = AttentionPooling(width=6, channels=5).eval()
    point = 3 * torch.randn(4, 6)
    rows = 3 * torch.randn(4, 7, 5)

    with torch.no_grad():
        pooled = pooling(point, rows)
        for i in range(4):
            means = attention_by_loop(pooling, point[i], rows[i].tolist())
            expected = pooling.answer(means.flatten()[None])[0]
            torch.testing.assert_close(pooled[i], expected, rtol=1e-4, atol=1e-5)
    assert (pooled > 0).any()


def test_what_attention_sees_depends_on_the_point() -> None:
    torch.manual_seed(0)
    pooling = AttentionPooling(width=6, channels=5).eval()
    rows = 3 * torch.randn(1, 7, 5)
    points = 3 * torch.randn(2, 6)
    pooled = pooling(points, rows.expand(2, 7, 5))
    assert not torch.allclose(pooled[0], pooled[1])
    assert torch.equal(*MaxPooling()(points, rows.expand(2, 7, 5)))


def test_max_pooling_equals_the_maximum_after_the_activation_and_so_does_its_gradient() -> None:
    torch.manual_seed(0)
    rows = torch.randn(50, 6, 5).round(decimals=1)  # some maxima are equal, some negative
    rows.requires_grad_()
    gradient = torch.randn(50, 5)

    pooled = MaxPooling()(torch.zeros(50, 6), rows)
    (found,) = torch.autograd.grad(pooled, rows, gradient)
    by_definition = rows.relu().amax(dim=1)
    (expected,) = torch.autograd.grad(by_definition, rows, gradient)
    assert torch.equal(pooled, by_definition)
    assert torch.equal(found, expected)


def with_pooling(config: PointHeadConfig, pooling: Any) -> PointHeadConfig:
    """Return a configuration with another pooling."""
    return dataclasses.replace(config, pooling=pooling)


def multiply_adds(head: Head, classes: int, fast: bool) -> float:
    """Count the multiply-adds of a head for 100 points, by `forward` or by `score`."""
    width = 2 * classes + 4
    neighbours = head.config.neighbours
    near = torch.arange(100)[:, None].expand(100, neighbours)
    with torch.inference_mode(), FlopCounterMode(display=False) as counter:
        if fast:
            head.score(torch.zeros(100, width), torch.arange(100), near)
        else:
            head(torch.zeros(100, width), torch.zeros(100, neighbours, width))
    return counter.get_total_flops() / 2


@pytest.mark.parametrize("recipe", ["semantickitti", "simulated-compact", "nuscenes"])
@pytest.mark.parametrize("fast", [False, True])
def test_attention_costs_less_than_twice_the_papers_head(recipe: str, fast: bool) -> None:
    config = load_recipe(recipe).model.point_head
    classes = 16 if recipe == "nuscenes" else 19
    costs = {}
    for pooling in ("max", "attention"):
        head = trained_head(with_pooling(config, pooling), classes)
        costs[pooling] = multiply_adds(head, classes, fast)
    assert costs["max"] < costs["attention"] < 2 * costs["max"]


def test_the_attention_head_of_the_paper_size_has_28100_parameters_and_1_1_gmac() -> None:
    head = trained_head(PointHeadConfig(pooling="attention"), 19)
    assert sum(p.numel() for p in head.parameters()) == pytest.approx(28_100, abs=100)
    assert 100 * multiply_adds(head, 19, fast=False) == pytest.approx(1.116e9, rel=0.01)
