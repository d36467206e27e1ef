"""The range view: a scan as an image of what the sensor saw, row by laser, column by azimuth."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from amvnet.config.schema import RangeViewConfig
from amvnet.errors import InputError
from amvnet.models.views.points import PointBatch

CHANNELS = 6  # x, y, z, intensity, range, mask
_INDEX_BITS = 32  # the lower half of a key of _nearest is a point's index, the upper half its range


@dataclass(frozen=True)
class RangeImage:
    """A batch of range images and the way back to the points.

    Attributes:
        image: (B, 6, H, W) float32: x, y, z, intensity, range, mask (1 where a point fell, else all are 0).
        pixel: (P,) int64: each point's pixel, an index into the B * H * W pixels of the batch.
        nearest: (B * H * W,) int64: the point that represents a pixel, -1 where none fell.
    """

    image: Tensor
    pixel: Tensor
    nearest: Tensor

    def to_points(self, scores: Tensor) -> Tensor:
        """Scores (B, K, H, W) of the pixels -> (P, K), every point its pixel's."""
        return scores.permute(0, 2, 3, 1).flatten(0, 2).index_select(0, self.pixel)


class RangeView:
    """Projects scans to range images (section 3.1 of the paper)."""

    def __init__(self, config: RangeViewConfig) -> None:
        self.config = config

    def project(self, batch: PointBatch) -> RangeImage:
        """The range images of a batch of scans.

        Every point has a pixel; one outside the field of view takes the first or last row. Of several
        points in a pixel the one nearest to the sensor represents it (the first of them, if as near).

        Raises:
            InputError: where rows are lasers and the scan has no ring index, or one out of range.
        """
        c = self.config
        distance = batch.points[:, :3].norm(dim=1)
        pixel = (batch.scan * c.height + self.rows(batch)) * c.width + self.columns(batch)
        nearest = _nearest(distance, pixel, batch.count * c.height * c.width)
        values = torch.cat(
            [batch.points, distance[:, None], torch.ones_like(distance)[:, None]], dim=1
        )
        padded = torch.cat([values, values.new_zeros(1, CHANNELS)])
        image = padded.index_select(0, nearest % len(padded))  # -1, no point, is the last row
        return RangeImage(
            image.view(batch.count, c.height, c.width, CHANNELS).permute(0, 3, 1, 2), pixel, nearest
        )

    def columns(self, batch: PointBatch) -> Tensor:
        """(P,) column by azimuth: forward (+x) is the middle, left (+y) is left of it."""
        # In double precision, so that a point at a pixel's border falls the same way on every device.
        x, y = batch.points[:, 0].double(), batch.points[:, 1].double()
        return _cell(0.5 - torch.atan2(y, x) / (2 * math.pi), self.config.width)

    def rows(self, batch: PointBatch) -> Tensor:
        """(P,) row, 0 at the top: by elevation, or by laser."""
        if self.config.rows == "ring":
            return self._rows_by_ring(batch.ring)
        x, y, z = batch.points[:, :3].double().unbind(1)
        elevation = torch.rad2deg(torch.atan2(z, torch.sqrt(x * x + y * y)))
        c = self.config
        return _cell((c.fov_up - elevation) / (c.fov_up - c.fov_down), c.height)

    def _rows_by_ring(self, ring: Tensor | None) -> Tensor:
        height = self.config.height
        if ring is None:
            raise InputError(
                "expected a scan with a ring index, found none; use a model with rows by elevation"
            )
        low, high = (
            torch.stack(ring.aminmax()).tolist() if len(ring) else (0, 0)
        )  # a GPU is asked once
        if not 0 <= low <= high < height:
            raise InputError(
                f"expected ring indices from 0 to {height - 1}, found {low} to {high}; use a model for this sensor"
            )
        return height - 1 - ring  # ring 0 is the lowest laser


def _cell(share: Tensor, cells: int) -> Tensor:
    """Which of `cells` equal parts of [0, 1] a number is in; the first or last one if outside."""
    return (share * cells).floor().long().clamp_(0, cells - 1)


def _nearest(distance: Tensor, pixel: Tensor, pixels: int) -> Tensor:
    """(pixels,) index of the point with the least distance in each pixel, -1 where there is none."""
    # The bits of floats >= 0 are ordered as the floats: one integer minimum finds distance and point at once.
    index = torch.arange(len(distance), device=distance.device)
    key = (distance.float().view(torch.int32).long() << _INDEX_BITS) | index
    empty = torch.iinfo(torch.int64).max
    least = torch.full((pixels,), empty, device=key.device).scatter_reduce_(0, pixel, key, "amin")
    return torch.where(least == empty, -1, least & ((1 << _INDEX_BITS) - 1))
