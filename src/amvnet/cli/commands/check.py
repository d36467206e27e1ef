"""The command `check`."""

from __future__ import annotations

import shlex
from collections.abc import Mapping, Sequence
from contextlib import suppress
from typing import TYPE_CHECKING

from amvnet.cli.console import progress, report, show
from amvnet.cli.options import TrainingChoice
from amvnet.errors import InputError, SomeBroken, counted

if TYPE_CHECKING:
    from amvnet.data.datasets.base import Dataset
    from amvnet.data.recordings import ScanFile

MEASURED_RECORDINGS = 10  # number of recordings whose sensors are reported


def check(data: str, /, choice: TrainingChoice) -> None:
    """Check the labels of all scans to train on, to validate with and to test on.

    If there are too few sequences for a training, their labels are checked before this is said.
    Of scans that a YAML file describes, the sensor and the body of the car are measured, too. For a
    folder of scans without such a file, the beginning of one is written beside it.

    Args:
        data: the dataset.
        choice: which scans to check in addition to the labelled scans of the test split.
    """
    from amvnet.data.datasets.open import open_dataset, undescribed
    from amvnet.data.datasets.starter import write_starter
    from amvnet.sensors.normalise import described_sensor
    from amvnet.sensors.own_body import measure_body

    folder = undescribed(data)
    if folder is not None:
        path, found = write_starter(folder)
        for line in found.lines():
            report(line)
        raise InputError(
            f"wrote {path}: name its classes, then run amvnet check {shlex.quote(str(path))}"
        )
    dataset = open_dataset(data)
    scans = [scan.read for recording in dataset.recordings() for scan in recording.scans]
    _report_sensors(dataset)
    body = measure_body(scans, described_sensor(dataset))
    if body is not None:
        report(
            f"{body.share:.0%} of the points move with the sensor, so they are the car itself; "
            f"to give them no label, state under sensor: own_body: {list(body.box)}"
        )
    try:
        splits = choice.splits(dataset)
    except InputError:
        records = dataset.records(dataset.split().trainable)
        # The error is not about names that the user gave.
        if choice == TrainingChoice() and dataset.having_labels(records):
            _check(dataset, {"all": records})
        raise
    usable = _check(dataset, splits)
    if usable:
        report(f"{counted(usable, 'scan')} can be trained on or scored")


def _report_sensors(dataset: Dataset) -> None:
    """Report what trainings and scores assume of the sensors of some recordings."""
    from amvnet.data.recordings import evenly_spaced
    from amvnet.sensors.expectation import Expectation
    from amvnet.sensors.lidars import ANY
    from amvnet.sensors.normalise import Normaliser, normalised

    normaliser = Normaliser(Expectation.of_sensor(ANY), report=report)
    recordings = normalised(dataset, normaliser).recordings()
    for recording in evenly_spaced(recordings, MEASURED_RECORDINGS):
        with suppress(InputError):  # a broken scan is named when its labels are checked
            recording.scan(recording.scans[0])


def _check(dataset: Dataset, splits: Mapping[str, Sequence[ScanFile]]) -> int:
    """Print what is in the labels of some scans, and return the number of scans that can be used.

    If something must be corrected, raise InputError; if only some scans are broken, SomeBroken.
    """
    from amvnet.cli.tables import contents_table, unknown_table
    from amvnet.data.check import check_scans

    with progress("checking") as step:
        checked = check_scans(dataset, splits, step)

    show(contents_table(checked))
    if checked.unknown:
        show(unknown_table(checked))
    doubts = list(checked.doubts())
    for line in checked.warnings():
        report(f"warning: {line}" if line in doubts else line)

    broken = checked.broken
    error = next(checked.errors(), None)
    if error is not None:
        for message in broken.values():
            report(f"broken: {message}")
        raise InputError(error)
    if broken:
        found = counted(len(broken), "broken scan")
        pronoun = "it" if len(broken) == 1 else "them"
        raise SomeBroken(
            f"expected scans that can be read, found {found}; correct {pronoun} or leave {pronoun} "
            "out",
            list(broken.values()),
        )
    return sum(len(split.scans) - len(split.stray) for split in checked.splits.values())
