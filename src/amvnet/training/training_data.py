"""Open the datasets of a training, a user's own scans in the frame that the weights will have."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path

from amvnet.config.schema import Recipe
from amvnet.data.datasets.base import Dataset
from amvnet.data.datasets.joined import Part, split_share
from amvnet.data.datasets.open import open_dataset
from amvnet.data.datasets.select import training_records
from amvnet.data.taxonomy import Taxonomy, taxonomy_from_yaml
from amvnet.errors import InputError
from amvnet.inference.reading import open_for_weights
from amvnet.weights.file import Weights, load


def open_for_training(
    data: str, taxonomy: Path | None, recipe: Recipe, out: Path, init: Weights | None = None
) -> Dataset:
    """Open the dataset of a training.

    A user's own scans are normalised as by `predict`: to the initial weights, to what this
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


def open_parts(
    specs: Sequence[str], taxonomy: Path | None, recipe: Recipe, out: Path, init: Weights | None
) -> tuple[Dataset, list[Part]]:
    """Open the datasets of a training.

    Args:
        specs: each DATA, or, after the first, DATA@SHARE. The datasets that name no share have that
            of the recipe, `training.others`; if it is 0, all of their scans are taken.
        taxonomy: a YAML file of other classes.
        recipe: of the training.
        out: folder of the run.
        init: weights to begin with.

    Returns:
        The first dataset, and those to mix in with their training scans.

    Raises:
        InputError: if a dataset cannot be opened, or the first has a share.
    """
    opened = []
    for spec in specs:
        data, share = split_share(spec)
        opened.append((open_for_training(data, taxonomy, recipe, out, init), share))
    (first, first_share), *rest = opened
    if first_share is not None:
        raise InputError(
            f"{specs[0]}: expected the first --data without a share, found {first_share:g}; "
            "give the others shares"
        )

    without_share = sum(share is None for _, share in rest)
    others = recipe.training.others
    parts = []
    for dataset, share in rest:
        if share is None and others > 0:
            share = others / without_share
        parts.append(Part(dataset, training_records(dataset), share))
    return first, parts


def _frame(recipe: Recipe, taxonomy: Taxonomy, earlier: Weights | None) -> Weights:
    """Return weights without parameters that say what scans are to be normalised to."""
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
