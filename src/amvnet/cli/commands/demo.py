"""The verb `demo`."""

from __future__ import annotations

from pathlib import Path

from amvnet.cli.commands.evaluate import show_evaluation
from amvnet.cli.console import progress, say
from amvnet.cli.options import WEIGHTS

SEED = 20_201_209  # far from the seeds of the streets that the built-in weights were trained on
SCANS = 6
SEQUENCES = 3


def demo(out: Path = Path("demo"), seed: int = SEED, weights: str = WEIGHTS) -> None:
    """Simulate streets, segment them, score the result and draw it.

    Args:
        out: folder for the scans, predictions and pictures.
        seed: of the streets; the default gives streets the built-in weights were not trained on.
        weights: a weights file, or the name of a built-in one.
    """
    from amvnet.data.datasets.semantickitti import SemanticKitti
    from amvnet.data.datasets.simulated import simulate
    from amvnet.evaluation.scoring import evaluate, label_by_weights
    from amvnet.inference.predict import predict
    from amvnet.inference.request import LabellingRequest
    from amvnet.inference.segmenter import Segmenter

    segmenter = Segmenter(weights)
    data = out / "data"
    with progress("simulating") as step:
        simulate(data, sequences=SEQUENCES, scans=SCANS, seed=seed, progress=step)

    predictions = out / "predictions"
    with progress("segmenting") as step:
        request = LabellingRequest(segmenter.weights)
        predict([str(data)], request, segmenter, predictions, overwrite=True, progress=step)

    dataset = SemanticKitti(data)
    records = dataset.records(dataset.sequences("all"))
    pictures = out / "pictures"
    with progress("scoring") as step:
        label = label_by_weights(dataset, segmenter)
        evaluation = evaluate(dataset, records, label, pictures, progress=step)
    metrics_path = out / "metrics.json"
    show_evaluation(evaluation, f"simulated streets, seed {seed}", metrics_path)
    say(f"labels in {predictions}, pictures in {pictures}, figures in {metrics_path}")
