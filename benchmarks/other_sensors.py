"""Measure weights on simulated scans of the sensors that people own.

    python benchmarks/other_sensors.py [FOLDER] [WEIGHTS ...]

Each of twelve sensors has one usual height, and six scans, each of another street that no training
has seen. The scans are normalised as `amvnet predict` normalises them. FOLDER (other_sensors) keeps
the scans. WEIGHTS are names or files (sim-hdl64e).
"""

from __future__ import annotations

import argparse
import os
from dataclasses import replace
from pathlib import Path

import numpy as np

import amvnet
from amvnet.data.datasets.semantickitti import SemanticKitti
from amvnet.data.formats.cloud import Cloud
from amvnet.data.recordings import Recording
from amvnet.evaluation.metrics import Evaluation
from amvnet.inference.segmenter import Segmenter
from amvnet.sensors.lidars import make_sensor, simulated_lidar
from amvnet.sensors.normalise import Normaliser
from lidarstreets import simulate

SEED = 78
STREETS = 6
# Sensors, each with a usual height over the ground in metres.
SENSORS = (
    ("vlp16", 0.7),
    ("vlp16", 1.9),
    ("vlp32c", 1.8),
    ("os1-32", 0.5),
    ("os1-64", 1.2),
    ("os1-128", 1.9),
    ("os0-128", 0.9),
    ("pandar64", 1.8),
    ("pandar128", 1.9),
    ("xt32", 1.2),
    ("rs32", 1.3),
    ("rs128", 1.9),
)


def streets_of(folder: Path, name: str, height: float) -> SemanticKitti:
    """Return the simulated scans of a sensor in the layout of SemanticKITTI."""
    lidar = simulated_lidar(make_sensor(name, height=height))
    lidar = replace(lidar, layout="semantickitti", region="")
    processes = os.cpu_count() or 1
    simulate(folder, sensor=lidar, sequences=STREETS, scans=1, seed=SEED, processes=processes)
    return SemanticKitti(folder)


def score(dataset: SemanticKitti, segmenter: Segmenter) -> tuple[float, float]:
    """Return AMVNet's mIoU over the classes present and its accuracy, in percent."""
    normalise = Normaliser(segmenter.weights.expects)
    evaluation = Evaluation(dataset.taxonomy)
    recordings = {name: normalise(Recording(name)) for name in dataset.sequences("all")}
    for record in dataset.records(list(recordings)):
        scan = dataset.read(record)
        assert scan.labels is not None
        cloud = Cloud(scan.points[:, :3], scan.points[:, 3], name=record.name)
        labels = segmenter(recordings[record.sequence].to_scan(cloud)).labels
        evaluation.add(scan.points, scan.labels, {"amvnet": labels})

    report = evaluation.report(dataset.spec)["methods"]["amvnet"]
    return 100 * report["miou_present"], 100 * report["accuracy"]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", nargs="?", type=Path, default="other_sensors")
    parser.add_argument("weights", nargs="*", default=["sim-hdl64e"])
    arguments = parser.parse_args()

    segmenters = {name: amvnet.load(name) for name in arguments.weights}
    results: dict[str, list[tuple[float, float]]] = {name: [] for name in segmenters}
    print(f"{'sensor':18}", *(f"{Path(name).name:>24}" for name in segmenters))
    for sensor, height in SENSORS:
        title = f"{sensor} {height:g} m"
        dataset = streets_of(arguments.folder / f"{sensor}-{height:g}", sensor, height)
        cells = []
        for name, segmenter in segmenters.items():
            results[name].append(score(dataset, segmenter))
            miou, accuracy = results[name][-1]
            cells.append(f"{miou:15.1f} ({accuracy:5.1f})")
        print(f"{title:18}", *(f"{cell:>24}" for cell in cells), flush=True)

    means = [np.mean(values, axis=0) for values in results.values()]
    print(
        f"{'mean':18}", *(f"{miou:15.1f} ({accuracy:5.1f})".rjust(24) for miou, accuracy in means)
    )


if __name__ == "__main__":
    main()
