"""The point head: settles the uncertain points by their neighbourhood (section 3.2 of the paper)."""

from __future__ import annotations

from itertools import pairwise

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from amvnet.config.schema import PointHeadConfig
from amvnet.models.layers import PointLinear
from amvnet.models.neighbours import nearest_others
from amvnet.models.neighbours_gpu import nearest_others_by_blocks
from amvnet.models.views.points import occurring

POINT_VALUES = 4  # x, y, z, intensity
# Uncertain points that are scored at a time: what a processor's cache holds; what keeps a GPU busy.
PART, PART_ON_GPU = 1024, 2**16


class PointHead(nn.Module):
    """Uncertain points with their neighbours -> scores before softmax (U, K).

    Input: of U uncertain points their features p_i (U, 2 K + 4) and S_i (U, n, 2 K + 4), as `head_features` makes them.
    """

    def __init__(self, config: PointHeadConfig, classes: int) -> None:
        super().__init__()
        self.config = config
        width = 2 * classes + POINT_VALUES
        self.mlp = _mlp((width, *config.hidden))
        self.fc = nn.Sequential(
            _mlp((width + config.hidden[-1], config.fc)), PointLinear(config.fc, classes)
        )

    def forward(self, point: Tensor, rows: Tensor) -> Tensor:
        u, n, width = rows.shape
        pooled = (
            self.mlp(rows.reshape(u * n, width)).view(u, n, self.config.hidden[-1]).amax(dim=1)
        )  # (U, hidden)
        return self.fc(torch.cat([pooled, point], dim=1))

    def score(self, table: Tensor, uncertain: Tensor, near: Tensor) -> Tensor:
        """The same as `forward(*head_features(...))`, with the first layer once a point and not once a neighbour.

        W [f_k, g_k, x_k - x_i] = W [f_k, g_k, x_k] - W [0, 0, x_i]. The arguments are those of `head_features`.
        """
        first, middle, last = self.mlp[0], self.mlp[1:-1], self.mlp[-1]
        assert isinstance(first, nn.Linear)
        done, found, part = first(table), [], PART if table.is_cpu else PART_ON_GPU
        for index, k in zip(uncertain.split(part), near.split(part), strict=True):
            point = table.index_select(0, index)
            shift = F.linear(point[:, -POINT_VALUES:], first.weight[:, -POINT_VALUES:])
            rows = (
                done.index_select(0, k.flatten()).unflatten(0, k.shape).sub_(shift[:, None])
            )  # (part, n, hidden[0])
            # The last ReLU leaves the order as it is: a fifteenth of the work after the maximum.
            pooled = last(middle(rows.flatten(0, 1)).unflatten(0, k.shape).amax(dim=1))
            point[:, -POINT_VALUES:-1] *= self.config.position_scale
            found.append(self.fc(torch.cat([pooled, point], dim=1)))
        return torch.cat(found)


def point_table(points: Tensor, f: Tensor, g: Tensor) -> Tensor:
    """[f, g, x] of all points of a scan, (P, 2 K + 4), from which `head_features` takes its rows."""
    return torch.cat([f, g, points], dim=1)


def select_used_points(count: int, *indices: Tensor) -> tuple[Tensor, list[Tensor]]:
    """The points, of so many, that occur in some tensors of indices: (M,), and the tensors as places among these.

    On a GPU all of them: it would be waited for to count them.
    """
    if not indices[0].is_cpu:
        return torch.arange(count, device=indices[0].device), list(indices)
    return occurring(count, *indices)


def head_features(
    config: PointHeadConfig, table: Tensor, uncertain: Tensor, near: Tensor
) -> tuple[Tensor, Tensor]:
    """p_i = [f_i, g_i, x_i] of the uncertain points, and the rows [f_k, g_k, x_k - x_i] of their S_i.

    Args:
        table: (P, 2 K + 4) of one scan, from `point_table`.
        uncertain: (U,) indices of the uncertain points.
        near: (U, n) indices of their nearest neighbours.

    Returns:
        (U, 2 K + 4) and (U, n, 2 K + 4).
    """
    point, rows = table[uncertain], table[near]
    rows[..., -POINT_VALUES:] -= point[:, None, -POINT_VALUES:]
    point[:, -POINT_VALUES:-1] *= config.position_scale
    return point, rows


def nearest_neighbours(points: Tensor, index: Tensor, n: int) -> Tensor:
    """(U, n) indices of the n nearest other points of each point in `index`, by x, y, z.

    Of a scan with fewer than n other points the last one is repeated; a lone point is its own neighbour.
    """
    if points.is_cuda:
        return nearest_others_by_blocks(points[:, :3], index, n)
    found = nearest_others(points[:, :3].cpu().numpy(), index.cpu().numpy(), n)
    return torch.from_numpy(found).to(points.device)


def _mlp(widths: tuple[int, ...]) -> nn.Sequential:
    layers: list[nn.Module] = []
    for channels, out in pairwise(widths):
        layers += [PointLinear(channels, out), nn.BatchNorm1d(out), nn.ReLU(inplace=True)]
    return nn.Sequential(*layers)
