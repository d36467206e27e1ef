"""The verb `demo`."""

from __future__ import annotations

from pathlib import Path

from amvnet.cli.commands.evaluate import show_evaluation
from amvnet.cli.commands.predict import WEIGHTS
from amvnet.cli.console import progress, say

DEMO_SEED = 20_201_209  # far from the seeds of the streets that the shipped weights were trained on
DEMO_SCANS = 6
DEMO_SEQUENCES = 3


def demo(out: Path = Path("demo"), seed: int | None = None, weights: str = WEIGHTS) -> None:
    """Simulate streets, segment them, score the result and draw it.

    Args:
        out: folder for the scans, predictions and pictures.
        seed: of the streets; by default one that the weights never saw.
        weights: a weights file, or the name of a built-in one.
    """
    from amvnet.data.datasets.select import choose_records
    from amvnet.data.datasets.semantickitti import SemanticKitti
    from amvnet.evaluation import scoring as jobs
    from amvnet.inference.predict import predict as segment
    from amvnet.inference.segmenter import Segmenter
    from amvnet.simulation import simulate as write

    segmenter = Segmenter(weights)
    with progress("simulating") as step:
        seed = DEMO_SEED if seed is None else seed
        write(out / "data", sequences=DEMO_SEQUENCES, scans=DEMO_SCANS, seed=seed, progress=step)
    dataset = SemanticKitti(out / "data")
    records = choose_records(dataset, None, "all")
    with progress("segmenting") as step:
        segment([str(out / "data")], segmenter, out / "predictions", progress=step)
    with progress("scoring") as step:
        label = jobs.label_by_weights(dataset, segmenter)
        found = jobs.evaluate(dataset, records, label, out / "pictures", step)
    show_evaluation(
        found, f"simulated streets, seed {seed}", dataset.taxonomy, out / "metrics.json"
    )
    say(
        f"labels in {out / 'predictions'}, pictures in {out / 'pictures'}, figures in {out / 'metrics.json'}"
    )
