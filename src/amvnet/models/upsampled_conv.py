"""A convolution over a fine map beside an upsampled coarse one, of which the coarse one stays coarse."""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from amvnet.models.layers import RingConv2d, upsample, wrap_width


def joined(block: nn.Module, coarse: Tensor, fine: Tensor) -> Tensor:
    """As `block(torch.cat([upsample(coarse, fine), fine], dim=1))`, for a `ConvBlock`."""
    convolution, norm, activation = block.children()
    assert isinstance(convolution, RingConv2d)
    return activation(norm(convolve_joined(convolution, coarse, fine)))


def convolve_joined(convolution: RingConv2d, coarse: Tensor, fine: Tensor) -> Tensor:
    """As `convolution(torch.cat([upsample(coarse, fine), fine], dim=1))`, for kernels of 3 x 3.

    A convolution is linear, so that each map can have its own. And where s neighbouring values are the same, 3 taps are
    2 with summed weights: the coarse map is convolved as it is, by other kernels for each of the s places between its
    values. That is half of the work. Training takes the plain way, and so do exported and compiled networks.

    Args:
        coarse: (B, C, h, w), its values for cells of whole numbers of `fine`'s, or the plain way is taken.
        fine: (B, C', H, W).
    """
    scale = fine.shape[2] // coarse.shape[2], fine.shape[3] // coarse.shape[3]
    whole = fine.shape[2:] == (coarse.shape[2] * scale[0], coarse.shape[3] * scale[1])
    if not whole or torch.is_grad_enabled() or torch.compiler.is_compiling():
        return convolution(torch.cat([upsample(coarse, fine), fine], dim=1))
    of_coarse, of_fine = convolution.weight.split([coarse.shape[1], fine.shape[1]], dim=1)
    found = F.conv2d(wrap_width(fine, 1, 1), of_fine, convolution.bias, padding=(1, 0))
    return found.add_(_convolve_upsampled(coarse, of_coarse, scale))


def _convolve_upsampled(x: Tensor, weight: Tensor, scale: tuple[int, int]) -> Tensor:
    """(B, C, h, w) and weight (C', C, 3, 3) -> (B, C', h * scale, w * scale), the width continued circularly.

    Output cell s * t + p sees the inputs t - 1 and t, for p from -1 to s - 2: one kernel for each p, and the cells that
    they find for a t, in a row, begin one cell before the first.
    """
    rows, columns = scale
    with torch.autocast(
        x.device.type, enabled=False
    ):  # sums of weights are exact enough in their own type only
        taps = _taps(rows, weight), _taps(columns, weight)
        kernels = torch.einsum("pak,qbl,oikl->pqoiab", *taps, weight).flatten(0, 2)
    found = F.conv2d(wrap_width(x, 1, 1), kernels, padding=(1, 0)).permute(
        0, 2, 3, 1
    )  # (B, h + 1, w + 1, s * s * C')
    b, h, w, _ = found.shape
    cells = (
        found.view(b, h, w, rows, columns, -1).transpose(2, 3).reshape(b, h * rows, w * columns, -1)
    )
    top, left = int(rows > 1), int(columns > 1)
    size = x.shape[2] * rows, x.shape[3] * columns
    return cells[:, top : top + size[0], left : left + size[1]].permute(0, 3, 1, 2)


def _taps(scale: int, like: Tensor) -> Tensor:
    """(scale, taps on the coarse map, 3): which of the three weights each kernel sums for each of its taps."""
    if scale == 1:
        return torch.eye(3, dtype=like.dtype, device=like.device)[None]
    place, k = torch.arange(-1, scale - 1)[:, None], torch.arange(-1, 2)
    second = (place + k >= 0).to(
        like
    )  # (scale, 3): else the fine cell lies in the coarse cell before
    return torch.stack([1 - second, second], dim=1)
