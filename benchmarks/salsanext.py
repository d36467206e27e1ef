"""SalsaNext's network by its paper's description, with random weights: a yardstick for times, not for accuracy.

Cortinhas, Tzelepis, Aksoy: SalsaNext: Fast, Uncertainty-aware Semantic Segmentation of LiDAR Point Clouds (2020).
"""

from __future__ import annotations

from itertools import pairwise

import torch
from torch import Tensor, nn
from torch.nn import functional as F

CHANNELS, CLASSES = 5, 20


class Unit(nn.Sequential):
    """Convolution, leaky ReLU, batch norm: in this order no norm can be folded into its convolution."""

    def __init__(
        self, channels: int, out: int, kernel: int, padding: int = 0, dilation: int = 1
    ) -> None:
        convolution = nn.Conv2d(channels, out, kernel, padding=padding, dilation=dilation)
        super().__init__(convolution, nn.LeakyReLU(inplace=True), nn.BatchNorm2d(out))


class Context(nn.Module):
    """The contextual module at full resolution: 3 x 3, and 3 x 3 dilated, beside a shortcut."""

    def __init__(self, channels: int, out: int) -> None:
        super().__init__()
        self.shortcut = nn.Sequential(nn.Conv2d(channels, out, 1), nn.LeakyReLU(inplace=True))
        self.near, self.far = Unit(out, out, 3, 1), Unit(out, out, 3, 2, 2)

    def forward(self, x: Tensor) -> Tensor:
        shortcut = self.shortcut(x)
        return shortcut + self.far(self.near(shortcut))


class Dilated(nn.Module):
    """Three convolutions one after the other (3 x 3, 3 x 3 dilated, 2 x 2 dilated), and a 1 x 1 over all three."""

    def __init__(self, channels: int, out: int) -> None:
        super().__init__()
        self.first, self.second, self.third = (
            Unit(channels, out, 3, 1),
            Unit(out, out, 3, 2, 2),
            Unit(out, out, 2, 1, 2),
        )
        self.joined = Unit(3 * out, out, 1)

    def forward(self, x: Tensor) -> Tensor:
        first = self.first(x)
        second = self.second(first)
        return self.joined(torch.cat([first, second, self.third(second)], dim=1))


class Encoder(nn.Module):
    """A dilated block with a shortcut; its output before pooling goes to the decoder."""

    def __init__(self, channels: int, out: int) -> None:
        super().__init__()
        self.shortcut = nn.Sequential(nn.Conv2d(channels, out, 1), nn.LeakyReLU(inplace=True))
        self.block = Dilated(channels, out)

    def forward(self, x: Tensor) -> Tensor:
        return self.shortcut(x) + self.block(x)


class SalsaNext(nn.Module):
    """Range image (B, 5, H, W) -> scores (B, 20, H, W).

    6.7 million parameters, and 62.3 billion multiply-adds at 64 x 2048, as the paper's.
    """

    def __init__(self) -> None:
        super().__init__()
        self.context = nn.Sequential(Context(CHANNELS, 32), Context(32, 32), Context(32, 32))
        widths = (32, 64, 128, 256, 256, 256)
        self.encoders = nn.ModuleList(Encoder(a, b) for a, b in pairwise(widths))
        # Of each decoder: channels from below after the pixel shuffle, of the skip, and out.
        sizes = ((64, 256, 128), (32, 256, 128), (32, 128, 64), (16, 64, 32))
        self.decoders = nn.ModuleList(Dilated(below + skip, out) for below, skip, out in sizes)
        self.scores = nn.Conv2d(32, CLASSES, 1)

    def forward(self, image: Tensor) -> Tensor:
        x, skips = self.context(image), []
        for encoder in self.encoders[:-1]:
            full = encoder(x)
            skips.append(full)
            x = F.avg_pool2d(full, 3, 2, 1)
        x = self.encoders[-1](x)
        for decoder, skip in zip(self.decoders, reversed(skips), strict=True):
            x = decoder(torch.cat([F.pixel_shuffle(x, 2), skip], dim=1))
        return self.scores(x)
