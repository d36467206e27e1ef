"""Fuse two models' scores from files into label files, as `amvnet fuse` does."""

from __future__ import annotations

from collections.abc import Sequence

from amvnet.config.schema import ModelConfig
from amvnet.data.taxonomy import Taxonomy
from amvnet.inference.fusion import Fusion
from amvnet.inference.listing import InputScan, ScanOptions, list_inputs
from amvnet.inference.pipeline import OutputOptions, Pipeline, Segment, check_faults
from amvnet.inference.reading import normaliser_for
from amvnet.inference.score_files import ScorePair
from amvnet.inference.segmentation import Segmentation
from amvnet.inference.segmenter import check_scan
from amvnet.progress import Progress, no_progress
from amvnet.scan import Scan
from amvnet.sensors.lidars import Sensor
from amvnet.sensors.normalise import Expectation, Normaliser
from amvnet.weights.file import Weights


def fuse_files(
    inputs: Sequence[str],
    pair: ScorePair,
    output: OutputOptions,
    options: ScanOptions = ScanOptions(),
    *,
    head: Weights | None = None,
    tau: float | None = None,
    taxonomy: Taxonomy | None = None,
    progress: Progress = no_progress,
) -> tuple[int, float]:
    """Fuse two models' scores of scans, and write the labels as `predict` does.

    Args:
        inputs: as for `predict`.
        pair: the two models' scores.
        output: where the labels are written.
        options: which scans of the inputs to fuse.
        head: weights with a point head; None gives the ensemble.
        tau: threshold of the cosine similarity; None means the head's, or else the paper's.
        taxonomy: the classes if there is no head; None means those of the inputs.

    Returns:
        The number of label files, and the share of the points that are uncertain.

    Raises:
        InputError: before anything is written, if scores of a scan are missing or a file of the
            user would be replaced; at the end, if all are broken.
        SomeBroken: at the end, if the scores of some scans are broken.
    """
    if head is None:
        normaliser = Normaliser(Expectation(ModelConfig().range_view, Sensor()))
    else:  # scan files are normalised as for the networks that the head was trained with
        normaliser = normaliser_for(head)
        taxonomy = head.taxonomy

    scans, taxonomy = list_inputs(inputs, options, taxonomy, normaliser)
    for scan in scans:
        pair.a.find(scan.scores_path)
        pair.b.find(scan.scores_path)

    segment = _segment_by(Fusion(head, tau), pair, taxonomy.size)
    entries, faults = Pipeline(scans, segment, output, taxonomy).run(
        {"fused": pair.to_dict()}, progress
    )
    check_faults(faults, len(scans))
    points = sum(entry.points for entry in entries)
    uncertain = sum(entry.uncertain for entry in entries)
    return len(scans), uncertain / max(points, 1)


def _segment_by(fusion: Fusion, pair: ScorePair, classes: int) -> Segment:
    """Return what fuses the scores that two models wrote for scans.

    Args:
        fusion: fuses the scores of one scan.
        pair: the folders of scores.
        classes: K.
    """

    def segment(inputs: Sequence[InputScan], scans: Sequence[Scan]) -> list[Segmentation]:
        results = []
        for scan_input, scan in zip(inputs, scans, strict=True):
            checked = check_scan(scan)
            f, g = pair.read(scan_input.scores_path, checked, classes)
            results.append(fusion(checked, f, g))
        return results

    return segment
