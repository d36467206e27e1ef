"""Map the static world that a drive has seen."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from amvnet.data.poses import Poses
from amvnet.drives.world_map import MapBuilder, WorldMap
from amvnet.inference.drive import Drives, key_of, points_of
from amvnet.inference.listing import InputScan, LoadedScan
from amvnet.inference.scan_stream import stream_scans
from amvnet.inference.segmentation import Segmentation
from amvnet.inference.segmenter import Segmenter
from amvnet.progress import Progress, no_progress


def map_drive(
    scans: Sequence[InputScan],
    drives: Drives,
    segmenter: Segmenter,
    voxel: float,
    keeps_movable: bool = False,
    progress: Progress = no_progress,
) -> WorldMap:
    """Segment the scans of drives in one world, and collect what they say of each voxel.

    Args:
        scans: the scans.
        drives: their poses.
        segmenter: segments each scan.
        voxel: edge of the voxels, metres.
        keeps_movable: whether voxels of vehicles, two-wheelers and people are kept.
        progress: called with the number of scans that are done, and their total.

    Raises:
        InputError: if a scan cannot be read or segmented.
    """

    def segment(scan: InputScan, loaded: LoadedScan) -> tuple[np.ndarray, Segmentation, Poses]:
        points = points_of(loaded, drives.of_files)
        return points, segmenter(loaded.scan), drives.poses[key_of(scan)]

    builder = MapBuilder(voxel, segmenter.taxonomy)
    for points, result, pose in stream_scans(
        scans, lambda scan: scan.load(), segment, segmenter.at_once, progress
    ):
        builder.add(points, result.scores, pose)
    return builder.build(keeps_movable)


def describe_map(world: WorldMap, scans: int) -> dict[str, Any]:
    """Return the figures of a map, for JSON: its scans, its voxels, and its voxels by class."""
    counts = np.bincount(world.labels, minlength=world.taxonomy.size + 1)
    names = world.taxonomy.names
    classes = {name: int(count) for name, count in zip(names[1:], counts[1:], strict=True)}
    return {"scans": scans, "voxels": len(world), "classes": classes}
