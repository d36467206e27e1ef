"""Batch norm over the batches of all processes, on GPUs and CPUs."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor, nn
from torch import distributed as dist
from torch.nn.modules.batchnorm import _BatchNorm


def synchronise_batch_norms(net: nn.Module, cuda: bool) -> nn.Module:
    """Replace the batch norms inside a network by batch norms over the batches of all processes.

    The network is changed in place and returned. On GPUs, PyTorch's `SyncBatchNorm` is used.
    """
    if cuda:
        synchronised: nn.Module = nn.SyncBatchNorm.convert_sync_batchnorm(net)
        return synchronised

    for name, child in net.named_children():
        if isinstance(child, _BatchNorm):
            setattr(net, name, SyncedBatchNorm.of(child))
        else:
            synchronise_batch_norms(child, cuda)
    return net


class SyncedBatchNorm(_BatchNorm):
    """Batch norm over the batches of all processes. The batches may differ in size."""

    @classmethod
    def of(cls, norm: _BatchNorm) -> SyncedBatchNorm:
        """Return a batch norm over all processes that has the state of another batch norm."""
        weight = norm.weight
        synced = cls(
            norm.num_features, norm.eps, norm.momentum, device=weight.device, dtype=weight.dtype
        )

        synced.load_state_dict(norm.state_dict())
        return synced

    def forward(self, input: Tensor) -> Tensor:
        if not self.training:
            return super().forward(input)

        x = input.to(torch.promote_types(input.dtype, torch.float32))
        shape = (1, -1, *[1] * (x.ndim - 2))  # the shape in which a value per channel broadcasts
        axes = (0, *range(2, x.ndim))  # all axes except the channels

        # One exchange serves both the sums of the channels and the number of their values.
        count = x.new_tensor([x.numel() / x.shape[1]])
        sums = _sum_over_processes(torch.cat([x.sum(axes), count]))
        mean = sums[:-1] / sums[-1]
        total = sums[-1].detach()

        centred = x - mean.view(shape)
        variance = _sum_over_processes(centred.square().sum(axes)) / total
        self._update_statistics(mean.detach(), variance.detach() * total / (total - 1))

        scale = self.weight * (variance + self.eps).rsqrt()
        return (centred * scale.view(shape) + self.bias.view(shape)).to(input.dtype)

    @torch.no_grad()
    def _update_statistics(self, mean: Tensor, variance: Tensor) -> None:
        assert self.running_mean is not None
        assert self.running_var is not None
        assert self.num_batches_tracked is not None
        assert self.momentum is not None

        self.running_mean.lerp_(mean, self.momentum)
        self.running_var.lerp_(variance, self.momentum)
        self.num_batches_tracked.add_(1)

    def _check_input_dim(self, input: Tensor) -> None:
        """Accept any number of dimensions."""


class _ProcessSum(torch.autograd.Function):
    """The sum of a tensor over all processes. Its gradient is the sum of their gradients."""

    @staticmethod
    def forward(ctx: Any, x: Tensor) -> Tensor:
        total = x.clone()
        dist.all_reduce(total)
        return total

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> Tensor:
        return _ProcessSum.forward(ctx, grads[0])


def _sum_over_processes(x: Tensor) -> Tensor:
    total: Tensor = _ProcessSum.apply(x)  # type: ignore[no-untyped-call]
    return total
