"""The verb `info`."""

from __future__ import annotations

from amvnet.cli.console import console, say


def info(weights: str | None = None) -> None:
    """Say what a weights file is; without one, what is installed.

    Args:
        weights: a weights file, or the name of a built-in one: its model card, in Markdown.
    """
    from amvnet.cli.tables import installation_table
    from amvnet.weights.card import OURS, model_card
    from amvnet.weights.file import built_in, load

    if weights is not None:
        say(model_card(load(weights), weights, OURS if weights in built_in() else None).rstrip())
        return
    console.print(installation_table())
