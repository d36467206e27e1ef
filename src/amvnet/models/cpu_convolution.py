"""Compute convolutions fast on a CPU."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor
from torch.nn import functional as F
from torch.nn.grad import conv2d_input

Pair = tuple[int, int]


def convolve(x: Tensor, weight: Tensor, bias: Tensor | None, stride: Pair, padding: Pair) -> Tensor:
    """Convolve like `torch.nn.functional.conv2d`: (B, C, H, W) -> (B, C', H', W').

    Two cases are faster than `conv2d`:

    - With gradients, on a CPU without AVX-512, oneDNN takes five times as long for the gradient of
      the weights as for the convolution itself. This was two thirds of a training step. Here,
      matrix products compute the gradient instead.
    - Without gradients, for 1 x 1 kernels, `conv2d` calls MKL if it has one thread. MKL takes twice
      as long as oneDNN on an AMD processor. Here, oneDNN is called directly.
    """
    if not is_plain(x, weight):
        return F.conv2d(x, weight, bias, stride, padding)

    if torch.is_grad_enabled():
        is_avx2 = torch.backends.cpu.get_cpu_capability() == "AVX2"
        if is_avx2 and bias is None and weight.requires_grad:
            output: Tensor = _Convolution.apply(  # type: ignore[no-untyped-call]
                x, weight, stride, padding
            )
            return output
    elif weight.shape[2:] == (1, 1) and torch.backends.mkldnn.is_available():
        return torch.mkldnn_convolution(
            x, weight, bias, padding=padding, stride=stride, dilation=(1, 1), groups=1
        )
    return F.conv2d(x, weight, bias, stride, padding)


def is_plain(x: Tensor, weight: Tensor) -> bool:
    """Return whether a layer computes in float32 on a CPU, so that other operations may do so."""
    # Under autocast, torch's own operation has to choose the type. An exporter has to see it.
    return (
        x.is_cpu
        and x.dtype == weight.dtype == torch.float32
        and not torch.is_autocast_enabled("cpu")
        and not torch.compiler.is_compiling()
    )


class _Convolution(torch.autograd.Function):
    """A convolution without bias whose backward pass calls `weight_gradient`."""

    @staticmethod
    def forward(ctx: Any, x: Tensor, weight: Tensor, stride: Pair, padding: Pair) -> Tensor:
        ctx.save_for_backward(x, weight)
        ctx.stride = stride
        ctx.padding = padding
        return F.conv2d(x, weight, None, stride, padding)

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor | None, Tensor, None, None]:
        x, weight = ctx.saved_tensors

        x_gradient = None
        if ctx.needs_input_grad[0]:
            x_gradient = conv2d_input(list(x.shape), weight, grads[0], ctx.stride, ctx.padding)
        kernel = (weight.shape[2], weight.shape[3])
        return x_gradient, weight_gradient(x, grads[0], kernel, ctx.stride, ctx.padding), None, None


def weight_gradient(x: Tensor, grad: Tensor, kernel: Pair, stride: Pair, padding: Pair) -> Tensor:
    """Return the gradient (C', C, kernel height, kernel width) of a convolution's weights.

    A tap is one cell of the kernel. Its gradient is the matrix product of the output's gradient and
    the part of the input that the tap sees. The product is computed row by row: if the channels are
    last in memory, a row of pixels already is a matrix and needs no copy.

    Args:
        x: (B, C, H, W), the input.
        grad: (B, C', H', W'), the gradient of the output.
        kernel, stride, padding: height and width of each.
    """
    height = (grad.shape[2] - 1) * stride[0] + 1
    width = (grad.shape[3] - 1) * stride[1] + 1
    if padding != (0, 0):
        x = F.pad(x, (padding[1], padding[1], padding[0], padding[0]))
    images = x.permute(0, 2, 3, 1).contiguous()  # (B, H, W, C)
    grads = grad.permute(0, 2, 3, 1).contiguous().transpose(2, 3)  # (B, H', C', W')

    gradient = x.new_zeros(*kernel, grad.shape[1], x.shape[1])
    for image, image_grad in zip(images, grads, strict=True):
        for row in range(kernel[0]):
            for column in range(kernel[1]):
                rows = slice(row, row + height, stride[0])
                columns = slice(column, column + width, stride[1])
                products = torch.bmm(image_grad, image[rows, columns])  # (H', C', C)
                gradient[row, column] += products.sum(dim=0)

    return gradient.permute(2, 3, 0, 1)
