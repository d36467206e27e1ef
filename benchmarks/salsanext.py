"""Build the network of SalsaNext as its paper describes it, with random weights, to compare times.

Cortinhas, Tzelepis, Aksoy: SalsaNext: Fast, Uncertainty-aware Semantic Segmentation of LiDAR Point
Clouds (2020).
"""

from __future__ import annotations

from itertools import pairwise

import torch
from torch import Tensor, nn
from torch.nn import functional as F

CHANNELS = 5
CLASSES = 20


class Unit(nn.Sequential):
    """Convolution, leaky ReLU, batch norm.

    In this order the norm cannot be folded into the convolution.
    """

    def __init__(
        self, channels: int, out: int, kernel: int, padding: int = 0, dilation: int = 1
    ) -> None:
        convolution = nn.Conv2d(channels, out, kernel, padding=padding, dilation=dilation)
        super().__init__(convolution, nn.LeakyReLU(inplace=True), nn.BatchNorm2d(out))


class Context(nn.Module):
    """The contextual module at full resolution: 3 x 3 and 3 x 3 dilated, added to a shortcut."""

    def __init__(self, channels: int, out: int) -> None:
        super().__init__()
        self.shortcut = nn.Sequential(nn.Conv2d(channels, out, 1), nn.LeakyReLU(inplace=True))
        self.near = Unit(out, out, 3, padding=1)
        self.far = Unit(out, out, 3, padding=2, dilation=2)

    def forward(self, x: Tensor) -> Tensor:
        shortcut = self.shortcut(x)
        return shortcut + self.far(self.near(shortcut))


class Dilated(nn.Module):
    """Three convolutions in sequence, and a 1 x 1 convolution over the results of all three.

    The three are 3 x 3, 3 x 3 dilated, and 2 x 2 dilated.
    """

    def __init__(self, channels: int, out: int) -> None:
        super().__init__()
        self.first = Unit(channels, out, 3, padding=1)
        self.second = Unit(out, out, 3, padding=2, dilation=2)
        self.third = Unit(out, out, 2, padding=1, dilation=2)
        self.joined = Unit(3 * out, out, 1)

    def forward(self, x: Tensor) -> Tensor:
        first = self.first(x)
        second = self.second(first)
        return self.joined(torch.cat([first, second, self.third(second)], dim=1))


class Encoder(nn.Module):
    """A dilated block with a shortcut. The decoder takes its output before pooling."""

    def __init__(self, channels: int, out: int) -> None:
        super().__init__()
        self.shortcut = nn.Sequential(nn.Conv2d(channels, out, 1), nn.LeakyReLU(inplace=True))
        self.block = Dilated(channels, out)

    def forward(self, x: Tensor) -> Tensor:
        return self.shortcut(x) + self.block(x)


class SalsaNext(nn.Module):
    """Range image (B, 5, H, W) -> logits (B, 20, H, W).

    Like the paper's network it has 6.7 million parameters, and takes 62.3 billion multiply-adds at
    64 x 2048.
    """

    def __init__(self) -> None:
        super().__init__()
        self.context = nn.Sequential(Context(CHANNELS, 32), Context(32, 32), Context(32, 32))

        self.encoders = nn.ModuleList()
        for channels, out in pairwise((32, 64, 128, 256, 256, 256)):
            self.encoders.append(Encoder(channels, out))

        # The channels from the coarser map after its pixel shuffle, of the skip, and of the output
        sizes = ((64, 256, 128), (32, 256, 128), (32, 128, 64), (16, 64, 32))
        self.decoders = nn.ModuleList()
        for coarse, skip, out in sizes:
            self.decoders.append(Dilated(coarse + skip, out))
        self.scores = nn.Conv2d(32, CLASSES, 1)

    def forward(self, image: Tensor) -> Tensor:
        x = self.context(image)
        skips = []
        for encoder in self.encoders[:-1]:
            full = encoder(x)
            skips.append(full)
            x = F.avg_pool2d(full, 3, 2, 1)

        x = self.encoders[-1](x)
        for decoder, skip in zip(self.decoders, reversed(skips), strict=True):
            x = decoder(torch.cat([F.pixel_shuffle(x, 2), skip], dim=1))
        return self.scores(x)
