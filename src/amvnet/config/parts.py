"""The parts of the method: what stages, weights, sizes and tables call each of them."""

from __future__ import annotations

from dataclasses import dataclass

from amvnet.config.schema import NetworkName, StageName


@dataclass(frozen=True)
class Part:
    """A part of the method.

    Attributes:
        name: its name in `AMVNet` and in weights.
        sizes: the fields of `ModelConfig` that set its sizes.
        short: its name in tables and figures.
    """

    name: str
    sizes: tuple[str, ...]
    title: str
    short: str


# The parts by the stage that trains each of them, in the order of the stages.
PART_OF: dict[StageName, Part] = {
    "rv": Part("range_net", ("range_view", "range_net"), "Range-view network", "RV"),
    "bev": Part("polar_net", ("polar_view", "polar_net"), "Bird's-eye-view network", "BEV"),
    "head": Part("point_head", ("assertion", "point_head"), "Point head", "head"),
}
NETWORK_STAGES: tuple[NetworkName, ...] = ("rv", "bev")
PARTS = tuple(part.name for part in PART_OF.values())
BOTH_NETWORKS = tuple(PART_OF[stage].name for stage in NETWORK_STAGES)
