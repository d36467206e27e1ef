"""Define the methods that label points: one network alone, an ensemble of both, or AMVNet.

This module does not import torch, so that the command line can list the methods quickly.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

from amvnet.config.schema import BOTH_NETWORKS, PART_OF, PARTS
from amvnet.errors import InputError

if TYPE_CHECKING:
    from torch import Tensor

MethodName = Literal["rv", "rv-knn", "bev", "arithmetic", "maximum", "ensemble", "amvnet"]
# Takes the class probabilities f and g (P, K) of the two networks, and returns one (P, K).
Ensemble = Callable[["Tensor", "Tensor"], "Tensor"]


def geometric_mean(f: Tensor, g: Tensor) -> Tensor:
    """Return the geometric mean (P, K), which AMVNet uses for certain points (section 3.3)."""
    return (f * g).sqrt_()


def arithmetic_mean(f: Tensor, g: Tensor) -> Tensor:
    """Return the arithmetic mean (P, K), an ensemble to compare with."""
    return (f + g) / 2


def maximum(f: Tensor, g: Tensor) -> Tensor:
    """Return the larger class probabilities (P, K), an ensemble to compare with."""
    return f.maximum(g)


@dataclass(frozen=True)
class Method:
    """One way to label points.

    Attributes:
        parts: the parts of a weights file that the method needs.
        ensemble: combines the class probabilities f and g of the two networks, or None if the
            method is no ensemble.
    """

    title: str
    parts: tuple[str, ...]
    ensemble: Ensemble | None = None

    @property
    def has_two_networks(self) -> bool:
        """Whether the method compares two networks, so that it knows uncertain points."""
        return set(BOTH_NETWORKS) <= set(self.parts)


# All methods by name, in the order of the paper's tables.
METHODS: dict[str, Method] = {
    "rv": Method(PART_OF["rv"].short, (PART_OF["rv"].name,)),
    "rv-knn": Method(f"{PART_OF['rv'].short} + kNN", (PART_OF["rv"].name,)),
    "bev": Method(PART_OF["bev"].short, (PART_OF["bev"].name,)),
    "arithmetic": Method("arithmetic mean", BOTH_NETWORKS, arithmetic_mean),
    "maximum": Method("maximum", BOTH_NETWORKS, maximum),
    "ensemble": Method("ensemble", BOTH_NETWORKS, geometric_mean),
    "amvnet": Method("AMVNet", PARTS),
}
# Methods in the paper's Tables 3 and 4.
PAPER_METHODS: tuple[MethodName, ...] = ("rv", "bev", "ensemble", "amvnet")


def title_of(name: str) -> str:
    """Return the title of a method; return any other name, such as `labels`, unchanged."""
    return METHODS[name].title if name in METHODS else name


def widest_method(parts: Collection[str]) -> MethodName:
    """Return the last method of `PAPER_METHODS` whose parts are all present.

    If there is none, return "amvnet": `check_method` then names a missing part.
    """
    names = methods_of(parts)
    return names[-1] if names else "amvnet"


def methods_of(
    parts: Collection[str], names: Sequence[MethodName] = PAPER_METHODS
) -> list[MethodName]:
    """Return the methods among `names` whose parts are all present."""
    return [name for name in names if set(METHODS[name].parts) <= set(parts)]


def check_two_networks(method: MethodName, option: str) -> None:
    """Raise InputError if a method has one network, so that an option on uncertain points fails."""
    if not METHODS[method].has_two_networks:
        raise InputError(
            f"expected a method of two networks for {option}, found {method}; use amvnet"
        )


def check_method(method: MethodName, parts: Collection[str]) -> MethodName:
    """Check a method, and return it.

    Raises:
        InputError: if there is no such method, or a part that it needs is missing.
    """
    if method not in METHODS:
        raise InputError(
            f"expected a method of {', '.join(METHODS)}, found {method!r}; use one of them"
        )
    needed = METHODS[method].parts
    missing = [part for part in needed if part not in parts]
    if missing:
        possible = " or ".join(methods_of(parts))
        advice = f", or choose the method {possible}" if possible else ""
        raise InputError(
            f"expected weights with {', '.join(needed)} for the method {method}, "
            f"found no {missing[0]}; train that part{advice}"
        )

    return method
