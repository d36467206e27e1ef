"""The verb that writes the networks for other runtimes: export."""

from __future__ import annotations

from pathlib import Path

from amvnet.cli.console import progress, say


def export(weights: str, out: Path, int8: str | None = None) -> None:
    """Write the networks and the head as ONNX, and a JSON that says all that a program in C++ needs.

    Args:
        weights: a weights file, or the name of a built-in one.
        out: folder for the graphs and amvnet.json.
        int8: put the convolutions into 8-bit integers, for CPUs, calibrated with these scans: a data set, scan files
            or a folder of them as predict takes them, or the word simulated.
    """
    from amvnet.export.onnx import export as run

    with progress("exporting") as step:
        measured = run(weights, out, step, int8)
    largest = max(measured.differences.values())
    say(
        f"{len(measured.differences)} graphs and amvnet.json in {out}; they differ from torch by at most {largest:.1e}"
    )
    for name, share in measured.agreement.items():
        say(
            f"{name} is in int8 now; on scans it was not calibrated with, {share:.1%} of its labels are as before"
        )
