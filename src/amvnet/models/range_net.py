"""Define the range-view network: a convolutional ResNet with recurrent layers (section 3.1)."""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from amvnet.config.schema import RangeNetConfig
from amvnet.models import layers
from amvnet.models.cpu_convolution import convolve
from amvnet.models.views.range_view import CHANNELS

FIRST_DECODED_STAGE = 1  # index of the first stage that the decoder uses; its width stride is 4
RECURRENT_STAGES = 2  # number of the last stages that a GRU follows

STEPS = 8  # number of channels of `surface_steps`
SMALL_STEP = 0.1  # metres; `surface_steps` is linear for smaller steps


class RangeNet(nn.Module):
    """The network that takes range images (B, 6, H, W) and returns logits (B, K, H, W)."""

    def __init__(self, config: RangeNetConfig, classes: int) -> None:
        super().__init__()
        c = config
        self.steps = c.steps
        channels = CHANNELS + STEPS if c.steps else CHANNELS
        self.input_norm = nn.BatchNorm2d(channels)
        self.stem = layers.ConvBlock(channels, c.stem)
        self.stem_blocks = nn.Sequential(*_blocks(c.stem, c.stem_blocks))
        self.stages = nn.ModuleList(_stages(c))

        self.recurrent = nn.ModuleList()
        if c.gru:
            self.recurrent.extend(
                layers.AzimuthGRU(w, c.gru_padding) for w in c.widths[-RECURRENT_STAGES:]
            )

        decoded = c.widths[FIRST_DECODED_STAGE:]
        self.lateral = nn.ModuleList(layers.ConvBlock(w, c.decoder, 1) for w in decoded)
        self.decoder = nn.ModuleList(layers.ConvBlock(c.decoder, c.decoder) for _ in decoded)
        self.drop = nn.Dropout2d(c.dropout)
        self.last = layers.ConvBlock(c.decoder + c.stem, c.head)
        self.scores = nn.Conv2d(c.head, classes, 1)

    def forward(self, image: Tensor) -> Tensor:
        # At 20 m, bfloat16 resolves a coordinate only to 0.1 m, which is too coarse to tell a hedge
        # from a wall.
        with torch.autocast(image.device.type, enabled=False):
            if self.steps:
                image = torch.cat([image, surface_steps(image)], dim=1)
            full = self.stem(self.input_norm(image))

        full = self.stem_blocks(full)  # (B, stem, H, W)
        maps = self.encode(full)
        decoded = self.decode(maps[FIRST_DECODED_STAGE:])  # (B, decoder, H, W / 4)
        x = layers.apply_to_joined(self.last, decoded, full)
        return convolve(x, self.scores.weight, self.scores.bias, stride=(1, 1), padding=(0, 0))

    def encode(self, x: Tensor) -> list[Tensor]:
        """Return the maps of all stages, whose width strides are 2, 4, 8, ...

        The last `RECURRENT_STAGES` maps are the outputs of the GRUs. x is (B, stem, H, W).
        """
        maps = []
        first_recurrent = len(self.stages) - len(self.recurrent)
        for index, stage in enumerate(self.stages):
            x = stage(x)
            if index >= first_recurrent:
                x = self.recurrent[index - first_recurrent](x)
            maps.append(x)

        return maps

    def decode(self, maps: list[Tensor]) -> Tensor:
        """Go from the coarsest map to the finest: upsample, add the lateral map, and convolve.

        Return the finest decoded map, (B, decoder, h, w).
        """
        decoded: Tensor | None = None
        for x, lateral, conv in reversed(list(zip(maps, self.lateral, self.decoder, strict=True))):
            side = lateral(x)
            if decoded is not None:
                side = side + layers.upsample(decoded, side)
            decoded = self.drop(conv(side))

        assert decoded is not None
        return decoded


def surface_steps(image: Tensor) -> Tensor:
    """Return how much farther and higher the four neighbours of each pixel are (not in the paper).

    A step of some centimetres tells a hedge from a wall, or a sidewalk from a road. In coordinates
    of up to 100 m it is small, so that a network learns it slowly. Steps here have the unit 0.1 m,
    and large steps are compressed: asinh(step / 0.1 m).

    Args:
        image: (B, 6, H, W), the channels of `RangeImage`.

    Returns:
        (B, 8, H, W): the step of the horizontal distance and the step of the height, to the left,
        right, upper and lower neighbour. A step from or to a pixel without a point is 0.
    """
    x, y, z, _, _, mask = image.split(1, dim=1)
    surface = torch.cat([(x * x + y * y).sqrt(), z, mask], dim=1)

    # The left and right ends of the image meet. Above and below it, there are no points.
    ring = layers.wrap_width(surface, 1, 1)
    across = _steps(ring[..., :-1], ring[..., 1:])  # (B, 2, H, W + 1)
    column = F.pad(surface, (0, 0, 1, 1))
    down = _steps(column[..., :-1, :], column[..., 1:, :])  # (B, 2, H + 1, W)

    # The step to a neighbour is the neighbour's step back, with the other sign.
    steps = [-across[..., :-1], across[..., 1:], -down[..., :-1, :], down[..., 1:, :]]
    return torch.cat(steps, dim=1)


def _steps(start: Tensor, end: Tensor) -> Tensor:
    """Return the steps between pixels (distance, height, mask), 0 where one has no point."""
    step = torch.asinh((end[:, :2] - start[:, :2]) / SMALL_STEP)
    return step * (start[:, 2:] * end[:, 2:])


def _stages(c: RangeNetConfig) -> list[nn.Module]:
    stages: list[nn.Module] = []
    channels = c.stem
    for width, blocks, stride in zip(c.widths, c.blocks, c.height_strides, strict=True):
        first = layers.ResidualBlock(channels, width, (stride, 2))
        stages.append(nn.Sequential(first, *_blocks(width, blocks - 1)))
        channels = width

    return stages


def _blocks(channels: int, count: int) -> list[layers.ResidualBlock]:
    return [layers.ResidualBlock(channels, channels) for _ in range(count)]
