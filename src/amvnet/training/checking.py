"""Check the scans of a training before its first epoch, and count the points of each class."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence

import numpy as np

from amvnet.data.check import Report, check_scans
from amvnet.data.datasets.base import Dataset, ScanRecord
from amvnet.data.datasets.joined import Joined, MixedRecord
from amvnet.data.datasets.simulated import SimulatedStreets
from amvnet.errors import InputError
from amvnet.files import atomic_write
from amvnet.progress import Tenths, counted
from amvnet.training.losses import rival_classes
from amvnet.training.plan import Plan
from amvnet.training.run_folder import COUNTS

SHOWN_SCANS = 3  # largest number of broken scans that a message names


def check_data(plan: Plan) -> tuple[np.ndarray, np.ndarray | None]:
    """Check all labels of the scans of a training, and report what may be a mistake.

    Returns:
        (K,) int64, the number of points of each class in the training scans of an epoch; and
        the `rival_classes` of the datasets.

    Raises:
        InputError: if a label has an unknown id, a scan cannot be read, or there is nothing to
            learn or to validate with.
    """
    tenths = Tenths()

    def progress(done: int, total: int) -> None:
        if tenths.ends(done, total):
            size = plan.processes.size
            plan.report(f"checked {min(done * size, total * size)} of {total * size} scans")

    specs = []
    present = []
    totals = np.zeros(plan.scans.dataset.taxonomy.size + 1, dtype=np.int64)
    for dataset, splits, counted_records in _datasets_of(plan):
        checked = check_scans(dataset, splits, progress, plan.processes)
        _refuse(checked)
        for line in checked.warnings():
            plan.report(line)
        totals += checked.count_points(counted_records)
        specs.append(checked.spec)
        # Only the streets of the first epoch are checked; later ones have other classes.
        is_simulated = isinstance(dataset, SimulatedStreets)
        present.append((checked.splits["train"].points[1:] > 0) | is_simulated)

    classes = plan.scans.dataset.taxonomy.classes
    rivals = rival_classes(np.array(present))
    if rivals is not None:
        for spec, row in zip(specs, rivals, strict=True):
            absent = [classes[index] for index in np.flatnonzero(~row)]
            if absent:
                plan.report(
                    f"train: {', '.join(absent)}: learnt from the other --data alone; the scans of "
                    f"{spec} have no such point, so they do not count against these classes"
                )
    return totals[1:], rivals


def keep_counts(plan: Plan, counts: np.ndarray) -> None:
    """Write the (K,) counts of `check_data` into the folder of the run, for `weights.calibrate`."""
    if plan.processes.first:
        with atomic_write(plan.out / COUNTS) as part:
            names = [record.name for record in plan.scans.train]
            np.savez(part, counts=counts, scans=names, classes=plan.scans.dataset.taxonomy.classes)


def _datasets_of(
    plan: Plan,
) -> Iterator[tuple[Dataset, Mapping[str, Sequence[ScanRecord]], Sequence[ScanRecord]]]:
    """Yield each dataset of a training, its scans by split, and its scans in the first epoch."""
    scans = plan.scans
    dataset = scans.dataset
    if not isinstance(dataset, Joined):
        yield dataset, {"train": scans.train, "val": scans.val}, scans.train
        return

    mixed = [record for record in scans.train if isinstance(record, MixedRecord)]
    own = [record for record in scans.train if not isinstance(record, MixedRecord)]
    yield dataset.dataset, {"train": own, "val": scans.val}, own
    for member, other in enumerate(dataset.others, start=1):
        in_epoch = [record.original for record in mixed if record.member == member]
        # The streets of later epochs are simulated when they are needed.
        is_simulated = isinstance(other.dataset, SimulatedStreets)
        yield other.dataset, {"train": in_epoch if is_simulated else other.train}, in_epoch


def _refuse(checked: Report) -> None:
    """Raise InputError if the check has found an error."""
    for error in checked.errors():
        raise InputError(error)

    broken = checked.broken
    if broken:
        total = sum(len(split.scans) + len(split.broken) for split in checked.splits.values())
        others = list(broken)[1:SHOWN_SCANS]
        more = len(broken) - 1 - len(others)
        rest = f", also {', '.join(others)}" if others else ""
        rest += f" and {more} more" if more > 0 else ""
        raise InputError(
            f"{checked.spec}: expected scans that can be read, found {len(broken)} of "
            f"{counted(total, 'scan')} that cannot: {next(iter(broken.values()))}{rest}; correct "
            "them or leave them out (amvnet check lists all)"
        )
