"""Change the parts of weights: replace one, or change its sizes or classes."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any

import torch

from amvnet.config.nested import flat, to_dict
from amvnet.config.parts import PART_OF
from amvnet.config.schema import ModelConfig
from amvnet.data.taxonomy import Taxonomy, describe_difference
from amvnet.errors import InputError
from amvnet.models.amvnet import build_amvnet
from amvnet.models.point_head import PointHead
from amvnet.weights.file import Weights

# The fields of `ModelConfig` that set the sizes of each part.
SIZES = {part.name: part.sizes for part in PART_OF.values()}


def replace_part(weights: Weights, part: str, other: Weights) -> Weights:
    """Return weights in which one part, its sizes and its records come from other weights.

    They expect the scans of the other weights, to which the part was trained last.

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

    prefix = f"{part}."
    tensors = {key: weights.tensors[key] for key in weights.tensors if not key.startswith(prefix)}
    tensors |= {key: other.tensors[key] for key in other.tensors if key.startswith(prefix)}
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
    """
    sizes = {key: getattr(model, key) for key in SIZES[part]}
    return dataclasses.replace(weights, model=dataclasses.replace(weights.model, **sizes))


def head_fits(weights: Weights, model: ModelConfig) -> bool:
    """Return whether the parameters of the head have the sizes of another configuration."""
    with torch.device("meta"):  # takes no memory
        head = PointHead(model.point_head, weights.taxonomy.size)
    try:
        head.load_state_dict(weights.part("point_head"), assign=True)
    except RuntimeError:
        return False
    return True


def differences(weights: Weights, part: str, model: ModelConfig) -> list[str]:
    """Return in words the sizes of one part that differ in another configuration."""
    others = dict(flat(to_dict(model), "model"))
    found = []
    for section in SIZES[part]:
        for key, value in flat(to_dict(getattr(weights.model, section)), f"model.{section}"):
            if value != others[key]:
                found.append(f"{key} is {value}, not {others[key]}")
    return found


def for_classes(weights: Weights, taxonomy: Taxonomy, seed: int) -> tuple[Weights, list[str]]:
    """Return weights with which a training for other classes can begin.

    Parameters whose size depends on the number of classes are new: the last layers, and the layers
    of the head that see the scores. All other parameters are kept.

    Returns:
        The weights, without metrics, and the names of the new parameters.
    """
    with torch.device("meta"):  # takes no memory
        larger = build_amvnet(weights.model, taxonomy.size + 1).state_dict()
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        fresh = build_amvnet(weights.model, taxonomy.size).state_dict()

    tensors = {}
    new = []
    for key, tensor in weights.tensors.items():
        depends_on_classes = fresh[key].shape != larger[key].shape
        tensors[key] = fresh[key] if depends_on_classes else tensor
        if depends_on_classes:
            new.append(key)
    begun = dataclasses.replace(weights, taxonomy=taxonomy, tensors=tensors)
    return dataclasses.replace(begun, metrics={}), new


def _with_entry(records: Mapping[str, Any], others: Mapping[str, Any], part: str) -> dict[str, Any]:
    """Return records by part, in which one part has its record of `others`, or no record."""
    kept = {key: record for key, record in records.items() if key != part}
    return kept | ({part: others[part]} if part in others else {})
