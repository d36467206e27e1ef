"""The command `info`."""

from __future__ import annotations

from amvnet.cli.console import report_lines, show


def info(weights: str | None = None, /) -> None:
    """Print the model card of a weights file in Markdown; without a file, what is installed.

    Then it lists the built-in weights, and the extras with what installs them.

    Args:
        weights: a weights file, or the name of built-in weights.
    """
    from amvnet.cli import tables
    from amvnet.weights.card import BUILT_IN_LICENCE, model_card
    from amvnet.weights.file import built_in, load

    if weights is None:
        show(tables.weights_table())
        show(tables.extras_table())
        show(tables.installation_table())
        return
    license_id = BUILT_IN_LICENCE if weights in built_in() else None
    report_lines(model_card(load(weights), weights, license_id).rstrip())
