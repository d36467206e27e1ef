"""The command `simulate`."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Annotated

from amvnet.cli.console import progress, report
from amvnet.config.bounds import Count, Range, Seed
from amvnet.errors import counted


def simulate(
    out: Path,
    /,
    sensor: str = "hdl64e",
    height: float | None = None,
    sequences: Count = 1,
    scans: Count = 10,
    seed: Seed = 0,
    spacing: Annotated[float, Range(0.1, 50)] = 8.0,
    processes: Annotated[int, Range(1, 1024)] | None = None,
) -> None:
    """Write labelled scans of simulated streets; scans of an earlier call stay.

    Args:
        out: folder to write to.
        sensor: the LiDAR: a name that amvnet list prints, or a YAML file that states its beams,
            fov_up, fov_down and height. The files have the layout of SemanticKITTI; for hdl32e, of
            nuScenes-lidarseg; for vlp16, of a robot, which robot.yaml in the folder describes.
        height: the height of the sensor above the ground, metres; default: a usual one.
        sequences: number of sequences; each is another street.
        scans: number of scans in each sequence.
        seed: the seed of all random numbers; the same seed gives the same bytes on the same kind of
            processor.
        spacing: distance between two scans, metres; 1 makes a drive, whose scans predict --drive
            fuses.
        processes: number of sequences that are simulated at the same time; default: one per
            processor.
    """
    from amvnet.data.datasets.simulated import simulate as simulate_streets
    from amvnet.files import check_no_links
    from amvnet.sensors.lidars import make_sensor, simulated_lidar

    lidar = simulated_lidar(make_sensor(sensor, height=height))
    check_no_links(out)  # because the simulator does not look
    with progress("simulating") as step:
        simulate_streets(
            out,
            sensor=lidar,
            sequences=sequences,
            scans=scans,
            seed=seed,
            spacing=spacing,
            processes=(os.cpu_count() or 1) if processes is None else processes,
            progress=step,
        )
    lasers = f"{counted(len(lidar.elevations), 'laser')} from {lidar.ends[0]:+.0f} to "
    lasers += f"{lidar.ends[1]:+.0f} degrees, {lidar.height:g} m over the ground"
    report(f"{counted(sequences * scans, 'scan')} in {out}: {lasers}")
