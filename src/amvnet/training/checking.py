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
from amvnet.progress import Progress, Tenths, counted
from amvnet.training.plan import Plan
from amvnet.training.run_folder import COUNTS

SHOWN_SCANS = 3  # largest number of broken scans that a message names
# A dataset teaches a class if more than this share of its labelled points have it. A few points may
# have it by mistake.
STRAY_SHARE = 1e-5


def check_data(plan: Plan) -> tuple[np.ndarray, np.ndarray]:
    """Check all labels of the scans of a training, and report what may be a mistake.

    Of simulated streets, only those of the first epoch are checked.

    Returns:
        (K,) int64, the number of points of each class in the training scans of an epoch; and
        (M, K) bool, whether each of the M datasets teaches each class, as `rival_classes` takes it.

    Raises:
        InputError: if a label has an unknown id, a scan cannot be read, or there is nothing to
            learn or to validate with.
    """
    totals = np.zeros(plan.scans.dataset.taxonomy.size + 1, dtype=np.int64)
    taught = []
    for dataset, splits, counted_records in _datasets_of(plan):
        checked = check_scans(dataset, splits, _progress(plan, dataset), plan.processes)
        _refuse(checked)
        totals += checked.count_points(counted_records)
        if isinstance(dataset, SimulatedStreets):  # the streets of later epochs have other classes
            taught.append(np.ones(len(totals) - 1, dtype=bool))
            continue

        for line in checked.warnings():
            plan.report(f"{checked.spec}: {line}")
        points = checked.splits["train"].points[1:]
        taught.append(points > STRAY_SHARE * points.sum())
    return totals[1:], np.array(taught)


def _progress(plan: Plan, dataset: Dataset) -> Progress:
    """Return a function that reports tenths of the scans of a dataset as checked."""
    tenths = Tenths()
    size = plan.processes.size

    def progress(done: int, total: int) -> None:
        if tenths.ends(done, total):
            every = total * size
            plan.report(f"{dataset.spec}: checked {min(done * size, every)} of {every} scans")

    return progress


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
