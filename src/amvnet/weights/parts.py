"""Change the parts of weights: replace one, or change its sizes, classes or depth."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any, cast

import torch
from torch import Tensor

from amvnet.config.schema import ModelConfig
from amvnet.data.taxonomy import Taxonomy, describe_difference
from amvnet.errors import InputError
from amvnet.models.amvnet import build_amvnet
from amvnet.models.layers import ResidualBlock
from amvnet.weights.file import Weights

# The fields of `ModelConfig` that set the sizes of each part.
SIZES = {
    "range_net": ("range_view", "range_net"),
    "polar_net": ("polar_view", "polar_net"),
    "point_head": ("assertion", "point_head"),
}


def replace_part(weights: Weights, part: str, other: Weights) -> Weights:
    """Return weights in which one part, its sizes and its records come from other weights.

    They expect the scans of the other weights, to which the part was trained last.

    Args:
        weights: the weights that keep their other parts.
        part: "range_net", "polar_net" or "point_head".
        other: the weights that have the new part.

    Raises:
        InputError: if the other weights lack the part or have other classes.
    """
    if part not in other.parts:
        raise InputError(
            f"expected weights with the part {part}, found {', '.join(other.parts) or 'none'}; "
            "train it first"
        )
    if weights.taxonomy.classes != other.taxonomy.classes:
        difference = describe_difference(
            weights.taxonomy.classes, other.taxonomy.classes, other.taxonomy.name
        )
        raise InputError(
            f"expected weights for the classes of {weights.taxonomy.name}, found those of "
            f"{difference}; train this part for these classes, in another folder"
        )

    tensors = {}
    for key, tensor in weights.tensors.items():
        if not key.startswith(f"{part}."):
            tensors[key] = tensor
    for key, tensor in other.part(part).items():
        tensors[f"{part}.{key}"] = tensor

    return dataclasses.replace(
        resized(weights, part, other.model),
        expects=other.expects,
        tensors=tensors,
        training=_with_entry(weights.training, other.training, part),
        metrics=_with_entry(weights.metrics, other.metrics, part),
    )


def resized(weights: Weights, part: str, model: ModelConfig) -> Weights:
    """Return weights in which the sizes of one part come from another configuration.

    The parameters stay unchanged: also replace them before you build the model.

    Args:
        weights: trained weights.
        part: "range_net", "polar_net" or "point_head".
        model: the configuration with the new sizes.
    """
    sizes = {key: getattr(model, key) for key in SIZES[part]}
    return dataclasses.replace(weights, model=dataclasses.replace(weights.model, **sizes))


def fits(weights: Weights, part: str, model: ModelConfig) -> bool:
    """Return whether the parameters of one part have the sizes of another configuration."""
    with torch.device("meta"):  # takes no memory
        module = getattr(build_amvnet(model, weights.taxonomy.size), part)
    try:
        module.load_state_dict(weights.part(part), assign=True)
    except RuntimeError:
        return False
    return True


def for_classes(weights: Weights, taxonomy: Taxonomy, seed: int) -> tuple[Weights, list[str]]:
    """Return weights with which a training for other classes can begin.

    Parameters whose size depends on the number of classes are new: the last layers, and the layers
    of the head that see the scores. All other parameters are kept.

    Args:
        weights: trained weights.
        taxonomy: the new classes.
        seed: the seed of the new parameters.

    Returns:
        The weights, without metrics, and the names of the new parameters.
    """
    with torch.device("meta"):  # takes no memory
        few = build_amvnet(weights.model, 1).state_dict()
        more = build_amvnet(weights.model, 2).state_dict()
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        fresh = build_amvnet(weights.model, taxonomy.size).state_dict()

    tensors = {}
    new = []
    for key, tensor in weights.tensors.items():
        depends_on_classes = few[key].shape != more[key].shape
        tensors[key] = fresh[key] if depends_on_classes else tensor
        if depends_on_classes:
            new.append(key)
    begun = dataclasses.replace(weights, taxonomy=taxonomy, tensors=tensors)
    return dataclasses.replace(begun, metrics={}), new


def grown(weights: Weights, part: str, model: ModelConfig, seed: int) -> Weights | None:
    """Return weights in which one part has the residual blocks and steps of a larger configuration.

    The part keeps its parameters. A new block begins as a skip connection: the scale of its last
    batch norm is 0 (Goyal et al., 2017). New channels of the input (`RangeNetConfig.steps`) begin
    with a kernel of 0. The larger network therefore computes the same as the smaller one, except
    for the leak of one more activation in each new block.

    Args:
        weights: trained weights that hold the part.
        part: "range_net" or "polar_net".
        model: the configuration with the sizes of the larger part.
        seed: the seed of the other parameters of the new blocks.

    Returns:
        The weights, without the part's metrics; None if the parts differ in more than residual
        blocks and steps.
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
    if model.range_net.steps and part == "range_net":
        known = _with_steps(known, fresh)
    is_larger = all(key in fresh and fresh[key].shape == known[key].shape for key in known)
    is_new_block = all(key.startswith(tuple(blocks)) for key in fresh.keys() - known.keys())
    if not is_larger or not is_new_block:
        return None

    tensors = {key: value for key, value in weights.tensors.items() if not key.startswith(part)}
    for key, value in (fresh | known).items():
        tensors[f"{part}.{key}"] = value.contiguous()
    return dataclasses.replace(
        resized(weights, part, model),
        tensors=tensors,
        metrics=_with_entry(weights.metrics, {}, part),
    )


def _with_steps(known: Mapping[str, Tensor], fresh: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Return parameters of a range view whose first layers take as many channels as fresh ones."""
    widened = dict(known)
    for name in ("weight", "bias", "running_mean", "running_var"):
        norm = known[f"input_norm.{name}"]
        widened[f"input_norm.{name}"] = torch.cat([norm, fresh[f"input_norm.{name}"][len(norm) :]])

    kernel = known["stem.0.weight"]  # (C', C, 3, 3)
    channels = fresh["stem.0.weight"].shape[1] - kernel.shape[1]
    widened["stem.0.weight"] = torch.cat([kernel, kernel.new_zeros(len(kernel), channels, 3, 3)], 1)
    return widened


def _with_entry(records: Mapping[str, Any], others: Mapping[str, Any], part: str) -> dict[str, Any]:
    """Return records by part, in which one part has its record of `others`, or no record."""
    kept = {key: record for key, record in records.items() if key != part}
    return kept | ({part: others[part]} if part in others else {})
