"""Define Muon, an optimizer whose steps change all directions of a kernel equally.

Source: Keller Jordan et al., "Muon: An optimizer for hidden layers in neural networks", 2024,
https://kellerjordan.github.io/posts/muon/.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor, nn

# The coefficients of Jordan et al. for five iterations of Newton and Schulz.
ITERATIONS = 5
COEFFICIENTS = (3.4445, -4.7750, 2.0315)
# With this factor, the steps are about as long as AdamW's steps at the same learning rate (Liu et
# al., "Muon is scalable for LLM training", 2025, section 2.2, arXiv:2502.16982).
STEP_LENGTH = 0.2


class Muon(torch.optim.AdamW):
    """Muon for the kernels of the hidden layers, and AdamW for all other parameters.

    A few directions dominate the gradient of a kernel, so that a network learns the others slowly.
    A step of Muon is as long in every direction: the singular values of the averaged gradient, as a
    matrix with a row for each output channel, are replaced by 1.
    `torch.optim.Muon` takes only matrices, and needs torch 2.9.

    Args:
        net: the network, whose parameters are in the order of its layers.
        lr: the learning rate of all parameters.
        weight_decay: the decoupled weight decay of all parameters.
        fused: see `torch.optim.AdamW`.
    """

    def __init__(
        self, net: nn.Module, lr: float, weight_decay: float, fused: bool | None = None
    ) -> None:
        hidden = hidden_kernels(net)
        ids = set(map(id, hidden))
        others = [parameter for parameter in net.parameters() if id(parameter) not in ids]
        groups = [{"params": others}, {"params": hidden}]
        super().__init__(groups, lr=lr, weight_decay=weight_decay, fused=fused)

    @torch.no_grad()
    def step(self, closure: Callable[[], Any] | None = None) -> Any:
        """Take one step. A closure computes the gradients and returns the loss."""
        loss = None
        if closure is not None:
            with torch.enable_grad():
                loss = closure()

        group = self.param_groups[1]
        gradients = [parameter.grad for parameter in group["params"]]
        for parameter in group["params"]:
            parameter.grad = None  # AdamW leaves such parameters alone
        super().step()

        for parameter, gradient in zip(group["params"], gradients, strict=True):
            parameter.grad = gradient
            if gradient is not None:
                self._move(parameter, gradient, group)
        return loss

    def _move(self, kernel: Tensor, gradient: Tensor, group: dict[str, Any]) -> None:
        momentum = group["betas"][0]
        state = self.state[kernel]
        if not state:
            state["step"] = torch.zeros(())  # AdamW looks for it in a state that is loaded
            state["average"] = torch.zeros_like(kernel)
        average = state["average"].lerp_(gradient, 1 - momentum)

        direction = gradient.lerp(average, momentum).flatten(1)  # Nesterov's momentum
        length = STEP_LENGTH * max(direction.shape) ** 0.5
        kernel.mul_(1 - group["lr"] * group["weight_decay"])
        kernel.add_(orthogonal(direction).view_as(kernel), alpha=-group["lr"] * length)


def hidden_kernels(net: nn.Module) -> list[nn.Parameter]:
    """Return the matrices and kernels of all layers but the first and the last."""
    kernels = [parameter for parameter in net.parameters() if parameter.dim() > 1]
    return kernels[1:-1]


def orthogonal(matrix: Tensor) -> Tensor:
    """Return about U V^T (M, N) of a matrix U S V^T: its singular values are near 1."""
    is_tall = len(matrix) > matrix.shape[1]
    x: Tensor = matrix.T if is_tall else matrix
    x = x / x.norm().clamp(min=1e-7)  # the iterations need singular values of at most 1

    a, b, c = COEFFICIENTS
    for _ in range(ITERATIONS):
        square = x @ x.T
        x = a * x + (b * square + c * square @ square) @ x
    return x.T if is_tall else x
