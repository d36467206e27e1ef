"""Map the static world that a drive has seen."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from amvnet.data.poses import Poses
from amvnet.data.recordings import ScanFile
from amvnet.drives.world_map import MapBuilder
from amvnet.inference.drive import Drives
from amvnet.inference.scan_stream import stream_scans
from amvnet.inference.segmentation import Segmentation
from amvnet.inference.segmenter import Segmenter
from amvnet.progress import Progress, no_progress
from amvnet.scan import Scan

SAVED_SCANS = 50  # number of scans after which the unfinished map is saved again


@dataclass(frozen=True)
class SavedMap:
    """Where an unfinished map is saved; `request` tells it from others, `resume` continues it."""

    path: Path
    request: str
    resume: bool


def map_drive(
    scans: Sequence[ScanFile],
    drives: Drives,
    segmenter: Segmenter,
    builder: MapBuilder,
    saved: SavedMap,
    progress: Progress = no_progress,
) -> None:
    """Segment the scans of a drive, and add them to a map, which `saved` keeps while unfinished.

    Raises:
        InputError: if a scan cannot be read or segmented.
    """

    def segment(scan: ScanFile, loaded: Scan) -> tuple[np.ndarray, Segmentation, Poses]:
        result = segmenter(loaded, yaw=drives.yaws[scan])
        return loaded.points[:, :3], result, drives.motion(scan, loaded)

    done = builder.restore(saved.path, saved.request) if saved.resume else 0
    for points, result, pose in stream_scans(
        scans[done:], lambda scan: scan.load(), segment, segmenter.at_once, progress
    ):
        builder.add(points, result.scores, pose)
        done += 1
        if done % SAVED_SCANS == 0:
            builder.save(saved.path, saved.request, done)
