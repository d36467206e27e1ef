"""The bird's-eye-view network: PolarNet (Zhang et al., CVPR 2020)."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from amvnet.config.schema import PolarNetConfig
from amvnet.models.layers import ConvBlock, PointLinear, linear
from amvnet.models.upsampled_conv import joined
from amvnet.models.views.polar_view import FEATURES, PolarGrid

PART, PART_ON_GPU = (
    2048,
    2**18,
)  # points that are encoded at a time: what a cache holds; what keeps a GPU busy


class PolarNet(nn.Module):
    """Points in the polar grid -> scores before softmax (M, Z * K) of the M occupied pillars, K for each voxel."""

    def __init__(self, config: PolarNetConfig, vertical: int, classes: int) -> None:
        super().__init__()
        c = config
        self.point_mlp = _point_mlp(c.point_widths)
        self.compress = nn.Sequential(
            PointLinear(c.point_widths[-1], c.pillar), nn.ReLU(inplace=True)
        )
        self.first = _double(c.pillar, c.widths[0])
        downs = zip(c.widths[:-1], c.widths[1:], strict=True)
        self.down = nn.ModuleList(_double(fine, coarse) for fine, coarse in downs)
        ups = [
            (coarse + fine, fine) for fine, coarse in zip(c.widths[:-1], c.widths[1:], strict=True)
        ]
        self.up = nn.ModuleList(_double(channels, fine) for channels, fine in reversed(ups))
        self.drop = DropBlock(c.dropblock, c.dropblock_size)
        self.scores = nn.Conv2d(c.widths[0], vertical * classes, 1)
        # What runs the U-Net: its own method, or an engine's compiled or exported equivalent.
        self.run_unet: Callable[[Tensor], Tensor] | None = None

    def forward(self, grid: PolarGrid) -> Tensor:
        pillars = self.compress(self.pool(grid))  # (M, pillar)
        # An empty pillar has no point to score, and most are empty.
        run_unet = self.unet if self.run_unet is None else self.run_unet
        return self.score(grid.at_pillars(run_unet(grid.to_map(pillars))))

    def pool(self, grid: PolarGrid) -> Tensor:  # (M, point_widths[-1])
        if torch.is_grad_enabled():
            return grid.pool(self.point_mlp(grid.features))
        return grid.pool_by_parts(self.point_mlp, PART if grid.features.is_cpu else PART_ON_GPU)

    def score(self, pillars: Tensor) -> Tensor:  # (M, widths[0]) -> (M, Z * K)
        return linear(pillars, self.scores.weight.flatten(1), self.scores.bias)

    def unet(self, x: Tensor) -> Tensor:  # (B, pillar, R, A) -> (B, widths[0], R, A)
        x = self.first(x)
        skips = [x]
        for down in self.down:
            x = down(F.max_pool2d(x, 2, ceil_mode=True))
            skips.append(x)
        for up, skip in zip(self.up, reversed(skips[:-1]), strict=True):
            first, second = up.children()
            x = self.drop(second(joined(first, x, skip)))
        return x


class DropBlock(nn.Module):
    """Drops squares of a map in training, and scales up what is left (Ghiasi et al., 2018)."""

    def __init__(self, probability: float, size: int) -> None:
        super().__init__()
        self.probability, self.size = probability, size

    def forward(self, x: Tensor) -> Tensor:  # (B, C, H, W)
        if not self.training or not self.probability:
            return x
        size = min(self.size, *x.shape[-2:])
        size -= 1 - size % 2  # odd, so that a square has a centre
        # Every cell is dropped with the given probability if a centre falls within the square around it.
        rate = 1 - (1 - self.probability) ** (1 / size**2)
        centres = (torch.rand(x.shape[0], 1, *x.shape[-2:], device=x.device) < rate).to(x.dtype)
        kept = 1 - F.max_pool2d(centres, size, stride=1, padding=size // 2)
        share = kept.mean(dtype=torch.float32).clamp_min(
            1 / kept.numel()
        )  # a sum would overflow half precision
        return x * (kept / share).to(x.dtype)


def _double(channels: int, out: int) -> nn.Sequential:
    return nn.Sequential(ConvBlock(channels, out), ConvBlock(out, out))


def _point_mlp(widths: tuple[int, ...]) -> nn.Sequential:
    """The shared MLP over points, with batch norm after the input and each layer but the last."""
    layers: list[nn.Module] = [nn.BatchNorm1d(FEATURES)]
    for channels, out in zip((FEATURES, *widths[:-2]), widths[:-1], strict=True):
        layers += [PointLinear(channels, out), nn.BatchNorm1d(out), nn.ReLU(inplace=True)]
    return nn.Sequential(*layers, PointLinear(widths[-2], widths[-1]))
