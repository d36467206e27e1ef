"""Weights put together from parts: replaced, deeper, or for other classes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

import amvnet
from amvnet.config.schema import PARTS
from amvnet.data.taxonomy import NUSCENES
from amvnet.errors import InputError
from amvnet.models.methods import MethodName
from amvnet.weights.file import Weights
from amvnet.weights.parts import for_classes, replace_part

from fixtures.tiny import fresh_weights, street, without

POINTS = street(9)[0]


@pytest.fixture(scope="module")
def weights() -> Weights:
    return fresh_weights()


def scores(weights: Weights, method: MethodName = "amvnet") -> np.ndarray:
    return amvnet.load(weights, method=method)(POINTS).scores


@pytest.mark.parametrize("part", PARTS)
def test_a_part_brings_its_metrics_and_its_training_record(weights: Weights, part: str) -> None:
    mine = {name: {"val/miou": 0.1} for name in PARTS}
    theirs = {name: {"val/miou": 0.9} for name in PARTS}
    other = replace(fresh_weights(seed=1), metrics=theirs)
    mixed = replace_part(replace(weights, metrics=mine), part, other)
    assert mixed.metrics == mine | {part: theirs[part]}
    assert mixed.training == {**weights.training, part: other.training[part]}


@pytest.mark.parametrize("part", PARTS)
def test_replacing_a_part_changes_only_that_part(weights: Weights, part: str) -> None:
    other = fresh_weights(seed=1)
    mixed = replace_part(weights, part, other)

    for name in PARTS:
        source = other if name == part else weights
        assert mixed.training[name] == source.training[name]
        assert mixed.digest(name) == source.digest(name)

    assert not np.array_equal(scores(mixed), scores(weights))


def test_a_part_brings_its_sizes(weights: Weights) -> None:
    config = replace(weights.model, range_view=replace(weights.model.range_view, width=128))
    mixed = replace_part(weights, "range_net", replace(weights, model=config))
    assert mixed.model.range_view.width == 128
    assert mixed.model.polar_view == weights.model.polar_view


def test_networks_and_head_of_two_files_add_up(weights: Weights) -> None:
    networks = without(weights, "point_head")
    head = without(weights, "range_net", "polar_net")
    assert networks.parts == ("range_net", "polar_net")
    assert head.parts == ("point_head",)

    whole = replace_part(networks, "point_head", head)
    assert np.array_equal(scores(whole), scores(weights))


@pytest.mark.parametrize("part", PARTS)
def test_a_part_for_other_classes_is_refused(weights: Weights, part: str) -> None:
    with pytest.raises(InputError, match="nuscenes"):
        replace_part(weights, part, fresh_weights(NUSCENES))


def test_a_missing_part_is_refused(weights: Weights) -> None:
    with pytest.raises(InputError, match="point_head"):
        replace_part(weights, "point_head", without(weights, "point_head"))


def test_for_other_classes_only_the_layers_that_depend_on_their_number_are_new() -> None:
    weights = fresh_weights()
    few = replace(
        weights.taxonomy,
        name="few",
        classes=("ground", "thing"),
        colors=((0, 0, 0),) * 3,
        raw_to_train={0: 0, 1: 1, 2: 2},
        train_to_raw=(0, 1, 2),
    )
    assert weights.training
    assert weights.metrics
    begun, new = for_classes(weights, few, seed=1)
    assert begun.taxonomy == few
    assert begun.training == weights.training  # which scans the networks take
    assert not begun.metrics  # of other classes

    assert {name.split(".")[0] for name in new} == {"range_net", "polar_net", "point_head"}
    for name, tensor in weights.tensors.items():
        if name in new:
            assert begun.tensors[name].shape != tensor.shape or not begun.tensors[name].equal(
                tensor
            )
        else:
            assert begun.tensors[name].equal(tensor)
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
    renamed = replace(
        weights.taxonomy, classes=tuple(f"other-{name}" for name in weights.taxonomy.classes)
    )
    begun, new = for_classes(weights, renamed, seed=1)
    assert not begun.tensors["range_net.scores.weight"].equal(
        weights.tensors["range_net.scores.weight"]
    )
    assert len(new) < len(weights.tensors) / 3


def test_weights_for_other_classes_leave_the_random_state_as_it_was() -> None:
    weights = fresh_weights()
    few = replace(weights.taxonomy, name="few")
    torch.manual_seed(5)
    expected = torch.rand(3)
    torch.manual_seed(5)
    for_classes(weights, few, seed=1)
    assert torch.equal(torch.rand(3), expected)
