"""The CPU's convolutions and their gradients are those of torch."""

from __future__ import annotations

import pytest
import torch
from torch.nn import functional as F

from amvnet.models import cpu_convolution
from amvnet.models.layers import RingConv2d

from fixtures.commands import not_none

SHAPES = [
    pytest.param(5, 7, (3, 3), (1, 1), (1, 0), id="3 x 3"),
    pytest.param(5, 7, (3, 3), (2, 2), (1, 0), id="strided"),
    pytest.param(4, 6, (3, 3), (1, 2), (1, 1), id="strided along the width"),
    pytest.param(8, 3, (1, 1), (1, 1), (0, 0), id="1 x 1"),
    pytest.param(3, 4, (2, 3), (1, 1), (0, 1), id="2 x 3"),
]


@pytest.mark.parametrize(("channels", "out", "kernel", "stride", "padding"), SHAPES)
@pytest.mark.parametrize("memory_format", [torch.contiguous_format, torch.channels_last])
def test_the_gradient_of_the_weights_is_that_of_autograd(
    channels: int,
    out: int,
    kernel: tuple[int, int],
    stride: tuple[int, int],
    padding: tuple[int, int],
    memory_format: torch.memory_format,
) -> None:
    torch.manual_seed(0)
    x = torch.randn(2, channels, 9, 12, dtype=torch.float64)
    x = x.contiguous(memory_format=memory_format)
    weight = torch.randn(out, channels, *kernel, dtype=torch.float64, requires_grad=True)
    output = F.conv2d(x, weight, None, stride, padding)
    grad = torch.randn_like(output)
    output.backward(grad)

    gradient = cpu_convolution.weight_gradient(x, grad, kernel, stride, padding)

    torch.testing.assert_close(gradient, not_none(weight.grad))


def test_a_layer_learns_the_same_on_both_kinds_of_cpus(monkeypatch: pytest.MonkeyPatch) -> None:
    torch.manual_seed(0)
    layer = RingConv2d(6, 10, stride=(2, 2))
    gradients = []
    for capability in ("AVX2", "AVX512"):
        monkeypatch.setattr(
            torch.backends.cpu, "get_cpu_capability", lambda value=capability: value
        )
        x = torch.arange(6 * 8 * 16.0).sin().view(1, 6, 8, 16).requires_grad_()
        layer.zero_grad()
        layer(x).square().sum().backward()
        gradients.append((not_none(x.grad), not_none(layer.weight.grad)))

    for by_products, by_torch in zip(*gradients, strict=True):
        torch.testing.assert_close(by_products, by_torch)


@pytest.mark.parametrize("threads", [1, 2])
@pytest.mark.parametrize("memory_format", [torch.contiguous_format, torch.channels_last])
@pytest.mark.parametrize("step", [1, 2])
def test_kernels_of_one_cell_give_the_same_without_gradients(
    threads: int, memory_format: torch.memory_format, step: int
) -> None:
    torch.manual_seed(0)
    x = torch.randn(2, 5, 9, 12).contiguous(memory_format=memory_format)[..., ::step, ::step]
    weight = torch.randn(7, 5, 1, 1)
    bias = torch.randn(7)
    expected = torch.einsum("bihw,oi->bohw", x.double(), weight[..., 0, 0].double())

    before = torch.get_num_threads()
    torch.set_num_threads(threads)
    try:
        with torch.inference_mode():
            outputs = cpu_convolution.convolve(x, weight, bias, (1, 1), (0, 0))
    finally:
        torch.set_num_threads(before)
    expected = expected + bias.double()[:, None, None]
    torch.testing.assert_close(outputs.double(), expected, rtol=1e-5, atol=1e-5)
