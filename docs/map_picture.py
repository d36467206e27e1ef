"""Draw the map of a drive in perspective: the second picture of README.md.

    amvnet simulate drive --scans 60 --spacing 1 --seed 90
    amvnet map drive --weights sim-hdl64e --out map.ply --voxel 0.1
    python docs/map_picture.py map.ply [--out FILE.png]

The street and the scans are simulated. Each voxel is a disc in the colour of its class.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

import numpy as np
from perspective import CAMERA, class_colors, render
from plyfile import PlyData

from amvnet.data.taxonomy import SEMANTICKITTI

RADIUS = 0.075  # of a disc, metres
SEEN_BY = 2  # the least number of scans that see a voxel that is drawn
BEHIND = 26.0  # the distance of the eye behind the start of the drive, metres
ABOVE = 15.0  # its height above the sensor, metres
AHEAD = 30.0  # the distance of what it looks at, metres


def main() -> None:
    """Write the picture."""
    parser = argparse.ArgumentParser()
    parser.add_argument("map", type=Path)
    parser.add_argument("--out", type=Path, default=Path(__file__).parent / "figures/map.png")
    options = parser.parse_args()

    vertices = PlyData.read(options.map)["vertex"]
    is_drawn = vertices["sights"] >= SEEN_BY
    xyz = np.column_stack([vertices[axis] for axis in "xyz"])[is_drawn]
    labels = SEMANTICKITTI.to_train(np.asarray(vertices["class"]))[is_drawn]
    camera = replace(CAMERA, eye=(-BEHIND, -4.0, ABOVE), target=(AHEAD, 2.0, -2.0))
    colors = class_colors(SEMANTICKITTI, labels)
    render(camera, xyz, colors, np.full(len(xyz), RADIUS)).save(options.out, optimize=True)


if __name__ == "__main__":
    main()
