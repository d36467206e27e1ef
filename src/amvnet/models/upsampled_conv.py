"""A convolution over an upsampled map joined with a fine one, at less cost."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from amvnet.models.cpu_convolution import convolve
from amvnet.models.layers import RingConv2d, upsample, wrap_width


def joined(block: nn.Module, coarse: Tensor, fine: Tensor) -> Tensor:
    """Return `block(torch.cat([upsample(coarse, fine), fine], dim=1))`, for a `ConvBlock`."""
    convolution, norm, activation = block.children()
    assert isinstance(convolution, RingConv2d)
    return activation(norm(convolve_joined(convolution, coarse, fine)))


def convolve_joined(convolution: RingConv2d, coarse: Tensor, fine: Tensor) -> Tensor:
    """Return `convolution(torch.cat([upsample(coarse, fine), fine], dim=1))`, for 3 x 3 kernels.

    A convolution is linear, so that each map can be convolved alone and the results added. The
    upsampled map repeats each value s times along an axis, so that 3 taps see at most 2 different
    values: 2 taps on the coarse map with summed weights do the same, with another kernel for each
    of the s positions within a coarse cell. This is half of the work.

    Args:
        coarse: (B, C, h, w). If H or W is not a multiple of h or w, the map is upsampled.
        fine: (B, C', H, W).
    """
    scale = (fine.shape[2] // coarse.shape[2], fine.shape[3] // coarse.shape[3])
    is_multiple = fine.shape[2:] == (coarse.shape[2] * scale[0], coarse.shape[3] * scale[1])
    if not is_multiple:
        return convolution(torch.cat([upsample(coarse, fine), fine], dim=1))

    coarse_weight = convolution.weight[:, : coarse.shape[1]]
    fine_weight = convolution.weight[:, coarse.shape[1] :]
    wrapped = wrap_width(fine, 1, 1)
    result = convolve(wrapped, fine_weight, convolution.bias, stride=(1, 1), padding=(1, 0))
    kernels = _kernels(convolution, coarse_weight, scale)
    return result.add_(_convolve_upsampled(coarse, kernels, scale))


def _kernels(convolution: RingConv2d, weight: Tensor, scale: tuple[int, int]) -> Tensor:
    """Return the kernels (s * s * C', C, taps, taps) for upsampled maps, of a weight (C', C, 3, 3).

    A frozen convolution keeps them. An exporter has to see how they are made.
    """
    may_keep = not torch.is_grad_enabled() and not torch.compiler.is_compiling()
    kept = convolution.kernels if may_keep else None
    if kept is not None and scale in kept:
        return kept[scale]

    # The sums of weights are exact enough only in the weights' own type.
    with torch.autocast(weight.device.type, enabled=False):
        row_taps, column_taps = (_taps(size, weight) for size in scale)
        kernels = torch.einsum("pak,qbl,oikl->pqoiab", row_taps, column_taps, weight).flatten(0, 2)
    if kept is not None:
        kept[scale] = kernels
    return kernels


def _convolve_upsampled(x: Tensor, kernels: Tensor, scale: tuple[int, int]) -> Tensor:
    """Convolve (B, C, h, w) upsampled, by `_kernels`, into (B, C', h * scale, w * scale).

    The width is continued circularly. Fine cell s * t + p, with p from -1 to s - 2, sees the coarse
    cells t - 1 and t. So there is one kernel of 2 taps for each p. The fine cells of all t in a row
    begin one cell before the first.
    """
    rows, columns = scale
    output = convolve(wrap_width(x, 1, 1), kernels, None, stride=(1, 1), padding=(1, 0))
    output = output.permute(0, 2, 3, 1)  # (B, h + 1, w + 1, s * s * C')
    b, h, w, _ = output.shape

    # From the outputs of each coarse cell to a map of fine cells
    cells = output.unflatten(3, (rows, columns, -1)).transpose(2, 3)
    cells = cells.reshape(b, h * rows, w * columns, -1)

    # Without the cells before the first and after the last
    top = int(rows > 1)
    left = int(columns > 1)
    height = x.shape[2] * rows
    width = x.shape[3] * columns
    return cells[:, top : top + height, left : left + width].permute(0, 3, 1, 2)


def _taps(scale: int, like: Tensor) -> Tensor:
    """Return (scale, taps, 3) ones and zeros: which of the 3 weights are summed for each tap.

    The first axis is the position of a fine cell within a coarse one, the second the taps on the
    coarse map.
    """
    if scale == 1:
        return torch.eye(3, dtype=like.dtype, device=like.device)[None]

    position = torch.arange(-1, scale - 1)[:, None]
    offset = torch.arange(-1, 2)
    second = (position + offset >= 0).to(like)  # (scale, 3): 1 for coarse cell t, 0 for t - 1
    return torch.stack([1 - second, second], dim=1)
