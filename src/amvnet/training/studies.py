"""Studies that train: the number of neighbours, and the ablation of the range-view network."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

from amvnet.config.schema import Recipe
from amvnet.data.datasets.base import Dataset, ScanRecord
from amvnet.distributed import ALONE, Processes
from amvnet.evaluation import scoring as jobs
from amvnet.evaluation.analysis import Swept
from amvnet.evaluation.metrics import metrics
from amvnet.inference.segmenter import Segmenter
from amvnet.training.run import Run
from amvnet.weights.file import Weights


def sweep_neighbours(
    recipe: Recipe,
    weights: Weights,
    dataset: Dataset,
    train: Sequence[ScanRecord],
    val: Sequence[ScanRecord],
    values: Sequence[int],
    out: Path,
    say: Callable[[str], None] = lambda line: None,
    device: str = "cpu",
) -> Iterator[Swept]:
    """Train a head for each number of neighbours, with the networks of the weights, and score it.

    Each is kept in OUT/neighbours/N; those that are finished are not trained again.

    Raises:
        InputError: where OUT holds heads for other networks, other scans or another recipe.
    """
    # Folds would train networks of their own.
    training = dataclasses.replace(
        recipe.training, head=dataclasses.replace(recipe.training.head, folds=1)
    )
    for n in values:
        head = dataclasses.replace(weights.model.point_head, neighbours=n)
        model = dataclasses.replace(weights.model, point_head=head)
        networks = Weights(model, weights.taxonomy, weights.sensor)
        for part in ("range_net", "polar_net"):
            networks = networks.replace_part(part, weights)
        changed = dataclasses.replace(recipe, model=model, training=training)
        run = Run(changed, dataset, train, val, out / "neighbours" / str(n), True, say)
        segmenter = Segmenter(run.stages("head", networks), device)
        found = jobs.evaluate(dataset, val, jobs.label_by_weights(dataset, segmenter))
        yield Swept.of(
            n, found.uncertain / max(found.asked, 1), found.matrices["amvnet"][0], dataset.taxonomy
        )


def ablate(
    recipe: Recipe,
    dataset: Dataset,
    train: Sequence[ScanRecord],
    val: Sequence[ScanRecord],
    out: Path,
    say: Callable[[str], None] = lambda line: None,
    bars: bool = False,
    device: str = "cpu",
    processes: Processes = ALONE,
) -> Iterator[tuple[bool, bool, dict[str, Any]]]:
    """Train the range-view network with and without GRU and class weights (Table 5 of the paper).

    Each is kept in a folder of OUT; a later call goes on where this one stopped.

    Yields:
        whether with the GRU, whether with class weights, and the figures as `evaluation.metrics` has them.

    Raises:
        InputError: where OUT holds runs on other scans or of another recipe.
    """
    for gru, weighted in ((False, False), (True, False), (False, True), (True, True)):
        model = dataclasses.replace(
            recipe.model, range_net=dataclasses.replace(recipe.model.range_net, gru=gru)
        )
        rv = dataclasses.replace(recipe.training.rv, class_weights=weighted)
        changed = dataclasses.replace(
            recipe, model=model, training=dataclasses.replace(recipe.training, rv=rv)
        )
        name = "-".join(["rv", *(["gru"] if gru else []), *(["weights"] if weighted else [])])
        say(f"{name}:")
        path = Run(changed, dataset, train, val, out / name, True, say, bars, processes).stages(
            "rv"
        )
        segmenter = Segmenter(path, processes.device(device), "rv")
        scored = jobs.evaluate(
            dataset, val, jobs.label_by_weights(dataset, segmenter), processes=processes
        )
        yield gru, weighted, metrics(scored.matrices["rv"][0], dataset.taxonomy)
