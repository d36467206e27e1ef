"""Layers that the two networks share: convolutions that wrap around the sensor."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional as F
from torch.nn.utils.fusion import fuse_conv_bn_eval, fuse_linear_bn_eval


class RingConv2d(nn.Conv2d):
    """A convolution whose last axis is the azimuth: padded circularly there, with zeros on the other.

    Input (B, C, H, W), output (B, C', ceil(H / stride), ceil(W / stride)).
    """

    def __init__(
        self, channels: int, out: int, kernel: int = 3, stride: tuple[int, int] = (1, 1)
    ) -> None:
        super().__init__(channels, out, kernel, stride, padding=(kernel // 2, 0), bias=False)
        self.wrap = kernel // 2

    def forward(self, input: Tensor) -> Tensor:
        return super().forward(wrap_width(input, self.wrap, self.wrap))


def wrap_width(x: Tensor, left: int, right: int) -> Tensor:
    """(B, C, H, W) -> (B, C, H, left + W + right), continued circularly; the pads may be wider than W."""
    if not left and not right:
        return x
    return _WrapWidth.apply(x, left, right) if x.requires_grad else _wrapped(x, left, right)


def _wrapped(x: Tensor, left: int, right: int) -> Tensor:
    width = x.shape[-1]
    if max(left, right) <= width:  # keeps the memory format, which a gather by index does not
        return torch.cat([x[..., width - left :], x, x[..., :right]], dim=-1)
    return x[..., torch.arange(-left, width + right, device=x.device) % width]


class _WrapWidth(torch.autograd.Function):
    """`_wrapped` with a gradient that adds the pads in place: autograd's own took a third of a training step."""

    @staticmethod
    def forward(ctx: Any, x: Tensor, left: int, right: int) -> Tensor:
        ctx.sizes = x.shape[-1], left, right
        return _wrapped(x, left, right)

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor, None, None]:
        width, left, right = ctx.sizes
        grad = grads[0]
        inner = grad[..., left : left + width].clone(memory_format=torch.preserve_format)
        for pad in [*range(left), *range(left + width, left + width + right)]:
            inner[..., (pad - left) % width] += grad[..., pad]
        return inner, None, None


class PointLinear(nn.Linear):
    """A linear layer over rows, by `linear`."""

    def forward(self, input: Tensor) -> Tensor:
        return linear(input, self.weight, self.bias)


def linear(x: Tensor, weight: Tensor, bias: Tensor | None) -> Tensor:
    """Rows (N, C) and weight (C', C) -> (N, C'): `F.linear`, on a CPU as a convolution of one cell.

    torch multiplies matrices on a CPU by MKL, which leaves half and more of an AMD processor's float32 unused. Its
    convolutions, by oneDNN, do not.
    """
    if (
        torch.compiler.is_compiling() or not x.is_cpu or not len(x)
    ):  # there is no convolution of nothing
        return F.linear(x, weight, bias)
    image = x.reshape(1, len(x), 1, x.shape[1]).permute(
        0, 3, 1, 2
    )  # (1, C, N, 1), its channels last
    return F.conv2d(image, weight[:, :, None, None], bias).permute(0, 2, 3, 1).flatten(0, 2)


class ConvBlock(nn.Sequential):
    """Ring convolution, batch norm, leaky ReLU."""

    def __init__(
        self, channels: int, out: int, kernel: int = 3, stride: tuple[int, int] = (1, 1)
    ) -> None:
        norm, activation = nn.BatchNorm2d(out), nn.LeakyReLU(0.01, inplace=True)
        super().__init__(RingConv2d(channels, out, kernel, stride), norm, activation)


class ResidualBlock(nn.Module):
    """Two ring convolutions and a skip connection (He et al., 2016)."""

    def __init__(self, channels: int, out: int, stride: tuple[int, int] = (1, 1)) -> None:
        super().__init__()
        self.first = ConvBlock(channels, out, stride=stride)
        self.second = nn.Sequential(RingConv2d(out, out), nn.BatchNorm2d(out))
        self.skip: nn.Module = nn.Identity()
        if stride != (1, 1) or channels != out:
            self.skip = nn.Sequential(RingConv2d(channels, out, 1), nn.BatchNorm2d(out))
        self.stride = stride

    def forward(self, x: Tensor) -> Tensor:  # (B, C, H, W) -> (B, C', H / stride, W / stride)
        # Strided here and not in the convolution: torch's own of one cell on few channels writes out of bounds
        # on a CPU.
        kept = x[..., :: self.stride[0], :: self.stride[1]]
        return F.leaky_relu_(self.second(self.first(x)) + self.skip(kept), 0.01)


class AzimuthGRU(nn.Module):
    """A GRU that runs once around the sensor over the cells of a map (section 3.1 of the paper).

    The map (B, C, H, W) is read column by column, each from top to bottom, by a unidirectional GRU of hidden
    size C; its outputs are put back as a map (B, C, H, W). The columns before the first are the last ones, so
    that the hidden state has seen the other end of the scan; the outputs there are dropped.
    """

    def __init__(self, channels: int, padding: float) -> None:
        super().__init__()
        self.gru = nn.GRU(channels, channels, batch_first=True)
        self.padding = padding

    def forward(self, x: Tensor) -> Tensor:
        b, c, h, w = x.shape
        padding = round(self.padding * w)
        columns = wrap_width(x, padding, 0).permute(0, 3, 2, 1)  # (B, padding + W, H, C)
        with torch.autocast(
            x.device.type, enabled=False
        ):  # a recurrence in bfloat16 loses its state
            outputs, _ = self.gru(columns.reshape(b, -1, c).to(next(self.gru.parameters()).dtype))
        return outputs.view(b, -1, h, c)[:, padding:].permute(0, 3, 2, 1)  # (B, C, H, W)


def upsample(x: Tensor, like: Tensor) -> Tensor:
    """(B, C, h, w) -> (B, C, H, W) of `like`, each value to the cells that it stands for."""
    return F.interpolate(x, size=like.shape[-2:], mode="nearest")


def fold_batch_norms(module: nn.Module) -> None:
    """Put the batch norms of a module that is in evaluation into the layers before them: as exact, and faster."""
    for layers in [m for m in module.modules() if isinstance(m, nn.Sequential)]:
        for place, (layer, norm) in enumerate(zip(list(layers), list(layers)[1:], strict=False)):
            if isinstance(layer, nn.Conv2d) and isinstance(norm, nn.BatchNorm2d):
                layers[place], layers[place + 1] = fuse_conv_bn_eval(layer, norm), nn.Identity()
            elif isinstance(layer, nn.Linear) and isinstance(norm, nn.BatchNorm1d):
                layers[place], layers[place + 1] = fuse_linear_bn_eval(layer, norm), nn.Identity()
