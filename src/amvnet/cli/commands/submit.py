"""The command `submit`."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from amvnet.cli.console import progress, report
from amvnet.errors import InputError, counted


def submit(
    data: str,
    /,
    predictions: Path,
    out: Path,
    split: Literal["train", "val", "test"] = "test",
    sequences: tuple[str, ...] | None = None,
    use_external: bool = False,
    overwrite: bool = False,
) -> None:
    """Check predictions by the rules of the benchmark's server, and pack them for it.

    Args:
        data: the dataset, whose scans are the reference.
        predictions: a folder of predictions in the benchmark's layout.
        out: the archive to write, NAME.zip.
        split: the official split; the servers score test, the other splits are for trials.
        sequences: sequences or scenes instead of a split, separated by commas, for trials.
        use_external: declare that the method also learnt from data outside nuScenes (for nuScenes
            only).
        overwrite: replace the archive if it exists.
    """
    from amvnet.data.datasets.open import open_dataset
    from amvnet.evaluation.submission import ARCHIVE, rules_for, write_archive
    from amvnet.files import check_outputs

    rules = rules_for(open_dataset(data), split, sequences)
    if use_external and rules.meta is None:
        raise InputError(
            f"--use-external: expected nuScenes, found {rules.taxonomy.name}; leave it out"
        )

    check_outputs({out: ARCHIVE}, [data], overwrite)
    with progress("packing") as step:
        count = write_archive(rules, predictions, out, use_external=use_external, progress=step)
    packed = counted(count, "prediction")
    follow = "follows" if count == 1 else "follow"
    report(f"{out}: {packed} {follow} the rules of {rules.taxonomy.name}")
    if rules.official is not None and count < rules.official:
        report(
            f"note: the benchmark has {rules.official} scans in this split; "
            "its server refuses an archive with fewer"
        )
