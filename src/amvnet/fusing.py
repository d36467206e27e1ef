"""The job behind `amvnet fuse`: two models' scores from files, fused to labels where `predict` would write them."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from amvnet.data.labels import Taxonomy
from amvnet.fusion import Fusion
from amvnet.jobs import Progress, tasks_in
from amvnet.score_files import ScorePair
from amvnet.segmenter import checked_scan


def fuse(
    inputs: Sequence[str],
    pair: ScorePair,
    fusion: Fusion,
    taxonomy: Taxonomy,
    out: Path,
    sequences: Sequence[str] | None = None,
    progress: Progress = lambda done, total: None,
    split: str = "all",
) -> tuple[list[Path], float]:
    """Fuse two models' scores of the scans that `predict` would segment, and write the labels where it would.

    Returns:
        the files of labels, and the share of the points that are uncertain.

    Raises:
        InputError: before anything is written where scores of a scan are not there; else at the scan whose are broken.
    """
    tasks, written, uncertain, points = tasks_in(inputs, taxonomy, Path(out), sequences, split), [], 0, 0
    places = [task.scores.relative_to(out) for task in tasks]
    for folder in (pair.a, pair.b):
        for place in places:
            folder.find(place)
    for done, (task, place) in enumerate(zip(tasks, places, strict=True)):
        progress(done, len(tasks))
        scan = checked_scan(task.read())
        found = fusion(scan, *pair.read(place, scan, taxonomy.size))
        written.append(task.write(found.labels))
        uncertain, points = uncertain + int(found.uncertain.sum()), points + len(scan)
    progress(len(tasks), len(tasks))
    return written, uncertain / max(points, 1)
