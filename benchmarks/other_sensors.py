"""Measure the gain by normalisation on simulated scans of sensors that the weights do not know.

    python benchmarks/other_sensors.py [FOLDER] [WEIGHTS]

Each scan is segmented unchanged, and then normalised as `amvnet predict` normalises it. FOLDER
(other_sensors) keeps the scans, which are six for each sensor, of three streets that no training
has seen. WEIGHTS is a name or a file (sim-hdl64e).
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

import numpy as np

import amvnet
from amvnet.data.datasets.semantickitti import SemanticKitti
from amvnet.data.formats.cloud import Cloud
from amvnet.evaluation.metrics import Evaluation
from amvnet.inference.segmenter import Segmenter
from amvnet.sensors.normalise import Normaliser
from lidarstreets import simulate
from lidarstreets.sensing.sensors import LIDAR_MODELS, LidarModel

SEED = 78
VLP32C = (
    15, 10.333, 7, 4.667, 3.333, 2.333, 1.667, 1.333, 1, 0.667, 0.333, 0, -0.333, -0.667, -1,
    -1.333, -1.667, -2, -2.333, -2.667, -3, -3.333, -3.667, -4, -4.667, -5.333, -6.148, -7.254,
    -8.843, -11.31, -15.639, -25,
)  # fmt: skip


def sensor(elevations: tuple[float, ...], height: float, steps: int) -> LidarModel:
    """Return an HDL-64E with other lasers, at another height, without a car below it."""
    return replace(
        LIDAR_MODELS["hdl64e"],
        elevations=elevations,
        height=height,
        azimuth_steps=steps,
        azimuth_unit=0.0,
        shadow=(),
    )


def evenly(end: float, beams: int) -> tuple[float, ...]:
    """Return elevations that are evenly spaced from `end` down to `-end` degrees."""
    return tuple(np.linspace(end, -end, beams).tolist())


OTHERS = {
    "hdl64e-1.0m": sensor(LIDAR_MODELS["hdl64e"].elevations, 1.0, 2180),
    "hdl64e-2.5m": sensor(LIDAR_MODELS["hdl64e"].elevations, 2.5, 2180),
    "vlp32c-1.07m": sensor(VLP32C, 1.07, 1800),
    "64-22.5-1.0m": sensor(evenly(22.5, 64), 1.0, 1024),
    "64-22.5-1.73m": sensor(evenly(22.5, 64), 1.73, 1024),
    "64-22.5-2.5m": sensor(evenly(22.5, 64), 2.5, 1024),
    "128-45-1.73m": sensor(evenly(45, 128), 1.73, 1024),
    "vlp16-0.6m": sensor(evenly(15, 16), 0.6, 1800),
    "vlp16-1.73m": sensor(evenly(15, 16), 1.73, 1800),
}


def compare(name: str, folder: Path, segmenter: Segmenter) -> None:
    """Print mIoU over the classes present and accuracy of AMVNet, unchanged and normalised."""
    dataset = SemanticKitti(simulate(folder, sensor=name, sequences=3, scans=2, seed=SEED))
    normalise = Normaliser(segmenter.weights.expects)
    unchanged = Evaluation(dataset.taxonomy)
    normalised = Evaluation(dataset.taxonomy)

    for record in dataset.records(dataset.sequences("all")):
        scan = dataset.read(record)
        assert scan.labels is not None
        labels = segmenter(scan).labels
        unchanged.add(scan.points, scan.labels, {"amvnet": labels})

        cloud = Cloud(scan.points[:, :3], scan.points[:, 3], name=name)
        labels = segmenter(normalise(cloud, name)).labels
        normalised.add(scan.points, scan.labels, {"amvnet": labels})

    for title, evaluation in (("unchanged", unchanged), ("measured", normalised)):
        report = evaluation.report(name)["methods"]["amvnet"]
        miou = 100 * report["miou_present"]
        accuracy = 100 * report["accuracy"]
        print(f"{name:14} {title:9} {miou:.1f} ({accuracy:.1f})", flush=True)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", nargs="?", type=Path, default="other_sensors")
    parser.add_argument("weights", nargs="?", default="sim-hdl64e")
    arguments = parser.parse_args()

    LIDAR_MODELS.update(OTHERS)
    segmenter = amvnet.load(arguments.weights)
    for name in OTHERS:
        compare(name, arguments.folder / name, segmenter)
