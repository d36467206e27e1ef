"""Fuse two models' scores from files into label files, as `amvnet fuse` does."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from amvnet.config.schema import ModelConfig
from amvnet.data.taxonomy import Taxonomy
from amvnet.inference.certainty import UncertainCount
from amvnet.inference.fusion import Fusion
from amvnet.inference.inputs import InputScan, ScanOptions, adapter_for, open_inputs
from amvnet.inference.pipeline import OutputOptions, Pipeline
from amvnet.inference.score_files import ScorePair
from amvnet.inference.segmentation import Segmentation
from amvnet.inference.segmenter import check_scan
from amvnet.progress import Progress, no_progress
from amvnet.scan import Scan
from amvnet.sensors.adapt import ScanAdapter
from amvnet.weights.file import Weights


@dataclass(frozen=True)
class FusionOptions:
    """How two models' scores are fused.

    Attributes:
        head: weights with a point head; None gives the ensemble.
        tau: threshold of the cosine similarity; None means the head's, or else the paper's.
        taxonomy: the classes if there is no head; None means those of the inputs.
    """

    head: Weights | None = None
    tau: float | None = None
    taxonomy: Taxonomy | None = None


class FileFusion:
    """Fuses the scores that two models wrote for scans, and counts the uncertain points.

    Args:
        fusion: fuses the scores of one scan.
        pair: the folders of scores.
        classes: K.
    """

    def __init__(self, fusion: Fusion, pair: ScorePair, classes: int) -> None:
        self.fusion = fusion
        self.pair = pair
        self.classes = classes
        self.counted = UncertainCount()

    def __call__(self, inputs: Sequence[InputScan], scans: Sequence[Scan]) -> list[Segmentation]:
        results = []
        for scan_input, scan in zip(inputs, scans, strict=True):
            checked = check_scan(scan)
            f, g = self.pair.read(scan_input.scores_path, checked, self.classes)
            result = self.fusion(checked, f, g)
            self.counted.add(result.labels, result.uncertain)
            results.append(result)

        return results


def fuse_files(
    inputs: Sequence[str],
    pair: ScorePair,
    output: OutputOptions,
    fusion: FusionOptions,
    options: ScanOptions = ScanOptions(),
    progress: Progress = no_progress,
) -> tuple[int, float]:
    """Fuse two models' scores of scans, and write the labels as `predict` does.

    Args:
        inputs: as for `predict`.
        pair: the two models' scores.
        output: where the labels are written.
        fusion: the head, its threshold, and the classes.
        options: which scans of the inputs to fuse.

    Returns:
        The number of label files, and the share of the points that are uncertain.

    Raises:
        InputError: before anything is written, if scores of a scan are missing or a file of the
            user would be replaced; at the end, if all are broken.
        SomeBroken: at the end, if the scores of some scans are broken.
    """
    head = fusion.head
    taxonomy = fusion.taxonomy if head is None else head.taxonomy
    # Scan files are adapted as for the networks that the head was trained with.
    adapter = ScanAdapter(ModelConfig().range_view) if head is None else adapter_for(head)

    opened = open_inputs(inputs, options, taxonomy, adapter)
    for scan in opened.scans:
        pair.a.find(scan.scores_path)
        pair.b.find(scan.scores_path)

    segment = FileFusion(Fusion(head, fusion.tau), pair, opened.taxonomy.size)
    pipeline = Pipeline(opened.scans, segment, output, opened.taxonomy)
    written = pipeline.run({"fused": pair.to_dict()}, progress)
    return written, segment.counted.share
