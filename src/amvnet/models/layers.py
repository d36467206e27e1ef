"""Define layers that the two networks share, such as convolutions that wrap around the sensor."""

from __future__ import annotations

from collections.abc import Mapping
from itertools import pairwise
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional as F
from torch.nn.utils.fusion import fuse_conv_bn_eval, fuse_linear_bn_eval

from amvnet.errors import InputError
from amvnet.models.cpu_convolution import convolve, is_plain

# oneDNN compiles code for each number of rows, and keeps the code for the last thousand. With
# multiples of this number, scans share it.
ROWS = 2048


class RingConv2d(nn.Conv2d):
    """A convolution over maps whose last axis is the azimuth.

    The azimuth is padded circularly, and the other axis is padded with zeros. The input is
    (B, C, H, W), and the output is (B, C', ceil(H / stride), ceil(W / stride)).
    """

    def __init__(
        self, channels: int, out: int, kernel: int = 3, stride: tuple[int, int] = (1, 1)
    ) -> None:
        super().__init__(channels, out, kernel, stride, padding=(kernel // 2, 0), bias=False)
        self.strides = stride
        self.wrap = kernel // 2
        # The kernels that `convolve_joined` takes, by scale; None while the weight may change.
        self.kernels: dict[tuple[int, int], Tensor] | None = None

    def forward(self, input: Tensor) -> Tensor:
        padded = wrap_width(input, self.wrap, self.wrap)
        return convolve(padded, self.weight, self.bias, self.strides, padding=(self.wrap, 0))


def wrap_width(x: Tensor, left: int, right: int) -> Tensor:
    """Pad the width circularly: (B, C, H, W) -> (B, C, H, left + W + right).

    `left` and `right` are at most W.
    """
    if not left and not right:
        return x

    if not x.requires_grad:
        return _pad_width(x, left, right)

    wrapped: Tensor = _WrapWidth.apply(x, left, right)  # type: ignore[no-untyped-call]
    return wrapped


def _pad_width(x: Tensor, left: int, right: int) -> Tensor:
    # Concatenation keeps the memory format; indexing does not.
    return torch.cat([x[..., x.shape[-1] - left :], x, x[..., :right]], dim=-1)


class _WrapWidth(torch.autograd.Function):
    """`_pad_width` with a faster gradient.

    In place, it adds the gradients of the pads to the gradients of the columns that they copy. The
    gradient that autograd derives took a third of a training step.
    """

    @staticmethod
    def forward(ctx: Any, x: Tensor, left: int, right: int) -> Tensor:
        ctx.sizes = x.shape[-1], left, right
        return _pad_width(x, left, right)

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor, None, None]:
        width, left, right = ctx.sizes
        grad = grads[0]  # (B, C, H, left + W + right)

        inner = grad[..., left : left + width].clone(memory_format=torch.preserve_format)
        for column in [*range(left), *range(left + width, left + width + right)]:
            inner[..., (column - left) % width] += grad[..., column]
        return inner, None, None


class PointLinear(nn.Linear):
    """A linear layer over rows (N, C), computed by `linear`."""

    def forward(self, input: Tensor) -> Tensor:
        return linear(input, self.weight, self.bias)


def linear(x: Tensor, weight: Tensor, bias: Tensor | None) -> Tensor:
    """Apply a linear layer with weight (C', C) to rows: (N, C) -> (N, C').

    On a CPU, torch multiplies matrices with MKL, which leaves at least half of an AMD processor's
    float32 performance unused. oneDNN, which computes convolutions, does not. Without gradients, it
    is called directly, by the operation that `torch.compile` puts in place of linear layers.
    """
    needs_gradient = torch.is_grad_enabled() and (x.requires_grad or weight.requires_grad)
    if needs_gradient or not is_plain(x, weight) or not torch.backends.mkldnn.is_available():
        return F.linear(x, weight, bias)
    missing = -len(x) % ROWS
    padded = F.pad(x, (0, 0, 0, missing)) if missing else x  # a pad of no rows is a copy
    outputs: Tensor = torch.ops.mkldnn._linear_pointwise(padded, weight, bias, "none", [], "")
    return outputs[: len(x)]


class ConvBlock(nn.Sequential):
    """A ring convolution, batch norm and a leaky ReLU: (B, C, H, W) -> (B, C', H', W')."""

    def __init__(
        self, channels: int, out: int, kernel: int = 3, stride: tuple[int, int] = (1, 1)
    ) -> None:
        super().__init__(
            RingConv2d(channels, out, kernel, stride),
            nn.BatchNorm2d(out),
            nn.LeakyReLU(0.01, inplace=True),
        )


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
        # A strided convolution would subsample as well. But on a CPU, torch's strided 1 x 1
        # convolution over few channels writes out of bounds.
        subsampled = x[..., :: self.stride[0], :: self.stride[1]]
        return F.leaky_relu_(self.second(self.first(x)) + self.skip(subsampled), 0.01)


class AzimuthGRU(nn.Module):
    """A GRU that runs once around the sensor over the cells of a map (section 3.1).

    A unidirectional GRU of hidden size C reads the map (B, C, H, W) column by column, and each
    column from top to bottom. Its outputs form a map of the same shape. The GRU first reads copies
    of the last columns, so that the hidden state knows the other end of the scan. The outputs for
    these copies are dropped.

    Args:
        padding: share of the columns that are copied, 0 to 1.
    """

    def __init__(self, channels: int, padding: float) -> None:
        super().__init__()
        self.gru = nn.GRU(channels, channels, batch_first=True)
        self.padding = padding

    def forward(self, x: Tensor) -> Tensor:
        b, c, h, w = x.shape
        padding = round(self.padding * w)
        columns = wrap_width(x, padding, 0).permute(0, 3, 2, 1)  # (B, padding + W, H, C)

        # bfloat16 is too coarse for the hidden state: the recurrence would lose it.
        with torch.autocast(x.device.type, enabled=False):
            outputs: Tensor
            outputs, _ = self.gru(columns.reshape(b, -1, c).to(next(self.gru.parameters()).dtype))
        return outputs.view(b, -1, h, c)[:, padding:].permute(0, 3, 2, 1)  # (B, C, H, W)


def upsample(x: Tensor, like: Tensor) -> Tensor:
    """Repeat the values of a coarse map (B, C, h, w) to the size (B, C, H, W) of `like`."""
    return F.interpolate(x, size=like.shape[-2:], mode="nearest")


def apply_to_joined(block: nn.Module, coarse: Tensor, fine: Tensor) -> Tensor:
    """Apply a `ConvBlock` to `torch.cat([upsample(coarse, fine), fine], dim=1)`."""
    convolution, norm, activation = block.children()
    assert isinstance(convolution, RingConv2d)
    output: Tensor = activation(norm(convolve_joined(convolution, coarse, fine)))
    return output


def convolve_joined(convolution: RingConv2d, coarse: Tensor, fine: Tensor) -> Tensor:
    """Convolve `torch.cat([upsample(coarse, fine), fine], dim=1)` with 3 x 3 kernels.

    A convolution is linear, so that each map is convolved alone and the results are added.
    Upsampling repeats each value s times along an axis. So the 3 taps of a kernel see at most 2
    different values, and 2 taps with summed weights on the coarse map give the same result. The
    position of a fine cell within its coarse cell decides which weights are summed, so that there
    are s kernels. This is half of the work.

    Args:
        coarse: (B, C, h, w). It is really upsampled if H is not a multiple of h, or W is not a
            multiple of w.
        fine: (B, C', H, W).
    """
    scale = (fine.shape[2] // coarse.shape[2], fine.shape[3] // coarse.shape[3])
    is_multiple = fine.shape[2:] == (coarse.shape[2] * scale[0], coarse.shape[3] * scale[1])
    if not is_multiple:
        output: Tensor = convolution(torch.cat([upsample(coarse, fine), fine], dim=1))
        return output

    coarse_weight = convolution.weight[:, : coarse.shape[1]]
    fine_weight = convolution.weight[:, coarse.shape[1] :]
    wrapped = wrap_width(fine, 1, 1)
    result = convolve(wrapped, fine_weight, convolution.bias, stride=(1, 1), padding=(1, 0))
    kernels = _kernels(convolution, coarse_weight, scale)
    return result.add_(_convolve_upsampled(coarse, kernels, scale))


def _kernels(convolution: RingConv2d, weight: Tensor, scale: tuple[int, int]) -> Tensor:
    """Return the kernels for a coarse map: weight (C', C, 3, 3) -> (s * s * C', C, taps, taps).

    A frozen convolution keeps its kernels. An exporter has to see the computation of the kernels.
    """
    may_keep = not torch.is_grad_enabled() and not torch.compiler.is_compiling()
    kept = convolution.kernels if may_keep else None
    if kept is not None and scale in kept:
        return kept[scale]

    # Autocast would sum the weights in a coarser type.
    with torch.autocast(weight.device.type, enabled=False):
        row_taps, column_taps = (_taps(size, weight) for size in scale)
        kernels = torch.einsum("pak,qbl,oikl->pqoiab", row_taps, column_taps, weight).flatten(0, 2)
    if kept is not None:
        kept[scale] = kernels
    return kernels


def _convolve_upsampled(x: Tensor, kernels: Tensor, scale: tuple[int, int]) -> Tensor:
    """Convolve a coarse map as if it were upsampled: (B, C, h, w) -> (B, C', h * scale, w * scale).

    The width is padded circularly. The fine cell s * t + p, with p from -1 to s - 2, sees the
    coarse cells t - 1 and t. So there is one kernel of 2 taps for each p. Because p begins at -1,
    the row of results begins one fine cell before the map.
    """
    rows, columns = scale
    output = convolve(wrap_width(x, 1, 1), kernels, None, stride=(1, 1), padding=(1, 0))
    output = output.permute(0, 2, 3, 1)  # (B, h + 1, w + 1, s * s * C')
    b, h, w, _ = output.shape

    # Arrange the s * s outputs of each coarse cell as fine cells.
    cells: Tensor = output.unflatten(3, (rows, columns, -1)).transpose(2, 3)
    cells = cells.reshape(b, h * rows, w * columns, -1)

    # Drop the fine cells before the map and after it.
    top = int(rows > 1)
    left = int(columns > 1)
    height = x.shape[2] * rows
    width = x.shape[3] * columns
    return cells[:, top : top + height, left : left + width].permute(0, 3, 1, 2)


def _taps(scale: int, like: Tensor) -> Tensor:
    """Return which weights each tap sums: (scale, taps, 3), 1 for a weight in the sum, else 0.

    The first axis is the position of a fine cell within its coarse cell. The second axis is the tap
    on the coarse map. The third axis is the weight.
    """
    if scale == 1:
        return torch.eye(3, dtype=like.dtype, device=like.device)[None]

    position = torch.arange(-1, scale - 1)[:, None]
    offset = torch.arange(-1, 2)
    second = (position + offset >= 0).to(like)  # (scale, 3): 1 for coarse cell t, 0 for t - 1
    return torch.stack([1 - second, second], dim=1)


def load_part(net: nn.Module, part: str, parameters: Mapping[str, Tensor]) -> None:
    """Load the parameters of a part of AMVNet; raise InputError if they do not fit its sizes."""
    try:
        net.load_state_dict(parameters)
    except RuntimeError:
        raise InputError(
            f"expected parameters of {part} that fit its description, found others; train it again"
        ) from None


def freeze(module: nn.Module) -> None:
    """Make a module in evaluation mode faster. Its parameters must not change afterwards.

    Each batch norm is folded into the layer before it: the outputs are the same up to rounding.
    Values that depend only on parameters are computed once.
    """
    for layers in list(module.modules()):
        if not isinstance(layers, nn.Sequential):
            continue

        for index, (layer, norm) in enumerate(pairwise(list(layers))):
            if isinstance(layer, nn.Conv2d) and isinstance(norm, nn.BatchNorm2d):
                layers[index] = fuse_conv_bn_eval(layer, norm)
                layers[index + 1] = nn.Identity()
            elif isinstance(layer, nn.Linear) and isinstance(norm, nn.BatchNorm1d):
                layers[index] = fuse_linear_bn_eval(layer, norm)
                layers[index + 1] = nn.Identity()

    for layer in module.modules():
        if isinstance(layer, RingConv2d):
            layer.kernels = {}
