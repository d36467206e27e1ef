"""The point head: classifies uncertain points from their neighbourhood (section 3.3)."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from amvnet.config.schema import PointHeadConfig
from amvnet.models.layers import PointLinear
from amvnet.models.neighbours import nearest_others
from amvnet.models.neighbours_gpu import nearest_others_by_blocks
from amvnet.models.views.points import concatenate, occurring
from amvnet.runtime.threads import run_parts

POINT_VALUES = 4  # x, y, z, intensity
LEAST = 1e-24  # product of two probabilities whose logarithm is still taken
PART = 1024  # uncertain points encoded at a time, so that they fit into a CPU's cache
PART_ON_GPU = 2**16  # the same for a GPU: enough to keep it busy
AT_ONCE = 2**17  # uncertain points whose table is in memory: a scan may have millions of them


class PointHead(nn.Module):
    """The network that classifies uncertain points.

    Its inputs are the features p_i (U, 2 K + 4) of U uncertain points and the rows S_i
    (U, n, 2 K + 4) of their n neighbours each, as `head_features` returns them. Its outputs are
    logits (U, K). In evaluation mode they are those of the weighted geometric mean with the
    ensemble of f_i and g_i, if `config.share` is below 1.
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
        return self._classify(_pool(encoded), point)

    def settle(self, points: Tensor, f: Tensor, g: Tensor, index: Tensor, near: Tensor) -> Tensor:
        """Return (U, K) class probabilities of some points of one scan.

        Args:
            points: (P, 4), all points of the scan, with f and g, (P, K).
            index: (U,) indices of the points to classify.
            near: (U, n) indices of their neighbours.
        """
        h = f.new_empty(len(index), f.shape[1])
        for part in sectors(points, index):
            table, (i, k) = used_points_table(points, f, g, index[part], near[part])
            h[part] = self.score(table, i, k).softmax(dim=1)
        return h

    def score(self, table: Tensor, uncertain: Tensor, near: Tensor) -> Tensor:
        """Return the (U, K) logits of `forward(*head_features(...))`, at less cost.

        The first layer is computed once for each point instead of once for each neighbour:
        W [f_k, g_k, x_k - x_i] = W [f_k, g_k, x_k] - W [0, 0, x_i].

        Args:
            table: (P, 2 K + 4) of one scan, from `point_table`.
            uncertain: (U,) indices of the uncertain points.
            near: (U, n) indices of their nearest neighbours.
        """
        first = self.mlp[0]
        rest = self.mlp[1:]
        assert isinstance(first, nn.Linear)

        encoded = first(table)  # (P, hidden[0]): W [f_k, g_k, x_k] of every point
        point = table.index_select(0, uncertain)
        shift = F.linear(point[:, -POINT_VALUES:], first.weight[:, -POINT_VALUES:])

        def pool_part(part: tuple[Tensor, Tensor]) -> Tensor:
            k, shift = part
            rows = encoded.index_select(0, k.flatten()).unflatten(0, k.shape)
            rows = rows.sub_(shift[:, None])  # (part, n, hidden[0])
            return _pool(rest(rows.flatten(0, 1)).unflatten(0, k.shape))

        size = PART if table.is_cpu else PART_ON_GPU
        parts = list(zip(near.split(size), shift.split(size), strict=True))
        pooled = run_parts(pool_part, parts) if table.is_cpu else list(map(pool_part, parts))

        point[:, -POINT_VALUES:-1].mul_(self.config.position_scale)
        return self._classify(concatenate(pooled), point)

    def _classify(self, pooled: Tensor, point: Tensor) -> Tensor:
        """Return the (U, K) logits."""
        logits = self.fc(torch.cat([pooled, point], dim=1))
        share = self.config.share
        if share == 1 or self.training:
            return logits

        f, g, _ = point.split([self.classes, self.classes, POINT_VALUES], dim=1)
        squared_ensemble = (f * g).clamp_min(LEAST)
        return torch.add(share * logits, squared_ensemble.log(), alpha=(1 - share) / 2)


def _pool(rows: Tensor) -> Tensor:
    """Return the (U, C) maximum over the n neighbours, given (U, n, C) before the last ReLU."""
    # ReLU is monotonic: after the maximum it gives the same for a fraction of the work.
    return F.relu(rows.amax(dim=1))


def point_table(points: Tensor, f: Tensor, g: Tensor) -> Tensor:
    """Return [f, g, x] of points x (P, 4) with class probabilities f, g (P, K): (P, 2 K + 4)."""
    return torch.cat([f, g, points], dim=1)


def sectors(points: Tensor, index: Tensor) -> list[Tensor | slice]:
    """Divide the points `index` (U,) of a scan's points (P, 4) by their azimuth.

    Each part and its neighbours are then few points.

    Returns:
        Places in `index`, at most `AT_ONCE` in each part; one part if there are not more points.
    """
    if len(index) <= AT_ONCE:
        return [slice(None)]

    azimuth = torch.atan2(points[index, 1], points[index, 0])
    return list(azimuth.argsort().split(AT_ONCE))


def used_points_table(
    points: Tensor, f: Tensor, g: Tensor, *indices: Tensor
) -> tuple[Tensor, Sequence[Tensor]]:
    """Return `point_table` for the points whose indices occur in any of the tensors `indices`.

    On a GPU it has all points, because the CPU would have to wait for the number of those that
    occur.

    Returns:
        The table, and the tensors `indices` as indices into it.
    """
    if not points.is_cpu:
        return point_table(points, f, g), indices

    used, places = occurring(len(points), *indices)
    points, f, g = (values.index_select(0, used) for values in (points, f, g))
    return point_table(points, f, g), places


def head_features(
    config: PointHeadConfig, table: Tensor, uncertain: Tensor, near: Tensor
) -> tuple[Tensor, Tensor]:
    """Return p_i = [f_i, g_i, x_i] (U, 2 K + 4) of uncertain points, and their S_i.

    S_i (U, n, 2 K + 4) has the rows [f_k, g_k, x_k - x_i] of the neighbours `near` (U, n). The
    table is that of `point_table`. The positions in p_i are scaled by `config.position_scale`.
    """
    point = table[uncertain]
    rows = table[near]
    rows[..., -POINT_VALUES:] -= point[:, None, -POINT_VALUES:]
    point[:, -POINT_VALUES:-1] *= config.position_scale
    return point, rows


def nearest_neighbours(points: Tensor, index: Tensor, n: int) -> Tensor:
    """Return the indices (U, n) of the `nearest_others` of points `index` (U,) of points (P, 4)."""
    if points.is_cuda:
        return nearest_others_by_blocks(points[:, :3], index, n)

    nearest = nearest_others(points[:, :3].cpu().numpy(), index.cpu().numpy(), n)
    return torch.from_numpy(nearest).to(points.device)


def _layers(widths: tuple[int, ...]) -> list[nn.Module]:
    """Return linear layers of these widths, each with batch norm and ReLU."""
    layers: list[nn.Module] = []
    for inputs, outputs in pairwise(widths):
        layers += [PointLinear(inputs, outputs), nn.BatchNorm1d(outputs), nn.ReLU(inplace=True)]
    return layers
