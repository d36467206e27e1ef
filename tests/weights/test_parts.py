"""Weights put together from parts: replaced, deeper, or for other classes."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch

import amvnet
from amvnet.config.schema import PARTS
from amvnet.data.taxonomy import NUSCENES
from amvnet.models.methods import MethodName
from amvnet.weights.file import Weights
from amvnet.weights.parts import for_classes, replace_part

from fixtures.commands import fails
from fixtures.tiny import fresh_weights, street, with_model, without

POINTS = street(9)[0]


@pytest.fixture(scope="module")
def weights() -> Weights:
    return fresh_weights()


def scores(weights: Weights, method: MethodName = "amvnet") -> np.ndarray:
    return amvnet.load(weights, method=method)(POINTS).scores


@pytest.mark.parametrize("part", PARTS)
def test_replacing_a_part_changes_only_that_part(weights: Weights, part: str) -> None:
    mine = {name: {"val/miou": 0.1} for name in PARTS}
    theirs = {name: {"val/miou": 0.9} for name in PARTS}
    other = replace(fresh_weights(seed=1), metrics=theirs)
    mixed = replace_part(replace(weights, metrics=mine), part, other)
    assert mixed.metrics == mine | {part: theirs[part]}

    for name in PARTS:
        source = other if name == part else weights
        assert mixed.training[name] == source.training[name]
        assert mixed.digest(name) == source.digest(name)

    assert not np.array_equal(scores(mixed), scores(weights))


def test_a_part_brings_its_sizes(weights: Weights) -> None:
    mixed = replace_part(weights, "range_net", with_model(weights, "range_view", width=128))
    assert (mixed.model.range_view.width, mixed.model.polar_view) == (128, weights.model.polar_view)


def test_networks_and_head_of_two_files_add_up(weights: Weights) -> None:
    networks = without(weights, "point_head")
    head = without(weights, "range_net", "polar_net")
    assert networks.parts == ("range_net", "polar_net")
    assert head.parts == ("point_head",)

    assert np.array_equal(scores(replace_part(networks, "point_head", head)), scores(weights))


@pytest.mark.parametrize("part", PARTS)
def test_a_part_for_other_classes_is_refused(weights: Weights, part: str) -> None:
    fails(lambda: replace_part(weights, part, fresh_weights(NUSCENES)), "nuscenes")


def test_a_missing_part_is_refused(weights: Weights) -> None:
    fails(lambda: replace_part(weights, "point_head", without(weights, "point_head")), "point_head")


def test_for_other_classes_only_the_layers_that_depend_on_their_number_are_new() -> None:
    weights = fresh_weights()
    changes: dict[str, Any] = {"classes": ("ground", "thing"), "colors": ((0, 0, 0),) * 3}
    changes |= {"raw_to_train": {0: 0, 1: 1, 2: 2}, "train_to_raw": (0, 1, 2)}
    few = replace(weights.taxonomy, name="few", **changes)
    assert weights.training
    assert weights.metrics
    begun, new = for_classes(weights, few, seed=1)
    assert begun.taxonomy == few
    assert begun.training == weights.training  # which scans the networks take
    assert not begun.metrics  # of other classes

    assert {name.split(".")[0] for name in new} == {"range_net", "polar_net", "point_head"}
    for name, tensor in weights.tensors.items():
        assert torch.equal(begun.tensors[name], tensor) == (name not in new)
    last = {name for name in new if name.startswith(("range_net", "polar_net"))}
    assert all(".scores." in name for name in last)
    assert begun.build()  # the sizes fit

    again, _ = for_classes(weights, few, seed=1)
    other, _ = for_classes(weights, few, seed=2)
    key = "range_net.scores.weight"
    assert again.tensors[key].equal(begun.tensors[key])
    assert not other.tensors[key].equal(begun.tensors[key])


def test_for_other_classes_of_the_same_number_the_same_layers_are_new() -> None:
    weights = fresh_weights()
    classes = tuple(f"other-{name}" for name in weights.taxonomy.classes)
    begun, new = for_classes(weights, replace(weights.taxonomy, classes=classes), seed=1)
    key = "range_net.scores.weight"
    assert not begun.tensors[key].equal(weights.tensors[key])
    assert len(new) < len(weights.tensors) / 3


def test_weights_for_other_classes_leave_the_random_state_as_it_was() -> None:
    weights = fresh_weights()
    few = replace(weights.taxonomy, name="few")
    torch.manual_seed(5)
    expected = torch.rand(3)
    torch.manual_seed(5)
    for_classes(weights, few, seed=1)
    assert torch.equal(torch.rand(3), expected)
