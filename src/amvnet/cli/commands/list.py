"""The command `list`."""

from __future__ import annotations

from typing import Literal

from amvnet.cli.console import show

Kind = Literal["all", "weights", "recipes", "sensors"]


def list(kind: Kind = "all") -> None:
    """List the built-in weights, the recipes and the sensors that are known by name.

    Args:
        kind: what to list.
    """
    from amvnet.cli import tables

    if kind in ("all", "weights"):
        show(tables.weights_table())
    if kind in ("all", "recipes"):
        show(tables.recipes_table())
    if kind in ("all", "sensors"):
        show(tables.sensors_table())
