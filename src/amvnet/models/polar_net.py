"""Define the bird's-eye-view network: PolarNet (Zhang et al., CVPR 2020)."""

from __future__ import annotations

from itertools import pairwise

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from amvnet.config.schema import PolarNetConfig
from amvnet.models.layers import ConvBlock, PointLinear, apply_to_joined, linear
from amvnet.models.views.polar_view import FEATURES, PolarGrid

PART_ON_CPU = 8192  # number of points encoded at a time on a CPU, which fit its cache
PART_ON_GPU = 2**18  # number of points encoded at a time on a GPU, which keep it busy


class PolarNet(nn.Module):
    """The network that takes a `PolarGrid` and returns the logits of its M occupied pillars.

    The logits are (M, Z * K): K (`classes`) for each of the Z (`vertical`) voxels of a pillar. The
    decoder's last map has C channels.
    """

    def __init__(self, config: PolarNetConfig, vertical: int, classes: int) -> None:
        super().__init__()
        widths = config.widths
        self.point_mlp = _point_mlp(config.point_widths)
        self.compress = nn.Sequential(
            PointLinear(config.point_widths[-1], config.pillar), nn.ReLU(inplace=True)
        )

        # The U-Net goes from fine to coarse maps and back.
        self.norm = nn.BatchNorm2d(config.pillar) if config.input_norm else nn.Identity()
        self.first = _double(config.pillar, widths[0])
        self.down = nn.ModuleList()
        for fine, coarse in pairwise(widths):
            self.down.append(_double(fine, coarse))
        self.up = nn.ModuleList()
        decoder = config.decoder or tuple(reversed(widths[:-1]))
        coarse = widths[-1]
        for fine, width in zip(reversed(widths[:-1]), decoder, strict=True):
            self.up.append(_double(coarse + fine, width))
            coarse = width
        self.drop = DropBlock(config.dropblock, config.dropblock_size)
        self.scores = nn.Conv2d(coarse, vertical * classes, 1)

    def forward(self, grid: PolarGrid) -> Tensor:
        return self.decode(grid, self.unet(self.encode(grid)))

    def encode(self, grid: PolarGrid) -> Tensor:
        """Return the map of the pillars' features, (B, pillar, R, A)."""
        return grid.to_map(self.compress(self.pool(grid)))

    def decode(self, grid: PolarGrid, decoded: Tensor) -> Tensor:
        """Return the logits (M, Z * K), given the U-Net's output (B, C, R, A)."""
        # Most pillars are empty and need no logits.
        return self.score(grid.at_pillars(decoded))

    def pool(self, grid: PolarGrid) -> Tensor:  # (F, point_widths[-1])
        if torch.is_grad_enabled():
            return grid.pool(self.point_mlp(grid.features))
        part = PART_ON_CPU if grid.features.is_cpu else PART_ON_GPU
        return grid.pool_by_parts(self.point_mlp, part)

    def score(self, pillars: Tensor) -> Tensor:  # (M, C) -> (M, Z * K)
        return linear(pillars, self.scores.weight.flatten(1), self.scores.bias)

    def unet(self, x: Tensor) -> Tensor:  # (B, pillar, R, A) -> (B, C, R, A)
        x = self.first(self.norm(x))
        skips = [x]
        for down in self.down:
            x = down(F.max_pool2d(x, 2, ceil_mode=True))
            skips.append(x)

        for up, skip in zip(self.up, reversed(skips[:-1]), strict=True):
            first, second = up.children()
            x = self.drop(second(apply_to_joined(first, x, skip)))
        return x


class DropBlock(nn.Module):
    """Drop squares of `size` cells in training, and scale up the others (Ghiasi et al., 2018).

    Each cell is dropped with `probability`.
    """

    def __init__(self, probability: float, size: int) -> None:
        super().__init__()
        self.probability = probability
        self.size = size

    def forward(self, x: Tensor) -> Tensor:  # (B, C, H, W)
        if not self.training or not self.probability:
            return x

        # A square has a centre if its side is odd.
        size = min(self.size, *x.shape[-2:])
        size -= 1 - size % 2

        # A cell is dropped if there is a centre in the square around it. With this rate of centres,
        # the probability is `self.probability`.
        rate = 1 - (1 - self.probability) ** (1 / size**2)
        centres = torch.rand(x.shape[0], 1, *x.shape[-2:], device=x.device) < rate
        mask = 1 - F.max_pool2d(centres.to(x.dtype), size, stride=1, padding=size // 2)

        # A sum would overflow half precision; a mean does not.
        kept_share = mask.mean(dtype=torch.float32).clamp_min(1 / mask.numel())
        return x * (mask / kept_share).to(x.dtype)


def _double(channels: int, out: int) -> nn.Sequential:
    return nn.Sequential(ConvBlock(channels, out), ConvBlock(out, out))


def _point_mlp(widths: tuple[int, ...]) -> nn.Sequential:
    """Return the shared MLP: batch norm follows the input and each layer but the last."""
    layers: list[nn.Module] = [nn.BatchNorm1d(FEATURES)]
    for channels, out in pairwise((FEATURES, *widths[:-1])):
        layers += [PointLinear(channels, out), nn.BatchNorm1d(out), nn.ReLU(inplace=True)]
    return nn.Sequential(*layers, PointLinear(widths[-2], widths[-1]))
