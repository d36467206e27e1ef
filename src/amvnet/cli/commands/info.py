"""The command `info`."""

from __future__ import annotations

from amvnet.cli.console import report_lines, show


def info(weights: str | None = None, /) -> None:
    """Print the model card of a weights file in Markdown; without a file, show what is installed.

    Args:
        weights: a weights file, or the name of built-in weights.
    """
    from amvnet.cli.tables import installation_table
    from amvnet.weights.card import BUILT_IN_LICENCE, model_card
    from amvnet.weights.file import built_in, load

    if weights is None:
        show(installation_table())
        return
    license_id = BUILT_IN_LICENCE if weights in built_in() else None
    report_lines(model_card(load(weights), weights, license_id).rstrip())
