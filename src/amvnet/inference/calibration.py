"""Read the scans that calibrate networks in int8."""

from __future__ import annotations

from amvnet.data.recordings import evenly_spaced
from amvnet.engines.export.int8 import MAX_SCANS, SIMULATED, simulated_scans
from amvnet.errors import InputError
from amvnet.inference.listing import find_inputs
from amvnet.scan import Scan
from amvnet.weights.file import Weights


def calibration_scans(text: str, weights: Weights) -> list[Scan]:
    """Read up to `MAX_SCANS` scans, evenly spaced and prepared for the networks, or simulate them.

    Args:
        text: a dataset, a scan file, a folder of scan files, or `SIMULATED`.

    Raises:
        InputError: if there are no scans, one is broken, or the weights' sensor cannot be
            simulated.
    """
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
