"""Measure how much accuracy is lost on scans with the units, frames or intensities of other tools.

    python benchmarks/changed_scans.py DATA [WEIGHTS] [--scans 10]

DATA is a dataset in the layout of SemanticKITTI, such as semantickitti:PATH. The scans are spread
evenly over its sequences. Each scan is changed, and then labelled as if `amvnet predict` read it
from a file. At first, `predict` gets no options. If a scan is refused, or more than a tenth of the
accuracy is lost, the measurement is repeated with the option that undoes the change. The option
`--offset` is measured even where nothing is lost, because it must do no harm. The table shows the
accuracy, and its share of the accuracy on unchanged scans.
"""

from __future__ import annotations

import argparse
import hashlib
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table

import amvnet
from amvnet.data.datasets.open import open_dataset
from amvnet.data.formats.cloud import Cloud
from amvnet.data.recordings import Recording
from amvnet.errors import InputError
from amvnet.scan import Scan
from amvnet.sensors.lidars import AXES, KNOWN_HEIGHTS, make_sensor, rotation_from_degrees
from amvnet.sensors.normalise import Normaliser

GOAL = 0.9  # least share of the accuracy on unchanged scans
HEIGHT = KNOWN_HEIGHTS["hdl64e"]  # height of the HDL-64E above the ground, metres


@dataclass(frozen=True)
class Change:
    """A way in which tools change a scan.

    Attributes:
        title: the title of the row in the table.
        apply: a function that takes (N, 3) coordinates and (N,) intensities, and returns the
            changed cloud.
        options: the options of `amvnet predict` that undo the change, by the names that the
            attributes of `Sensor` have.
    """

    title: str
    apply: Callable[[np.ndarray, np.ndarray], Cloud]
    options: dict[str, Any]


def turned(matrix: np.ndarray) -> Callable[[np.ndarray, np.ndarray], Cloud]:
    """Return a change that multiplies the coordinates with a (3, 3) matrix."""
    return lambda xyz, intensity: Cloud(xyz @ matrix.T, intensity)


def tilted(pitch: float, roll: float) -> Callable[[np.ndarray, np.ndarray], Cloud]:
    """Return a change that turns a scan by a pitch and a roll, degrees."""
    return turned(rotation_from_degrees(0, pitch, roll))


