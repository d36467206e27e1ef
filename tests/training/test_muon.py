"""Muon against AdamW, and against singular value decompositions."""

from __future__ import annotations

import copy
from collections.abc import Iterator

import pytest
import torch
from torch import Tensor, nn

from amvnet.config.nested import from_dict
from amvnet.config.schema import ModelConfig
from amvnet.models.amvnet import build_amvnet
from amvnet.training.muon import STEP_LENGTH, Muon, hidden_kernels, orthogonal

from fixtures.tiny import MODEL

LR = 0.01
DECAY = 0.1
NEAR_ONE = (0.65, 1.25)  # the singular values after five iterations, by the source of Muon


def small_net() -> nn.Sequential:
    torch.manual_seed(0)
    layers = [nn.Conv2d(6, 8, 3), nn.BatchNorm2d(8), nn.Conv2d(8, 12, 3), nn.Conv2d(12, 5, 1)]
    return nn.Sequential(*layers)


def hidden_kernel(net: nn.Module) -> nn.Parameter:
    return net.get_parameter("2.weight")


def gradients(net: nn.Module, steps: int, seed: int = 1) -> Iterator[list[Tensor]]:
    """Yield random gradients of all parameters, for each step."""
    generator = torch.Generator().manual_seed(seed)
    for _ in range(steps):
        yield [torch.randn(p.shape, generator=generator) for p in net.parameters()]


def take_steps(
    net: nn.Module, optimizer: torch.optim.Optimizer, values: Iterator[list[Tensor]]
) -> None:
    for step in values:
        for parameter, gradient in zip(net.parameters(), step, strict=True):
            parameter.grad = gradient.clone()
        optimizer.step()


@pytest.mark.parametrize("shape", [(16, 200), (200, 16), (48, 48), (1, 30)])
def test_an_orthogonal_matrix_keeps_the_singular_vectors(shape: tuple[int, int]) -> None:
    matrix = torch.randn(shape, generator=torch.Generator().manual_seed(0))
    u, _, v = torch.linalg.svd(matrix, full_matrices=False)
    found = u.T @ orthogonal(matrix) @ v.T
    values = torch.diagonal(found)
    torch.testing.assert_close(found, torch.diag(values), atol=1e-5, rtol=0)
    # Singular values near 0 stay smaller, as in the matrix of 48 rows and columns.
    large = values[torch.linalg.svdvals(matrix) > 0.05 * torch.linalg.matrix_norm(matrix, 2)]
    assert (large > NEAR_ONE[0]).all()
    assert (large < NEAR_ONE[1]).all()


def test_orthogonal_of_zeros_is_zero() -> None:
    assert (orthogonal(torch.zeros(4, 9)) == 0).all()


def test_the_other_parameters_learn_as_by_adamw() -> None:
    net, reference = small_net(), small_net()
    take_steps(net, Muon(net, LR, DECAY), gradients(net, 4))
    adamw = torch.optim.AdamW(reference.parameters(), LR, weight_decay=DECAY)
    take_steps(reference, adamw, gradients(net, 4))
    for (name, found), expected in zip(net.named_parameters(), reference.parameters(), strict=True):
        assert torch.equal(found, expected) == (name != "2.weight"), name


def test_the_steps_of_a_hidden_kernel() -> None:
    net = small_net()
    kernel = hidden_kernel(net)
    optimizer = Muon(net, LR, DECAY)
    average = torch.zeros_like(kernel)
    momentum = 0.9
    for step in gradients(net, 3):
        before = kernel.detach().clone()
        take_steps(net, optimizer, iter([step]))
        gradient = step[4]
        average = momentum * average + (1 - momentum) * gradient
        mixed = (momentum * average + (1 - momentum) * gradient).flatten(1)
        u, _, v = torch.linalg.svd(mixed, full_matrices=False)
        moved = (before * (1 - LR * DECAY) - kernel.detach()).flatten(1)
        lengths = u.T @ moved @ v.T / (LR * STEP_LENGTH * max(mixed.shape) ** 0.5)
        torch.testing.assert_close(lengths, torch.diag(torch.diagonal(lengths)), atol=1e-3, rtol=0)
        assert (torch.diagonal(lengths) > NEAR_ONE[0]).all()
        assert (torch.diagonal(lengths) < NEAR_ONE[1]).all()
        assert kernel.grad is not None
        assert torch.equal(kernel.grad, gradient)


def test_a_kernel_without_a_gradient_stays() -> None:
    net = small_net()
    before = hidden_kernel(net).detach().clone()
    optimizer = Muon(net, LR, DECAY)
    net(torch.ones(1, 6, 8, 8)).sum().backward()
    hidden_kernel(net).grad = None
    optimizer.step()
    assert torch.equal(hidden_kernel(net), before)


def test_a_training_goes_on_from_its_state() -> None:
    whole, stopped = small_net(), small_net()
    take_steps(whole, Muon(whole, LR, DECAY), gradients(whole, 5))

    values = list(gradients(stopped, 5))
    optimizer = Muon(stopped, LR, DECAY)
    take_steps(stopped, optimizer, iter(values[:2]))
    resumed = Muon(stopped, LR, DECAY)
    resumed.load_state_dict(copy.deepcopy(optimizer.state_dict()))
    take_steps(stopped, resumed, iter(values[2:]))
    for found, expected in zip(stopped.parameters(), whole.parameters(), strict=True):
        assert torch.equal(found, expected)


def test_the_hidden_kernels_of_both_networks() -> None:
    model = build_amvnet(from_dict(ModelConfig, MODEL), 19)
    for net, first in ((model.range_net, "stem.0.weight"), (model.polar_net, "point_mlp.1.weight")):
        hidden = set(map(id, hidden_kernels(net)))
        left_out = [
            name
            for name, parameter in net.named_parameters()
            if parameter.dim() > 1 and id(parameter) not in hidden
        ]
        assert left_out == [first, "scores.weight"]
