"""Batch norm over the batches of all processes, on CPUs too."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor, nn
from torch import distributed as dist
from torch.nn.modules.batchnorm import _BatchNorm

if TYPE_CHECKING:
    pass


def synchronise_batch_norms(net: nn.Module, cuda: bool) -> nn.Module:
    """The network with batch norms whose statistics are over the batches of all processes."""
    if cuda:
        return nn.SyncBatchNorm.convert_sync_batchnorm(net)
    for name, child in net.named_children():
        setattr(
            net,
            name,
            SyncedBatchNorm.of(child)
            if isinstance(child, _BatchNorm)
            else synchronise_batch_norms(child, cuda),
        )
    return net


class _Sum(torch.autograd.Function):
    """The sum over all processes; its gradient is the sum of theirs."""

    @staticmethod
    def forward(ctx: Any, x: Tensor) -> Tensor:
        total = x.clone()
        dist.all_reduce(total)
        return total

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> Tensor:
        return _Sum.forward(ctx, grads[0])


def _sum(x: Tensor) -> Tensor:
    return _Sum.apply(x)


class SyncedBatchNorm(_BatchNorm):
    """Batch norm over the batches of all processes, which may differ in size; torch's own runs on accelerators only."""

    @classmethod
    def of(cls, norm: _BatchNorm) -> SyncedBatchNorm:
        """One with the parameters of another."""
        like = norm.weight
        found = cls(
            norm.num_features, norm.eps, norm.momentum, device=like.device, dtype=like.dtype
        )
        found.load_state_dict(norm.state_dict())
        return found

    def _check_input_dim(self, input: Tensor) -> None:
        pass

    def forward(self, input: Tensor) -> Tensor:
        if not self.training:
            return super().forward(input)
        shape = (1, -1, *[1] * (input.ndim - 2))
        over = [d for d in range(input.ndim) if d != 1]
        x = input.to(torch.promote_types(input.dtype, torch.float32))
        count = x.new_tensor([x.numel() / x.shape[1]])
        sums = _sum(torch.cat([x.sum(over), count]))
        mean, total = sums[:-1] / sums[-1], sums[-1].detach()
        centred = x - mean.view(shape)
        variance = _sum(centred.square().sum(over)) / total
        self._remember(mean.detach(), variance.detach() * total / (total - 1))
        scale = self.weight * (variance + self.eps).rsqrt()
        return (centred * scale.view(shape) + self.bias.view(shape)).to(input.dtype)

    @torch.no_grad()
    def _remember(self, mean: Tensor, variance: Tensor) -> None:
        assert self.running_mean is not None
        assert self.running_var is not None
        assert self.num_batches_tracked is not None
        assert self.momentum is not None
        self.running_mean.lerp_(mean, self.momentum)
        self.running_var.lerp_(variance, self.momentum)
        self.num_batches_tracked.add_(1)
