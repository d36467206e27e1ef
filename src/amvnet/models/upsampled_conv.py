"""Convolve an upsampled map that is concatenated with a fine map, in half of the time."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from amvnet.models.cpu_convolution import convolve
from amvnet.models.layers import RingConv2d, upsample, wrap_width


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
