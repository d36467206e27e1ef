"""The methods that label points: a network alone, an ensemble, or AMVNet."""

from __future__ import annotations

from typing import Literal, get_args

from amvnet.models.amvnet import ENSEMBLES
from amvnet.weights.file import Weights

Method = Literal["rv", "bev", "arithmetic", "maximum", "ensemble", "amvnet"]


METHODS: tuple[Method, ...] = get_args(Method)


COMPARED: tuple[Method, ...] = ("rv", "bev", "ensemble", "amvnet")  # in the paper's tables by class


NEEDED: dict[str, tuple[str, ...]] = {
    "rv": ("range_net",),
    "bev": ("polar_net",),
    **dict.fromkeys(ENSEMBLES, ("range_net", "polar_net")),
    "amvnet": ("range_net", "polar_net", "point_head"),
}


def widest_method(weights: Weights) -> Method:
    """The last method, in the order of the paper's tables, that the weights have the parts for."""
    found = [method for method in METHODS if set(NEEDED[method]) <= set(weights.parts)]
    return found[-1] if found else METHODS[-1]


TITLES = {
    "rv": "RV",
    "bev": "BEV",
    "arithmetic": "arithmetic mean",
    "maximum": "maximum",
    "ensemble": "ensemble",
    "amvnet": "AMVNet",
}
