"""The verb that writes the networks for other runtimes: export."""

from __future__ import annotations

from pathlib import Path

from amvnet.terminal import progress, say


def export(weights: str, out: Path) -> None:
    """Write the networks and the head as ONNX, and a JSON that says all that a program in C++ needs.

    Args:
        weights: a weights file, or the name of a built-in one.
        out: folder for the graphs and amvnet.json.
    """
    from amvnet.export import export as run

    with progress("exporting") as step:
        differences = run(weights, out, step)
    largest = max(differences.values())
    say(f"{len(differences)} graphs and amvnet.json in {out}; they differ from torch by at most {largest:.1e}")