def with_outlier(xyz: np.ndarray, intensity: np.ndarray) -> Cloud:
    """Set the intensity of one point to 300."""
    changed = intensity.copy()
    changed[len(changed) // 2] = 300
    return Cloud(xyz, changed)


def scaled(factor: float) -> Callable[[np.ndarray, np.ndarray], Cloud]:
    """Return a change that multiplies the intensities."""
    return lambda xyz, intensity: Cloud(xyz, intensity * np.float32(factor))


def moved(x: float, z: float) -> Callable[[np.ndarray, np.ndarray], Cloud]:
    """Return a change that moves a scan forward by x and up by z, metres."""
    return lambda xyz, intensity: Cloud(xyz + np.array([x, 0, z], xyz.dtype), intensity)


CHANGES = (
    Change("unchanged", Cloud, {}),
    Change("no intensity", lambda xyz, intensity: Cloud(xyz), {}),
    Change(
        "constant intensity 0.15",
        lambda xyz, intensity: Cloud(xyz, np.full_like(intensity, 0.15)),
        {},
    ),
    Change("intensity x 0.01", scaled(0.01), {"intensity_scale": 0.01}),
    Change("intensity x 255", scaled(255), {"intensity_scale": 255}),
    Change(
        "16-bit intensity, dark",
        lambda xyz, intensity: Cloud(xyz, (6000 * intensity).astype(np.uint16)),
        {"intensity_scale": 6000},
    ),
    Change("one intensity of 300", with_outlier, {"intensity_scale": 1}),
    Change("origin on the ground", moved(0, HEIGHT), {"offset": (0, 0, -HEIGHT)}),
    Change(
        "origin on the ground, 1 m behind the sensor",
        moved(1, HEIGHT),
        {"offset": (-1, 0, -HEIGHT)},
    ),
    Change("8 degrees of pitch", tilted(8, 0), {"rotate": (0, -8, 0)}),
    Change("8 degrees of roll", tilted(0, 8), {"rotate": (0, 0, -8)}),
    Change("upside-down", turned(np.diag([1.0, -1.0, -1.0])), {"axes": "z-down"}),
    Change("camera axes", turned(np.array(AXES["z-forward"]).T), {"axes": "z-forward"}),
    Change("millimetres", lambda xyz, intensity: Cloud(1000 * xyz, intensity), {"unit": "mm"}),
    Change("centimetres", lambda xyz, intensity: Cloud(100 * xyz, intensity), {"unit": "cm"}),
    Change("feet", lambda xyz, intensity: Cloud(xyz / 0.3048, intensity), {"unit": "ft"}),
)


@dataclass(frozen=True)
class Outcome:
    """The result of labelling changed scans.

    Attributes:
        accuracies: for each scan that was not refused, the share of its labelled points that got
            the right label.
        refusal: the message of the last scan that was refused; empty if none was.
        assumptions: what `predict` would report that it assumed about the last scan.
    """

    accuracies: list[float]
    refusal: str = ""
    assumptions: str = ""


class Labeller:
    """Labels normalised scans.

    Normalising undoes many changes exactly, and the same scan results. It is labelled only once.
    """

    def __init__(self, weights: str) -> None:
        self.segmenter = amvnet.load(weights)
        self._labels: dict[str, np.ndarray] = {}

    def __call__(self, scan: Scan) -> np.ndarray:
        """Return the (N,) train ids."""
        digest = hashlib.sha256(scan.points.tobytes())
        if scan.row is not None:
            digest.update(scan.row.tobytes())
        key = digest.hexdigest()
        if key not in self._labels:
            self._labels[key] = self.segmenter(scan).labels
        return self._labels[key]


def measure(
    change: Change, options: dict[str, Any], scans: list[Scan], labeller: Labeller
) -> Outcome:
    """Label changed scans, each as if it were alone in its folder."""
    reported = [""]  # the lines that normalisers report; empty if no line comes
    refusal = ""
    accuracies = []
    for scan in scans:
        cloud = change.apply(scan.points[:, :3], scan.points[:, 3])
        expects = labeller.segmenter.weights.expects
        normaliser = Normaliser(expects, make_sensor(**options), reported.append)
        try:
            labels = labeller(normaliser(Recording(scan.name)).to_scan(cloud))
        except InputError as error:
            refusal = str(error)
            continue

        assert scan.labels is not None
        is_labelled = scan.labels > 0
        accuracies.append(float(np.mean(labels[is_labelled] == scan.labels[is_labelled])))
    return Outcome(accuracies, refusal, reported[-1])


def cell(outcome: Outcome, unchanged: float) -> str:
    """Return the accuracy, and in brackets its share of the accuracy on unchanged scans."""
    text = ""
    if outcome.accuracies:
        accuracy = 100 * float(np.mean(outcome.accuracies))
        text = f"{accuracy:.1f} ({100 * accuracy / unchanged:.0f} %)"
    if outcome.refusal:
        text += " refused"
    return text.strip()


def main() -> None:
    """Print the table, and below it for each change the line that was reported about a scan."""
    parser = argparse.ArgumentParser()
    parser.add_argument("data")
    parser.add_argument("weights", nargs="?", default="sim-hdl64e")
    parser.add_argument("--scans", type=int, default=10)
    parser.add_argument("--only", nargs="*", help="titles of changes")
    options = parser.parse_args()

    dataset = open_dataset(options.data)
    records = dataset.records(dataset.sequences("all"))
    indices = np.linspace(0, len(records) - 1, options.scans).round().astype(int)
    scans = [dataset.read(records[index]) for index in indices]
    labeller = Labeller(options.weights)

    table = Table("change", "without options", "with", "accuracy with it")
    remarks = []
    unchanged = 0.0
    for change in CHANGES:
        if options.only and change.title not in ("unchanged", *options.only):
            continue

        without_options = measure(change, {}, scans, labeller)
        accuracy = 100 * float(np.mean(without_options.accuracies or [0]))
        unchanged = unchanged or accuracy  # the first row has the unchanged scans
        row = [change.title, cell(without_options, unchanged), "", ""]
        is_good = not without_options.refusal and accuracy > GOAL * unchanged
        if change.options and (not is_good or "offset" in change.options):
            with_option = measure(change, change.options, scans, labeller)
            row[2:] = [name_option(change.options), cell(with_option, unchanged)]

        table.add_row(*row)
        remarks.append(f"{change.title}: {without_options.refusal or without_options.assumptions}")
        print(*row, sep=" | ", flush=True)

    console = Console(width=150)
    console.print(table)
    for remark in remarks:
        console.print(remark, soft_wrap=True)


def name_option(options: dict[str, Any]) -> str:
    """Return options as the user would type them on the command line."""
    words = []
    for key, value in options.items():
        text = ",".join(f"{number:g}" for number in value) if isinstance(value, tuple) else value
        words.append(f"--{key.replace('_', '-')}={text}")
    return " ".join(words)


if __name__ == "__main__":
    main()
