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
    """A convolution, then a leaky ReLU, then a batch norm.

    In this order, the norm cannot be folded into the convolution before it.
    """

    def __init__(
        self, channels: int, out: int, kernel: int, padding: int = 0, dilation: int = 1
    ) -> None:
        convolution = nn.Conv2d(channels, out, kernel, padding=padding, dilation=dilation)
        super().__init__(convolution, nn.LeakyReLU(inplace=True), nn.BatchNorm2d(out))


class Context(nn.Module):
    """The contextual module at full resolution: two 3 x 3 convolutions, added to a shortcut.

    The second convolution is dilated.
    """

    def __init__(self, channels: int, out: int) -> None:
        super().__init__()
        self.shortcut = nn.Sequential(nn.Conv2d(channels, out, 1), nn.LeakyReLU(inplace=True))
        self.near = Unit(out, out, 3, padding=1)
        self.far = Unit(out, out, 3, padding=2, dilation=2)

    def forward(self, x: Tensor) -> Tensor:
        shortcut = self.shortcut(x)
        return shortcut + self.far(self.near(shortcut))


class Dilated(nn.Module):
    """Three convolutions in sequence, and a 1 x 1 convolution that joins their three results.

    The first one is 3 x 3, the second one 3 x 3 and dilated, the third one 2 x 2 and dilated.
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


class EncoderStage(nn.Module):
    """One stage of the encoder: a dilated block with a shortcut. `SalsaNext` pools its output."""

    def __init__(self, channels: int, out: int) -> None:
        super().__init__()
        self.shortcut = nn.Sequential(nn.Conv2d(channels, out, 1), nn.LeakyReLU(inplace=True))
        self.block = Dilated(channels, out)

    def forward(self, x: Tensor) -> Tensor:
        return self.shortcut(x) + self.block(x)


class SalsaNext(nn.Module):
    """Range image (B, 5, H, W) -> logits (B, 20, H, W).

    Like the paper's network, it has 6.7 million parameters. On an image of 64 x 2048, it takes 62.3
    billion multiply-adds.
    """

    def __init__(self) -> None:
        super().__init__()
        self.context = nn.Sequential(Context(CHANNELS, 32), Context(32, 32), Context(32, 32))

        self.encoders = nn.ModuleList()
        for channels, out in pairwise((32, 64, 128, 256, 256, 256)):
            self.encoders.append(EncoderStage(channels, out))

        # Each decoder stage has three numbers of channels: in the coarser map after its pixel
        # shuffle, in the encoder's map of the same size, and in the output.
        sizes = ((64, 256, 128), (32, 256, 128), (32, 128, 64), (16, 64, 32))
        self.decoders = nn.ModuleList()
        for coarse, skip, out in sizes:
            self.decoders.append(Dilated(coarse + skip, out))
        self.scores = nn.Conv2d(32, CLASSES, 1)

    def forward(self, image: Tensor) -> Tensor:
        x = self.context(image)
        skips = []
        for encoder in self.encoders[:-1]:
            before_pooling = encoder(x)
            skips.append(before_pooling)
            x = F.avg_pool2d(before_pooling, 3, 2, 1)

        x = self.encoders[-1](x)
        for decoder, skip in zip(self.decoders, reversed(skips), strict=True):
            x = decoder(torch.cat([F.pixel_shuffle(x, 2), skip], dim=1))
        return self.scores(x)
