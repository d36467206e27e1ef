"""The job behind `amvnet fuse`: two models' scores from files, fused to labels where `predict` would write them."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from amvnet.config.schema import ModelConfig
from amvnet.data.taxonomy import Taxonomy
from amvnet.inference.fusion import Fusion
from amvnet.inference.pipeline import Segment
from amvnet.inference.predict import run_tasks
from amvnet.inference.score_files import ScorePair
from amvnet.inference.segmenter import Segmentation, check_scan
from amvnet.inference.tasks import Lone, tasks_in
from amvnet.progress import Progress
from amvnet.scan import Scan
from amvnet.sensors.adapt import ScanAdapter
from amvnet.weights.file import Weights


def fuse_files(
    inputs: Sequence[str],
    pair: ScorePair,
    head: Weights | None,
    taxonomy: Taxonomy,
    out: Path,
    sequences: Sequence[str] | None = None,
    progress: Progress = lambda done, total: None,
    split: str = "all",
    tau: float | None = None,
    topic: str | None = None,
) -> tuple[int, float]:
    """Fuse two models' scores of the scans that `predict` would segment, and write the labels where it would.

    Args:
        others: as of `prediction.predict` and `fusion.Fusion`.

    Returns:
        how many label files there are now, and the share of the points that are uncertain.

    Raises:
        InputError: before anything is written where scores of a scan are not there; later where all are broken.
        SomeBroken: at the end, where those of some scans are.
    """
    fusion, counts = Fusion(head, tau), [0, 0]

    def by(scores: Path, lone: bool) -> Segment:
        place = scores.relative_to(out)
        for folder in (pair.a, pair.b):
            folder.find(place)
        return lambda scan: segment(place, check_scan(scan))

    def segment(place: Path, scan: Scan) -> Segmentation:
        found = fusion(scan, *pair.read(place, scan, taxonomy.size))
        counts[0], counts[1] = counts[0] + int(found.uncertain.sum()), counts[1] + len(scan)
        return found

    # The head sees lone scans as the networks beside it would have.
    fitting = ScanAdapter(head or Weights(ModelConfig(), taxonomy))
    tasks = tasks_in(inputs, Lone(taxonomy, by, fitting, out, topic), sequences, split)
    written = run_tasks(tasks, out, {"fused": pair.said()}, progress=progress)
    return written, counts[0] / max(counts[1], 1)
