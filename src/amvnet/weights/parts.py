"""Change the parts of weights: replace one, or change the classes."""

from __future__ import annotations

from dataclasses import replace

import torch

from amvnet.config.schema import PART_OF, ModelConfig
from amvnet.data.taxonomy import Taxonomy, describe_difference
from amvnet.errors import InputError
from amvnet.models.amvnet import build_amvnet
from amvnet.weights.file import Weights

# The fields of `ModelConfig` that set the sizes of each part.
SIZES = {part.name: part.sizes for part in PART_OF.values()}


def replace_part(
    weights: Weights, part: str, other: Weights, sizes: ModelConfig | None = None
) -> Weights:
    """Return weights in which one part, its sizes and its records come from other weights.

    They expect the scans of the other weights, to which the part was trained last.

    Args:
        sizes: has the sizes that the part is stated to have; by default those of the other weights.

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

    sizes = sizes or other.model
    prefix = f"{part}."
    tensors = {key: weights.tensors[key] for key in weights.tensors if not key.startswith(prefix)}
    tensors |= {key: other.tensors[key] for key in other.tensors if key.startswith(prefix)}
    training = {key: record for key, record in weights.training.items() if key != part}
    metrics = {key: record for key, record in weights.metrics.items() if key != part}
    if part in other.training:
        training[part] = other.training[part]
    if part in other.metrics:
        metrics[part] = other.metrics[part]
    return replace(
        weights,
        model=replace(weights.model, **{key: getattr(sizes, key) for key in SIZES[part]}),
        expects=other.expects,
        tensors=tensors,
        training=training,
        metrics=metrics,
    )


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
    return replace(weights, taxonomy=taxonomy, tensors=tensors, metrics={}), new
