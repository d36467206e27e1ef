"""The bird's-eye view: a scan in a polar grid of pillars, each a column of voxels."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from amvnet.config.schema import PolarViewConfig
from amvnet.models.views.points import PointBatch, occurring

FEATURES = 9  # offset to the voxel's centre (3), polar coordinates (3), x, y, intensity


@dataclass(frozen=True)
class PolarGrid:
    """A batch of scans in the polar grid, and the way back to the points.

    Attributes:
        features: (P, 9) float32: offset to the voxel's centre (radius, angle, height), polar
            coordinates (metres, radians, metres), x, y, intensity.
        pillar: (P,) int64: each point's pillar, an index into the B * R * A pillars of the batch.
        voxel: (P,) int64: each point's voxel within its pillar, 0 the lowest.
        occupied: (M,) int64: the pillars that hold points, ascending.
        slot: (P,) int64: the place of each point's pillar in `occupied`.
        shape: (B, R, A, Z): scans, cells along radius, angle and height.
    """

    features: Tensor
    pillar: Tensor
    voxel: Tensor
    occupied: Tensor
    slot: Tensor
    shape: tuple[int, int, int, int]

    def pool(self, features: Tensor) -> Tensor:
        """Features (P, C) of the points -> (M, C), the maximum over each occupied pillar."""
        index = self.slot[:, None].expand_as(features)
        empty = features.new_zeros(len(self.occupied), features.shape[1])
        return empty.scatter_reduce(0, index, features, "amax", include_self=False)

    def pool_by_parts(self, encode: Callable[[Tensor], Tensor], part: int) -> Tensor:
        """`pool(encode(features))` of so many points at a time, which stay in a processor's cache; no gradients."""
        pooled = None
        for features, slot in zip(self.features.split(part), self.slot.split(part), strict=True):
            encoded = encode(features)
            if pooled is None:
                pooled = encoded.new_full((len(self.occupied), encoded.shape[1]), -torch.inf)
            pooled.scatter_reduce_(0, slot[:, None].expand_as(encoded), encoded, "amax")
        assert pooled is not None
        return pooled

    def to_map(self, pillars: Tensor) -> Tensor:
        """Features (M, C) of the occupied pillars -> a map (B, C, R, A), 0 where a pillar is empty."""
        b, r, a, _ = self.shape
        dense = pillars.new_zeros(b * r * a, pillars.shape[1]).index_copy(0, self.occupied, pillars)
        return dense.view(b, r, a, -1).permute(0, 3, 1, 2)

    def at_pillars(self, maps: Tensor) -> Tensor:
        """A map (B, C, R, A) -> (M, C) of the occupied pillars."""
        return maps.permute(0, 2, 3, 1).flatten(0, 2)[self.occupied]

    def to_points(self, scores: Tensor) -> Tensor:
        """Scores (M, Z * K) of the occupied pillars, voxel by voxel -> (P, K), every point its voxel's."""
        vertical = self.shape[3]
        voxels = scores.unflatten(1, (vertical, scores.shape[1] // vertical)).flatten(0, 1)
        return voxels.index_select(0, self.slot * vertical + self.voxel)


class PolarView:
    """Sorts the points of scans into the polar grid (section 3.1 of the paper)."""

    def __init__(self, config: PolarViewConfig) -> None:
        self.config = config
        self._low = (config.radius_min, -math.pi, config.z_min)
        self._high = (config.radius_max, math.pi, config.z_max)
        self._cells = (config.radial, config.angular, config.vertical)

    def project(self, batch: PointBatch) -> PolarGrid:
        """The polar grids of a batch of scans. Points outside the grid go to the nearest cell."""
        x, y, z = batch.points[:, :3].double().unbind(1)
        # In double precision, so that a point at a cell's border falls the same way on every device.
        polar = (torch.sqrt(x * x + y * y), torch.atan2(y, x), z)
        placed = [
            _place(*axis) for axis in zip(polar, self._low, self._high, self._cells, strict=True)
        ]
        radius, angle, voxel = (cell for cell, _ in placed)
        features = torch.stack([*(offset for _, offset in placed), *polar], dim=1).to(
            batch.points.dtype
        )
        c = self.config
        pillar = (batch.scan * c.radial + radius) * c.angular + angle
        shape = (batch.count, c.radial, c.angular, c.vertical)
        occupied, (slot,) = occurring(math.prod(shape[:3]), pillar)
        features = torch.cat([features, batch.points[:, [0, 1, 3]]], dim=1)
        return PolarGrid(features, pillar, voxel, occupied, slot, shape)


def _place(values: Tensor, low: float, high: float, cells: int) -> tuple[Tensor, Tensor]:
    """Along one axis the cell of each value (P,), int64, and how far the value is from its centre."""
    cell = ((values - low) / (high - low) * cells).floor().clamp(0, cells - 1)
    return cell.long(), values - (low + (cell + 0.5) * (high - low) / cells)
