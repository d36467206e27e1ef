"""The command `export`."""

from __future__ import annotations

from pathlib import Path

from amvnet.cli.console import progress, report


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
    from amvnet.inference.calibration import calibration_scans
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
