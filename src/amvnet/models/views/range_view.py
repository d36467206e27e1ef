"""The range view: a scan as an image of lasers by azimuth."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import torch
from torch import Tensor
from torch.nn import functional as F

from amvnet.config.schema import RangeViewConfig
from amvnet.errors import InputError
from amvnet.models.views.points import PointBatch

CHANNELS = 6  # x, y, z, intensity, range, mask
_INDEX_BITS = 32  # of the 64 bits of a key in `_nearest`: a point's index; above them is its range


@dataclass(frozen=True)
class RangeImage:
    """A batch of range images, and the mapping back to the points.

    Attributes:
        image: (B, 6, H, W) float32: x, y, z, intensity, range, and a mask that is 1 if the pixel
            has a point. All values of a pixel without a point are 0.
        pixel: (P,) int64: each point's pixel, an index into the B * H * W pixels of the batch.
        nearest: (B * H * W,) int32: the point that represents each pixel, -1 if it has none.
    """

    image: Tensor
    pixel: Tensor
    nearest: Tensor

    def to_points(self, scores: Tensor) -> Tensor:
        """Return each point's scores (P, K): those of its pixel.

        Args:
            scores: (B, K, H, W) logits or probabilities.
        """
        return scores.permute(0, 2, 3, 1).flatten(0, 2).index_select(0, self.pixel)


class RangeView:
    """The projection of scans to range images (section 3.1)."""

    def __init__(self, config: RangeViewConfig) -> None:
        self.config = config

    def by_ring(self) -> RangeView:
        """Return the same view with the rings of the scans as rows, 0 the lowest."""
        return RangeView(replace(self.config, rows="ring"))

    def project(self, batch: PointBatch) -> RangeImage:
        """Return the range images of a batch of scans.

        Every point has a pixel; points above or below the field of view are in the first or the
        last row. A pixel with several points shows the nearest to the sensor; of equally near
        points, it shows the first. No pixel shows points of the car's own body
        (`RangeViewConfig.nearest`).

        Raises:
            InputError: if rows are lasers, and the scans have no ring indices or one is out of
                range.
        """
        c = self.config

        # The row of zeros at the end is for pixels without a point.
        values = F.pad(batch.points, (0, 2, 0, 1))  # (P + 1, 6)
        values[:-1, 5] = 1
        distance = torch.linalg.vector_norm(batch.points[:, :3], dim=1, out=values[:-1, 4])

        row = self.rows(batch).add(batch.scan, alpha=c.height)
        pixel = self.columns(batch).add(row, alpha=c.width)
        nearest = _nearest(distance, pixel, batch.count * c.height * c.width, c.nearest)

        image = values[nearest]  # -1 selects the last row
        image = image.view(batch.count, c.height, c.width, CHANNELS).permute(0, 3, 1, 2)
        return RangeImage(image, pixel, nearest)

    def columns(self, batch: PointBatch) -> Tensor:
        """Return the (P,) columns by azimuth: front (+x) in the middle, left (+y) to its left."""
        azimuth = batch.cylindrical[1]
        return _cells(0.5 - azimuth / (2 * math.pi), self.config.width)

    def rows(self, batch: PointBatch) -> Tensor:
        """Return the (P,) rows by elevation or by laser; 0 is the top."""
        if self.config.rows == "ring":
            return self._rows_by_ring(batch.ring)

        radius, _, height = batch.cylindrical
        elevation = torch.rad2deg(torch.atan2(height, radius))
        c = self.config
        return _cells((c.fov_up - elevation) / (c.fov_up - c.fov_down), c.height)

    def _rows_by_ring(self, ring: Tensor | None) -> Tensor:
        height = self.config.height
        if ring is None:
            raise InputError(
                "expected a scan with a ring index, found none; use a model with rows by elevation"
            )

        # Both bounds at once, so that the CPU waits for a GPU only once.
        low, high = torch.stack(ring.aminmax()).tolist() if len(ring) else (0, 0)
        if not 0 <= low <= high < height:
            raise InputError(
                f"expected ring indices from 0 to {height - 1}, found {low} to {high}; "
                "use a model for this sensor"
            )
        return height - 1 - ring  # ring 0 is the lowest laser


def _cells(fractions: Tensor, cells: int) -> Tensor:
    """Divide [0, 1] into equal cells, and return the cell of each number, (P,) int64.

    Numbers outside [0, 1] go to the nearest cell.
    """
    return (fractions * cells).long().clamp_(0, cells - 1)


def _nearest(distance: Tensor, pixel: Tensor, pixels: int, least: float) -> Tensor:
    """Return the (pixels,) int32 index of the nearest point in each pixel, -1 if it has none.

    The points have a distance and a pixel, (P,); those nearer than `least` metres do not count.
    """
    # The bits of floats >= 0 sort as the floats do, so one integer minimum finds both the least
    # distance and its point.
    index = torch.arange(len(distance), device=distance.device)
    key = index.add(distance.float().view(torch.int32), alpha=1 << _INDEX_BITS)

    empty = torch.iinfo(torch.int64).max  # its lower half is -1
    if least > 0:
        key = torch.where(distance < least, empty, key)
    keys = torch.full((pixels,), empty, device=key.device).scatter_reduce_(0, pixel, key, "amin")
    return keys.view(torch.int32)[::2]  # the lower halves
