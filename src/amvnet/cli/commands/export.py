"""The command `export`."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from amvnet.cli.console import progress, report
from amvnet.errors import InputError

if TYPE_CHECKING:
    from amvnet.scan import Scan
    from amvnet.weights.file import Weights


def export(weights: str, out: Path, int8: str | None = None, overwrite: bool = False) -> None:
    """Write the networks and the head as ONNX graphs, with a JSON that a C++ program can follow.

    Args:
        weights: a weights file, or the name of built-in weights.
        out: folder for the graphs and amvnet.json.
        int8: scans that calibrate convolutions in 8-bit integers, for CPUs: a dataset, scan files
            or a folder of them as predict takes them, or the word simulated; default: float32.
        overwrite: replace files that exist.
    """
    from amvnet.engines.export.onnx import check_libraries, possible_files
    from amvnet.engines.export.onnx import export as export_weights
    from amvnet.files import check_outputs
    from amvnet.weights.file import load

    check_outputs(possible_files(out), [weights, int8], overwrite)
    check_libraries()
    loaded = load(weights)
    scans = [] if int8 is None else calibration_scans(int8, loaded)
    with progress("exporting") as step:
        graphs = export_weights(loaded, out, step, scans)
    report(f"{len(graphs)} graphs and amvnet.json in {out}")
    differences = [graph["difference"] for graph in graphs.values() if "difference" in graph]
    if differences:
        report(f"graphs in float32 differ from torch by at most {max(differences):.1e}")
    for name, graph in graphs.items():
        if "agreement" in graph:
            report(
                f"{name} is in int8; on scans that did not calibrate it, "
                f"{graph['agreement']:.1%} of its labels are unchanged"
            )


def calibration_scans(text: str, weights: Weights) -> list[Scan]:
    """Read up to `MAX_SCANS` scans, evenly spaced and prepared for the networks, or simulate them.

    Args:
        text: a dataset, a scan file, a folder of scan files, or `SIMULATED`.

    Raises:
        InputError: if there are no scans, one is broken, or the weights' sensor cannot be
            simulated.
    """
    from amvnet.data.recordings import evenly_spaced
    from amvnet.engines.export.int8 import MAX_SCANS, SIMULATED, simulated_scans
    from amvnet.inference.listing import find_inputs

    if text == SIMULATED:
        return simulated_scans(weights)

    scans = []
    for scan_input in evenly_spaced(find_inputs([text]).for_weights(weights), MAX_SCANS):
        scan = scan_input.load()
        if scan.valid.any():
            scans.append(weights.expects.prepare(scan))

    if not scans:
        raise InputError(
            f"{text}: expected scans to calibrate with, found none with a finite point; "
            "name other scans"
        )
    return scans
