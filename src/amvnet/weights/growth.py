"""Deepen trained networks: add residual blocks to their weights."""

from __future__ import annotations

import dataclasses
from typing import cast

import torch
from torch import Tensor

from amvnet.config.schema import ModelConfig
from amvnet.models.amvnet import build_amvnet
from amvnet.models.layers import ResidualBlock
from amvnet.weights.file import Weights


def deepened(weights: Weights, part: str, model: ModelConfig, seed: int) -> Weights | None:
    """Return weights in which one part has the residual blocks of a deeper configuration.

    The part keeps its parameters. A new block begins as a skip connection: the scale of its last
    batch norm is 0 (Goyal et al., 2017). The deeper network therefore computes the same as the
    shallower one, except for the leak of one more activation.

    Args:
        weights: trained weights that hold the part.
        part: "range_net" or "polar_net".
        model: the configuration with the sizes of the deeper part.
        seed: the seed of the other parameters of the new blocks.

    Returns:
        The weights, without a record of the part's training and metrics; None if the parts differ
        in more than the number of residual blocks.
    """
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        module = getattr(build_amvnet(model, weights.taxonomy.size), part)

    blocks = []
    for name, layer in module.named_modules():
        if isinstance(layer, ResidualBlock):
            blocks.append(f"{name}.")
            if not any(key.startswith(f"{part}.{name}.") for key in weights.tensors):
                torch.nn.init.zeros_(cast(Tensor, layer.second[1].weight))

    known = weights.part(part)
    fresh = module.state_dict()
    is_deeper = all(key in fresh and fresh[key].shape == known[key].shape for key in known)
    is_new_block = all(key.startswith(tuple(blocks)) for key in fresh.keys() - known.keys())
    if not is_deeper or not is_new_block:
        return None

    tensors = {key: value for key, value in weights.tensors.items() if not key.startswith(part)}
    for key, value in (fresh | known).items():
        tensors[f"{part}.{key}"] = value.contiguous()
    return dataclasses.replace(
        weights.resized(part, model),
        tensors=tensors,
        training={key: value for key, value in weights.training.items() if key != part},
        metrics={key: value for key, value in weights.metrics.items() if key != part},
    )
