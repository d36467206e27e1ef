"""The command `map`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from amvnet.cli.console import progress, report
from amvnet.cli.options import LabelChoice, ScanChoice, SensorChoice, load_segmenter, open_inputs
from amvnet.config.bounds import Range
from amvnet.engines.compute import Compute, resolved
from amvnet.errors import InputError, counted
from amvnet.sensors.lidars import AUTO

SHOWN_CLASSES = 4  # number of classes in the line about the map


def map(
    inputs: str,
    /,
    out: Path,
    choice: ScanChoice,
    sensor_choice: SensorChoice,
    compute: Compute,
    weights: str = AUTO,
    poses: Path | None = None,
    voxel: Annotated[float, Range(0.02, 10)] = 0.2,
    keep_movable: bool = False,
    json: Path | None = None,
    resume: bool = False,
    overwrite: bool = False,
) -> None:
    """Make one labelled cloud of the static world that a drive has seen.

    Args:
        inputs: the scans of a drive: a dataset with --sequences, a bag, a folder or a pattern.
        out: the map, FILE.ply, FILE.las or FILE.laz: a point for each voxel, with its class, its
            confidence and the number of scans that saw it.
        choice: which scans of the input to use.
        sensor_choice: what is known about the sensor of scan files.
        compute: where and how the networks are computed.
        weights: a weights file, the name of built-in weights, or auto, for the built-in weights
            that suit the lasers.
        poses: the poses of the LiDAR, as predict takes them; default: the dataset's, or estimated
            by KISS-ICP.
        voxel: edge of the voxels, metres.
        keep_movable: keep voxels of vehicles, two-wheelers and people, which may have moved.
        json: file for the figures of the map: scans, metres, voxels by class.
        resume: continue a map that was stopped.
        overwrite: replace files that exist.
    """
    from amvnet.drives.world_map import FIGURES, SIGNATURES, MapBuilder, check_ending
    from amvnet.files import alone_in, check_outputs, digest, write_json
    from amvnet.inference.drive import SavedMap, find_poses, map_drive

    check_ending(out)
    if json is not None and json.resolve() == out.resolve():
        raise InputError(f"{out}: expected two files, found one for --out and --json; give another")
    outputs = {out: SIGNATURES[out.suffix]}
    if json is not None:
        outputs[json] = FIGURES

    found, weights, loaded = open_inputs([inputs], choice, sensor_choice, weights)
    scans = found.for_weights(loaded, report)
    files = [path for scan in scans for path in scan.files]
    request = LabelChoice().parse(loaded, found.reading, resolved(compute))

    # The files beside a map have a digest in their names: with its name, names could be too long.
    beside = f".{digest(out.name)}"
    with alone_in(out.parent, f"{beside}.lock"):
        check_outputs(outputs, [*files, weights, poses], overwrite)
        with progress("poses") as step:
            drives = find_poses(scans, poses, progress=step, report=report, is_one=True)
        made_from = f"{request.digest_of(scans, drives)}, {voxel:g} m"  # changes if voxels would
        saved = SavedMap(out.with_name(f"{beside}.unfinished.npz"), made_from, resume)
        builder = MapBuilder(voxel, loaded.taxonomy)
        segmenter = load_segmenter(loaded, request.method, compute)
        with progress("mapping") as step:
            map_drive(scans, drives, segmenter, builder, saved, step)
        world = builder.build(keep_movable)
        world.write(out)
        saved.path.unlink(missing_ok=True)
        figures = world.figures(len(scans))
        if json is not None:
            write_json(json, figures)

    largest = sorted(figures["classes"].items(), key=lambda item: -item[1])[:SHOWN_CLASSES]
    shares = ", ".join(f"{count / max(len(world), 1):.0%} {name}" for name, count in largest)
    report(
        f"{out}: {len(world):,} voxels of {voxel:g} m from {counted(len(scans), 'scan')}: {shares}"
    )
