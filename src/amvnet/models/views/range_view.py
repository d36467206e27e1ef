"""Project scans to the range view: images with lasers as rows and azimuths as columns."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn import functional as F

from amvnet.config.schema import RangeViewConfig
from amvnet.errors import InputError
from amvnet.models.views.points import PointBatch

CHANNELS = 6  # number of channels of a range image: x, y, z, intensity, range, mask
WINDOW = 5  # height and width of the window around a point's pixel, pixels; odd
# The weight of a hidden point's own pixel, which decides if no pixel around it shows its range.
OWN_WEIGHT = 1e-3
# Number of lower bits in a key of `_nearest` that hold a point's index; the upper bits hold the
# range of the point.
_INDEX_BITS = 32


@dataclass(frozen=True)
class RangeImage:
    """A batch of range images, and the mapping back to the points.

    Attributes:
        image: (B, 6, H, W) float32: x, y, z, intensity, range, and a mask that is 1 if the pixel
            has a point. All values of a pixel without a point are 0.
        pixel: (P,) int64: each point's pixel, an index into the B * H * W pixels of the batch.
        nearest: (B * H * W,) int32: the index of the point that each pixel shows; -1 for no point.
        distance: (P,) the range of each point, metres.
        hidden: the difference of range above which a point is hidden (`RangeViewConfig.hidden`).
    """

    image: Tensor
    pixel: Tensor
    nearest: Tensor
    distance: Tensor
    hidden: float = 0.0

    def to_points(self, scores: Tensor) -> Tensor:
        """Return the scores (P, K) of the points: those of their pixels.

        A hidden point lies behind the point that its pixel shows, such as a wall behind a pole, so
        that these scores say nothing about it. It gets the mean scores of the pixels in a window
        around it. A pixel that shows a point d metres nearer or farther than the hidden point has
        the weight exp(-(d / hidden)^2).

        Args:
            scores: (B, K, H, W) probabilities.
        """
        scores_by_pixel = scores.permute(0, 2, 3, 1).flatten(0, 2)
        own = scores_by_pixel.index_select(0, self.pixel)
        if not self.hidden:
            return own

        shown = self.image[:, 4].flatten()
        has_point = self.nearest >= 0
        difference = (shown.index_select(0, self.pixel) - self.distance).abs()
        is_hidden = has_point.index_select(0, self.pixel) & (difference > self.hidden)
        index = is_hidden.nonzero()[:, 0]  # (N,)

        pixels, is_outside = self.windows(self.pixel.index_select(0, index))  # (N, S * S)

        # `index_select` is faster than an index.
        flat = pixels.flatten()
        distance = self.distance.index_select(0, index)[:, None]
        difference = shown.index_select(0, flat).view(pixels.shape) - distance
        counts = has_point.index_select(0, flat).view(pixels.shape) & ~is_outside
        weights = torch.exp(-((difference / self.hidden) ** 2)).where(counts, 0)

        near = scores_by_pixel.index_select(0, flat)
        near = near.view(*pixels.shape, own.shape[1])  # (N, S * S, K)
        around = torch.bmm(weights[:, None], near)[:, 0]
        around = around.add_(own.index_select(0, index), alpha=OWN_WEIGHT)
        total = weights.sum(dim=1, keepdim=True).add_(OWN_WEIGHT)
        return own.index_copy_(0, index, around / total)

    def windows(self, pixel: Tensor) -> tuple[Tensor, Tensor]:
        """Return the pixels around some pixels (N,), row by row.

        At the left and right borders, a window continues at the other end of the image.

        Returns:
            (N, S * S) indices into the B * H * W pixels of the batch, for windows of S x S pixels;
            and (N, S * S) bool: whether a pixel would lie above or below the image, so that it does
            not count.
        """
        _, _, height, width = self.image.shape
        offsets = torch.arange(WINDOW, device=pixel.device) - WINDOW // 2
        rows = (pixel // width)[:, None] + offsets  # rows counted over all images, (N, S)
        columns = ((pixel % width)[:, None] + offsets) % width
        is_outside = rows // height != (pixel // (width * height))[:, None]

        rows = rows.where(~is_outside, 0)
        pixels = rows[:, :, None] * width + columns[:, None]
        return pixels.flatten(1), is_outside.repeat_interleave(WINDOW, dim=1)


class RangeView:
    """The projection of scans to range images (section 3.1)."""

    def __init__(self, config: RangeViewConfig) -> None:
        self.config = config

    def project(self, batch: PointBatch) -> RangeImage:
        """Return the range images of a batch of scans.

        Every point has a pixel. Points above the field of view are in the first row, and points
        below it are in the last row. A pixel with several points shows the point that is nearest to
        the sensor; if several points are equally near, it shows the first of them. No pixel shows
        points of the car's own body (`RangeViewConfig.nearest`).

        Raises:
            InputError: if `rows` raises it.
        """
        c = self.config

        # Pixels without a point take the row of zeros at the end.
        values = F.pad(batch.points, (0, 2, 0, 1))  # (P + 1, 6)
        values[:-1, 5] = 1
        distance = torch.linalg.vector_norm(batch.points[:, :3], dim=1, out=values[:-1, 4])

        row = self.rows(batch).add(batch.scan, alpha=c.height)
        pixel = self.columns(batch).add(row, alpha=c.width)
        nearest = _nearest(distance, pixel, batch.count * c.height * c.width, c.nearest)

        image = values[nearest]  # -1 selects the last row
        image = image.view(batch.count, c.height, c.width, CHANNELS).permute(0, 3, 1, 2)
        return RangeImage(image, pixel, nearest, distance, c.hidden)

    def columns(self, batch: PointBatch) -> Tensor:
        """Return the columns (P,) of the points by their azimuth.

        The front (+x) is in the middle of the image, and the left (+y) is in its left half.
        """
        azimuth = batch.cylindrical[1]
        return _cells(0.5 - azimuth / (2 * math.pi), self.config.width)

    def rows(self, batch: PointBatch) -> Tensor:
        """Return the rows (P,) of the points; 0 is the top.

        A scan's own rows (`Scan.row`) take precedence over the configured rows.

        Raises:
            InputError: if a row is out of range. If rows are configured to be rings, also if a scan
                without rows has no ring indices, or a ring index is out of range.
        """
        if batch.row is None:
            return self._configured_rows(batch)

        lowest, highest = _range_of(batch.row)
        if highest >= self.config.height:
            raise InputError(
                f"expected rows from 0 to {self.config.height - 1}, found {highest}; "
                "normalise the scan for these weights"
            )
        if lowest >= 0:
            return batch.row

        is_unknown = batch.row < 0
        return torch.where(is_unknown, self._configured_rows(batch, is_unknown), batch.row)

    def _configured_rows(self, batch: PointBatch, which: Tensor | None = None) -> Tensor:
        """Return the rows (P,) by `RangeViewConfig.rows`; `which` (P,) says which are needed."""
        if self.config.rows == "ring":
            return self._rows_by_ring(batch.ring, which)

        rows = self._rows_by_elevation(batch)
        if self.config.rows == "laser" and batch.ring is not None:
            is_known = self._have_lasers(batch.ring, batch)[batch.scan] & (batch.ring >= 0)
            rows = torch.where(is_known, self.config.height - 1 - batch.ring, rows)
        return rows

    def _rows_by_elevation(self, batch: PointBatch) -> Tensor:
        radius, _, height = batch.cylindrical
        elevation = torch.rad2deg(torch.atan2(height, radius))
        c = self.config
        return _cells((c.fov_up - elevation) / (c.fov_up - c.fov_down), c.height)

    def _rows_by_ring(self, ring: Tensor | None, which: Tensor | None) -> Tensor:
        height = self.config.height
        lowest, highest = (-1, -1) if ring is None else _range_of(ring, which)
        if ring is None or lowest < 0:
            raise InputError(
                "expected a scan with a ring index, found none; use a model with rows by elevation"
            )

        if highest >= height:
            raise InputError(
                f"expected ring indices from 0 to {height - 1}, found {lowest} to {highest}; "
                "use a model for this sensor"
            )
        return height - 1 - ring  # ring 0 is the lowest laser

    def _have_lasers(self, ring: Tensor, batch: PointBatch) -> Tensor:
        """Return (B,) bool: the scans of a sensor that has one laser for each row of the image."""
        highest = ring.new_full((batch.count,), -1).scatter_reduce_(0, batch.scan, ring, "amax")
        have_lasers: Tensor = self.config.has_laser_per_row(highest)
        return have_lasers


def _range_of(values: Tensor, which: Tensor | None = None) -> tuple[int, int]:
    """Return the smallest and the largest of some integers; 0 and 0 if there are none."""
    chosen = values if which is None else values[which]
    if not len(chosen):
        return 0, 0
    # One copy of both numbers makes the CPU wait for a GPU only once.
    lowest, highest = torch.stack(chosen.aminmax()).tolist()
    return lowest, highest


def _cells(fractions: Tensor, cells: int) -> Tensor:
    """Divide [0, 1] into equal cells, and return the cell of each of P numbers: (P,) int64.

    A number outside [0, 1] goes to the nearest cell.
    """
    return (fractions * cells).long().clamp_(0, cells - 1)


def _nearest(distance: Tensor, pixel: Tensor, pixels: int, least: float) -> Tensor:
    """Return the index of the nearest point in each pixel: (pixels,) int32, -1 for no point.

    Points (P,) nearer than `least` metres do not count.
    """
    # The bits of floats >= 0 have the order of the floats. So if integers hold a distance in their
    # upper half and an index in their lower half, their minimum gives the nearest point.
    index = torch.arange(len(distance), device=distance.device)
    key = index.add(distance.float().view(torch.int32), alpha=1 << _INDEX_BITS)

    empty = torch.iinfo(torch.int64).max  # its lower half is -1
    if least > 0:
        key = torch.where(distance < least, empty, key)
    keys = torch.full((pixels,), empty, device=key.device).scatter_reduce_(0, pixel, key, "amin")
    return keys.view(torch.int32)[::2]  # the lower halves
