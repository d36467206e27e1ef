"""Open the dataset of a training, a user's own scans in the frame that the weights will have."""

from __future__ import annotations

import dataclasses
from pathlib import Path

from amvnet.config.schema import Recipe
from amvnet.data.datasets.base import Dataset
from amvnet.data.datasets.open import open_dataset
from amvnet.data.taxonomy import Taxonomy, taxonomy_from_yaml
from amvnet.inference.inputs import open_for_weights
from amvnet.weights.file import Weights, load


def open_for_training(
    data: str, taxonomy: Path | None, recipe: Recipe, out: Path, init: Weights | None = None
) -> Dataset:
    """Open the dataset of a training.

    A user's own scans are adapted as `predict` adapts them: to the initial weights, to what this
    run has trained before, or else to the sensor of the recipe.

    Args:
        data: as `open_dataset` takes it.
        taxonomy: a YAML file of other classes.
        recipe: of the training.
        out: folder of the run.
        init: weights to begin with.

    Raises:
        InputError: as `open_dataset`.
    """
    classes = None if taxonomy is None else taxonomy_from_yaml(taxonomy)
    dataset = open_dataset(data, classes)
    earlier = init or _earlier_weights(out)
    return open_for_weights(data, _frame(recipe, dataset.taxonomy, earlier), dataset)


def _frame(recipe: Recipe, taxonomy: Taxonomy, earlier: Weights | None) -> Weights:
    """Return weights without parameters that say what scans are to be adapted to."""
    weights = Weights(recipe.model, taxonomy, recipe.sensor)
    if earlier is None:
        return weights
    return dataclasses.replace(weights, training=earlier.training)


def _earlier_weights(out: Path) -> Weights | None:
    """Return weights that an earlier call has written into the folder of a run; None if none."""
    paths = [out / "weights.safetensors"]
    paths += [out / stage / "last.safetensors" for stage in ("rv", "bev")]
    for path in paths:
        if path.is_file():
            return load(path)
    return None
