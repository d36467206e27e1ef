"""Classify uncertain points from their neighbourhood: the point head (section 3.3)."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from amvnet.config.schema import PointHeadConfig
from amvnet.models.layers import ROWS, PointLinear
from amvnet.models.neighbours import nearest_others
from amvnet.models.neighbours_gpu import nearest_others_by_blocks
from amvnet.models.views.points import concatenate, occurring
from amvnet.runtime.threads import run_parts

POINT_VALUES = 4  # number of a point's own values: x, y, z, intensity
MIN_PRODUCT = 1e-24  # lower bound of f * g, so that its logarithm is finite
CUBES = 2**21 - 1  # largest number of a cube along an axis
# Number of uncertain points encoded at a time on a CPU: they fit its cache, and the rows of their
# neighbours need no padding.
PART_ON_CPU = ROWS
PART_ON_GPU = 2**16  # number of uncertain points encoded at a time on a GPU, which keep it busy
POINTS_AT_ONCE = 2**17  # number of uncertain points classified at a time, which limits the memory


class PointHead(nn.Module):
    """The network that classifies uncertain points.

    Its inputs are p_i (U, 2 K + 4), the features of U uncertain points, and S_i (U, n, 2 K + 4),
    one row for each of the n neighbours of each point; `head_features` returns both. Its outputs
    are logits (U, K). If `config.share` is below 1, the logits in evaluation mode are the weighted
    geometric mean of the head's own scores and the ensemble of f_i and g_i.
    """

    def __init__(self, config: PointHeadConfig, classes: int) -> None:
        super().__init__()
        self.config = config
        self.classes = classes

        width = 2 * classes + POINT_VALUES
        # `_pool` applies the last ReLU of the shared MLP.
        self.mlp = nn.Sequential(*_layers((width, *config.hidden))[:-1])
        self.fc = nn.Sequential(
            nn.Sequential(*_layers((width + config.hidden[-1], config.fc))),
            PointLinear(config.fc, classes),
        )

    def forward(self, point: Tensor, rows: Tensor) -> Tensor:
        u, n, width = rows.shape
        encoded = self.mlp(rows.reshape(u * n, width)).view(u, n, self.config.hidden[-1])
        return self._logits(_pool(encoded), point)

    def classify(self, points: Tensor, f: Tensor, g: Tensor, index: Tensor, near: Tensor) -> Tensor:
        """Return (U, K) class probabilities of the points `index` (U,) of one scan (P, 4).

        All its points have the probabilities f and g (P, K); `near` (U, n) holds indices of
        neighbours.
        """
        h = f.new_empty(len(index), f.shape[1])
        for part in sectors(points, index):
            table, (i, k) = used_points_table(points, f, g, index[part], near[part])
            h[part] = self.score(table, i, k).softmax(dim=1)
        return h

    def score(self, table: Tensor, uncertain: Tensor, near: Tensor) -> Tensor:
        """Return the logits (U, K), as `forward(*head_features(...))` does, but faster.

        The first layer W is linear: W [f_k, g_k, x_k - x_i] = W [f_k, g_k, x_k] - W [0, 0, x_i]. So
        it is computed once for each point, not once for each neighbour of each point.
        """
        first = self.mlp[0]
        rest = self.mlp[1:]
        assert isinstance(first, nn.Linear)

        encoded = first(table)  # W [f_k, g_k, x_k] of every point, (P, hidden[0])
        point = table.index_select(0, uncertain)
        shift = F.linear(point[:, -POINT_VALUES:], first.weight[:, -POINT_VALUES:])

        def pool_part(part: tuple[Tensor, Tensor]) -> Tensor:
            k, shift = part
            rows = encoded.index_select(0, k.flatten()).unflatten(0, k.shape)
            rows = rows.sub_(shift[:, None])  # (part, n, hidden[0])
            return _pool(rest(rows.flatten(0, 1)).unflatten(0, k.shape))

        size = PART_ON_CPU if table.is_cpu else PART_ON_GPU
        parts = list(zip(near.split(size), shift.split(size), strict=True))
        pooled = run_parts(pool_part, parts) if table.is_cpu else list(map(pool_part, parts))

        point[:, -POINT_VALUES:-1].mul_(self.config.position_scale)
        return self._logits(concatenate(pooled), point)

    def _logits(self, pooled: Tensor, point: Tensor) -> Tensor:
        """Return the logits (U, K), given the pooled neighbours (U, C) and p_i (U, 2 K + 4)."""
        logits: Tensor = self.fc(torch.cat([pooled, point], dim=1))
        share = self.config.share
        if share == 1 or self.training:
            return logits

        f, g, _ = point.split([self.classes, self.classes, POINT_VALUES], dim=1)
        squared_ensemble = (f * g).clamp_min(MIN_PRODUCT)
        return torch.add(share * logits, squared_ensemble.log(), alpha=(1 - share) / 2)


def _pool(rows: Tensor) -> Tensor:
    """Apply the last ReLU and return the maximum over the neighbours: (U, n, C) -> (U, C)."""
    # ReLU is monotonic, so the maximum may come first. ReLU then has one n-th of the work.
    return F.relu(rows.amax(dim=1))


def point_table(points: Tensor, f: Tensor, g: Tensor) -> Tensor:
    """Return [f, g, x] (P, 2 K + 4) for points x (P, 4) and class probabilities f, g (P, K)."""
    return torch.cat([f, g, points], dim=1)


def sectors(points: Tensor, index: Tensor) -> list[Tensor | slice]:
    """Return the places in `index` of parts of some points, at most `POINTS_AT_ONCE` in each.

    Points of similar azimuth share neighbours, so that the points of a part have few neighbours
    together.
    """
    if len(index) <= POINTS_AT_ONCE:
        return [slice(None)]

    azimuth = torch.atan2(points[index, 1], points[index, 0])
    return list(azimuth.argsort().split(POINTS_AT_ONCE))


def used_points_table(
    points: Tensor, f: Tensor, g: Tensor, *indices: Tensor
) -> tuple[Tensor, Sequence[Tensor]]:
    """Return the `point_table` of the points whose indices occur in any of the tensors `indices`.

    On a GPU, the table has all points: to select points, the CPU would have to wait for their
    number.

    Returns:
        The table, and the tensors `indices` as indices into the table.
    """
    if not points.is_cpu:
        return point_table(points, f, g), indices

    used, places = occurring(len(points), *indices)
    points, f, g = (values.index_select(0, used) for values in (points, f, g))
    return point_table(points, f, g), places


def head_features(
    config: PointHeadConfig, table: Tensor, uncertain: Tensor, near: Tensor
) -> tuple[Tensor, Tensor]:
    """Return the inputs p_i (U, 2 K + 4) and S_i (U, n, 2 K + 4) of the point head.

    p_i is [f_i, g_i, x_i], with the position in x_i scaled by `config.position_scale`. S_i has the
    rows [f_k, g_k, x_k - x_i] of the neighbours k.

    Args:
        table: (P, 2 K + 4), the `point_table` of one scan.
        uncertain: (U,) indices of the uncertain points.
        near: (U, n) indices of their nearest neighbours.
    """
    point = table[uncertain]
    rows = table[near]
    rows[..., -POINT_VALUES:] -= point[:, None, -POINT_VALUES:]
    point[:, -POINT_VALUES:-1] *= config.position_scale
    return point, rows


def first_in_cubes(points: Tensor, index: Tensor, edge: float) -> tuple[Tensor, Tensor]:
    """Return the first of some points of a scan in each cube of space that has any.

    Args:
        points: (P, 4), the points of the scan.
        index: (U,) indices of the chosen points, ascending.
        edge: the edge of a cube, metres; with 0, each point has a cube of its own.

    Returns:
        (V,) indices of the first points, and (U,) the place of each point's cube among them.
    """
    if not edge:
        return index, torch.arange(len(index), device=index.device)

    x, y, z = (points[index, :3].double() / edge).floor().long().unbind(1)
    # Cubes with one number are 2^21 edges apart.
    numbers = (x & CUBES) << 42 | (y & CUBES) << 21 | (z & CUBES)
    occupied, cube = numbers.unique(return_inverse=True)
    first = index.new_full((len(occupied),), len(points)).scatter_reduce_(0, cube, index, "amin")
    return first, cube


def nearest_neighbours(points: Tensor, index: Tensor, n: int) -> Tensor:
    """Return indices (U, n) of the nearest others of the points `index` (U,) of a scan (P, 4)."""
    if points.is_cuda:
        return nearest_others_by_blocks(points[:, :3], index, n)

    nearest = nearest_others(points[:, :3].cpu().numpy(), index.cpu().numpy(), n)
    return torch.from_numpy(nearest).to(points.device)


def _layers(widths: tuple[int, ...]) -> list[nn.Module]:
    layers: list[nn.Module] = []
    for inputs, outputs in pairwise(widths):
        layers += [PointLinear(inputs, outputs), nn.BatchNorm1d(outputs), nn.ReLU(inplace=True)]
    return layers
