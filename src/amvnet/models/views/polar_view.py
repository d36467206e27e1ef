"""Project scans to the bird's-eye view: a polar grid of pillars, which are columns of voxels."""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from amvnet.config.schema import PolarViewConfig
from amvnet.models.views.points import PointBatch, occurring
from amvnet.runtime.threads import run_parts

# Number of features of a point: offset from the voxel's centre (3), polar coordinates (3), x, y,
# intensity.
FEATURES = 9


@dataclass(frozen=True)
class PolarGrid:
    """A batch of scans in the polar grid, and the mapping back to the points.

    Attributes:
        features: (S, 9) float32, the features of the S points that the networks see: offset from
            the voxel's centre (radius, angle, height), polar coordinates (radius, angle, height),
            x, y, intensity; metres and radians.
        voxel: (P,) int64: the voxel of each of the P points within its pillar; 0 is the lowest.
        occupied: (M,) int64: the pillars that hold points, ascending, as indices into the B * R * A
            pillars of the batch.
        slot: (P,) int64: each point's pillar as an index into `occupied`.
        seen: (F,) int64: the pillars with points that the networks see, ascending.
        seen_slot: (S,) int64: the pillar of each point that the networks see, as an index into
            `seen`.
        shape: (B, R, A, Z): scans, and cells along radius, angle and height.
    """

    features: Tensor
    voxel: Tensor
    occupied: Tensor
    slot: Tensor
    seen: Tensor
    seen_slot: Tensor
    shape: tuple[int, int, int, int]

    def pool(self, features: Tensor) -> Tensor:
        """Return the maximum (F, C) of the points' features (S, C) in each seen pillar."""
        if features.is_cpu and features.requires_grad and not torch.compiler.is_compiling():
            maximum: Tensor = _PillarMaximum.apply(  # type: ignore[no-untyped-call]
                features, self.seen_slot, len(self.seen)
            )
            return maximum
        return _pillar_maximum(features, self.seen_slot, len(self.seen))

    def pool_by_parts(self, encode: Callable[[Tensor], Tensor], part_size: int) -> Tensor:
        """Return `pool(encode(self.features))`, computed for `part_size` points at a time.

        The points of a small part stay in a CPU's cache. Use this only without gradients.
        """

        def pool_share(share: Sequence[tuple[Tensor, Tensor]]) -> Tensor:
            pooled = None
            for features, slot in share:
                encoded = encode(features)
                if pooled is None:  # -inf stays in pillars without a point of this share
                    pooled = encoded.new_full((len(self.seen), encoded.shape[1]), -torch.inf)
                pooled.scatter_reduce_(0, slot[:, None].expand_as(encoded), encoded, "amax")

            assert pooled is not None
            return pooled

        parts = list(
            zip(self.features.split(part_size), self.seen_slot.split(part_size), strict=True)
        )
        if not self.features.is_cpu:
            return pool_share(parts)

        # Every thread pools its share of the points.
        share_size = math.ceil(len(parts) / torch.get_num_threads())
        shares = [parts[first : first + share_size] for first in range(0, len(parts), share_size)]
        return functools.reduce(torch.maximum, run_parts(pool_share, shares))

    def to_map(self, values: Tensor) -> Tensor:
        """Return the map (B, C, R, A) of the values (F, C) of the seen pillars; 0 elsewhere."""
        b, r, a, _ = self.shape
        dense = values.new_zeros(b * r * a, values.shape[1]).index_copy(0, self.seen, values)
        return dense.view(b, r, a, -1).permute(0, 3, 1, 2)

    def at_pillars(self, maps: Tensor) -> Tensor:
        """Return the values (M, C) of maps (B, C, R, A) at the occupied pillars."""
        return maps.permute(0, 2, 3, 1).flatten(0, 2)[self.occupied]

    def to_points(self, scores: Tensor) -> Tensor:
        """Return the scores (P, K) of each point's voxel.

        Args:
            scores: (M, Z * K) logits or probabilities of the occupied pillars, voxel by voxel.
        """
        vertical = self.shape[3]
        voxels: Tensor = scores.unflatten(1, (vertical, scores.shape[1] // vertical)).flatten(0, 1)
        return voxels.index_select(0, self.slot * vertical + self.voxel)


def _pillar_maximum(features: Tensor, slot: Tensor, pillars: int) -> Tensor:
    """Return the maximum (F, C) of the points' features (S, C) in each of F pillars.

    `slot` (S,) is the pillar of each point.
    """
    zeros = features.new_zeros(pillars, features.shape[1])
    index = slot[:, None].expand_as(features)
    return zeros.scatter_reduce(0, index, features, "amax", include_self=False)


class _PillarMaximum(torch.autograd.Function):
    """`_pillar_maximum` whose gradient is computed faster on a CPU.

    In each channel, only the points with the maximum have a gradient. The backward pass that
    autograd derives reads all points several times, which took a third of a training step.
    """

    @staticmethod
    def forward(ctx: Any, features: Tensor, slot: Tensor, pillars: int) -> Tensor:
        pooled = _pillar_maximum(features, slot, pillars)
        ctx.save_for_backward(features, slot, pooled)
        return pooled

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor, None, None]:
        features, slot, pooled = ctx.saved_tensors
        channels = features.shape[1]

        # Find the places of the largest values in the flattened features and in the flattened
        # maxima.
        place = (features == pooled.index_select(0, slot)).flatten().nonzero()[:, 0]
        maximum = slot[place // channels] * channels + place % channels

        # If several values are equally large, they share the gradient.
        sharing = torch.bincount(maximum, minlength=pooled.numel())
        values = (grads[0].flatten() / sharing)[maximum]
        gradient = torch.zeros_like(features)
        gradient.view(-1)[place] = values.to(features.dtype)
        return gradient, None, None


class PolarView:
    """The projection of scans to the polar grid (section 3.1)."""

    def __init__(self, config: PolarViewConfig) -> None:
        self.config = config
        self._axes_on: dict[torch.device, tuple[Tensor, ...]] = {}

    def _axes(self, device: torch.device) -> tuple[Tensor, ...]:
        """Return the start, the length, the number of cells and the last cell of the axes.

        Each is (3, 1) float64, for the axes radius, angle and height.
        """
        if device not in self._axes_on:
            c = self.config
            low = torch.tensor([[c.radius_min], [-math.pi], [c.z_min]], dtype=torch.float64)
            high = torch.tensor([[c.radius_max], [math.pi], [c.z_max]], dtype=torch.float64)
            cells = torch.tensor([[c.radial], [c.angular], [c.vertical]], dtype=torch.float64)
            axes = (low, high - low, cells, cells - 1)
            self._axes_on[device] = tuple(axis.to(device) for axis in axes)
        return self._axes_on[device]

    def project(self, batch: PointBatch) -> PolarGrid:
        """Return the polar grids of a batch of scans.

        Points outside the grid go to its nearest cell. The networks do not see the points of the
        car's own body (`PolarViewConfig.nearest`), but these points have a voxel.
        """
        c = self.config

        # The axes are tensors because Python's numbers would be copied to a GPU each time.
        low, length, cells, last = self._axes(batch.points.device)
        polar = batch.cylindrical
        cell = (polar - low).div_(length).mul_(cells).floor_().clamp_min_(0).minimum(last)
        offset = polar - torch.addcdiv(low, (cell + 0.5).mul_(length), cells)
        radial_cell, angular_cell, voxel = cell.long()

        # Columns are selected by slices: a list of columns would have to be copied to a GPU.
        xy = batch.points[:, :2]
        intensity = batch.points[:, 3:]
        features = torch.cat([offset.T.to(xy.dtype), polar.T.to(xy.dtype), xy, intensity], dim=1)

        # pillar = (scan * radial + radial_cell) * angular + angular_cell
        row = radial_cell.add(batch.scan, alpha=c.radial)
        pillar = angular_cell.add(row, alpha=c.angular)
        pillars = batch.count * c.radial * c.angular
        occupied, (slot,) = occurring(pillars, pillar)
        seen = occupied
        seen_slot = slot
        if c.nearest > 0:
            # The CPU waits once for a GPU, to know the number of far points.
            far = (batch.points[:, :3].norm(dim=1) >= c.nearest).nonzero()[:, 0]
            features = features.index_select(0, far)
            seen, (seen_slot,) = occurring(pillars, pillar.index_select(0, far))

        return PolarGrid(
            features=features,
            voxel=voxel,
            occupied=occupied,
            slot=slot,
            seen=seen,
            seen_slot=seen_slot,
            shape=(batch.count, c.radial, c.angular, c.vertical),
        )
