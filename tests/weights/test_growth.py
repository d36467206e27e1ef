"""Weights with more residual blocks than they had."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch

import amvnet
from amvnet.models.layers import ResidualBlock
from amvnet.weights.growth import deepened

from fixtures.tiny import fresh_weights, street


def test_a_deeper_network_begins_as_the_shallower_one() -> None:
    weights = fresh_weights()
    net = weights.model.range_net
    more = tuple(blocks + 1 for blocks in net.blocks)
    model = replace(weights.model, range_net=replace(net, blocks=more, stem_blocks=2))

    deeper = deepened(weights, "range_net", model, seed=0)
    assert deeper is not None
    assert deeper.model.range_net.blocks == more
    assert deeper.parts == weights.parts
    assert deeper.digest("polar_net") == weights.digest("polar_net")

    # Only the leak of the added activations differs.
    points, _ = street(0)
    before = amvnet.load(weights, method="rv")(points).scores
    after = amvnet.load(deeper, method="rv")(points).scores
    np.testing.assert_allclose(after, before, atol=0.05)
    assert (after.argmax(axis=1) == before.argmax(axis=1)).mean() > 0.95

    # Every parameter of the new blocks can learn once their scale is not 0.
    module = deeper.build().range_net
    zeros = 0
    for block in module.modules():
        if isinstance(block, ResidualBlock):
            scale = block.second[1].weight
            assert isinstance(scale, torch.Tensor)
            zeros += int((scale == 0).all())
    assert zeros == 2 + len(more)


def test_other_differences_cannot_be_grown() -> None:
    weights = fresh_weights()
    net = weights.model.range_net
    wider = replace(weights.model, range_net=replace(net, decoder=net.decoder + 8))
    fewer = replace(weights.model, range_net=replace(net, gru=False))
    assert deepened(weights, "range_net", wider, seed=0) is None
    assert deepened(weights, "range_net", fewer, seed=0) is None
