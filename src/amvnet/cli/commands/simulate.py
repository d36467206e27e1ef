"""The verb `simulate`."""

from __future__ import annotations

import os
from pathlib import Path

from amvnet.cli.console import progress, say
from amvnet.progress import counted


def simulate(
    out: Path,
    /,
    sensor: str = "hdl64e",
    sequences: int = 1,
    scans: int = 10,
    seed: int = 0,
    processes: int | None = None,
) -> None:
    """Write labelled scans of simulated streets; scans of an earlier call stay.

    Args:
        out: folder to write to.
        sensor: the LiDAR: hdl64e writes SemanticKITTI's layout, hdl32e that of nuScenes-lidarseg.
        sequences: number of sequences; each is another street.
        scans: number of scans in each sequence.
        seed: of all randomness; the same seed gives the same bytes.
        processes: sequences that are simulated at the same time; default: one per processor.
    """
    from amvnet.data.datasets.simulated import simulate as simulate_streets
    from amvnet.files import check_no_links

    check_no_links(out)
    with progress("simulating") as step:
        simulate_streets(
            out,
            sensor=sensor,
            sequences=sequences,
            scans=scans,
            seed=seed,
            processes=(os.cpu_count() or 1) if processes is None else processes,
            progress=step,
        )
    say(f"{counted(sequences * scans, 'scan')} in {out}")
