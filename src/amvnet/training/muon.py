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


class Muon(torch.optim.Optimizer):
    """Muon for the kernels of the hidden layers, and AdamW for all other parameters.

    A few directions dominate the gradient of a kernel, so that a network learns the others slowly.
    A step of Muon is as long in every direction: the singular values of the averaged gradient, as a
    matrix with a row for each output channel, are replaced by 1.
    `torch.optim.Muon` takes only matrices, and needs torch 2.9. The network's parameters are in the
    order of its layers.
    """

    def __init__(self, net: nn.Module, lr: float, weight_decay: float) -> None:
        hidden = hidden_kernels(net)
        ids = set(map(id, hidden))
        others = [parameter for parameter in net.parameters() if id(parameter) not in ids]
        groups = [{"params": others, "is_hidden": False}, {"params": hidden, "is_hidden": True}]
        defaults = {"lr": lr, "weight_decay": weight_decay, "betas": (0.9, 0.999), "eps": 1e-8}
        super().__init__(groups, defaults)

    @torch.no_grad()
    def step(self, closure: Callable[[], Any] | None = None) -> Any:
        """Take one step. A closure computes the gradients and returns the loss."""
        loss = None
        if closure is not None:
            with torch.enable_grad():
                loss = closure()

        for group in self.param_groups:
            move = self._move_hidden if group["is_hidden"] else self._move_other
            for parameter in group["params"]:
                if parameter.grad is not None:
                    parameter.mul_(1 - group["lr"] * group["weight_decay"])
                    move(parameter, parameter.grad, group)
        return loss

    def _move_hidden(self, kernel: Tensor, gradient: Tensor, group: dict[str, Any]) -> None:
        momentum = group["betas"][0]
        state = self.state[kernel]
        if not state:
            state["average"] = torch.zeros_like(kernel)
        average = state["average"].lerp_(gradient, 1 - momentum)

        direction = gradient.lerp(average, momentum).flatten(1)  # Nesterov's momentum
        length = STEP_LENGTH * max(direction.shape) ** 0.5
        kernel.add_(orthogonal(direction).view_as(kernel), alpha=-group["lr"] * length)

    def _move_other(self, parameter: Tensor, gradient: Tensor, group: dict[str, Any]) -> None:
        """Move a parameter as `torch.optim.AdamW` does on a CPU, to the bit."""
        beta, beta_of_squares = group["betas"]
        state = self.state[parameter]
        if not state:
            state["step"] = 0
            state["average"] = torch.zeros_like(parameter)
            state["squares"] = torch.zeros_like(parameter)
        state["step"] += 1
        average = state["average"].lerp_(gradient, 1 - beta)
        squares = state["squares"].mul_(beta_of_squares)
        squares.addcmul_(gradient, gradient, value=1 - beta_of_squares)

        # Both averages began at zero, so that they are too small in the first steps.
        length = group["lr"] / (1 - beta ** state["step"])
        root = (1 - beta_of_squares ** state["step"]) ** 0.5
        parameter.addcdiv_(average, (squares.sqrt() / root).add_(group["eps"]), value=-length)


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
