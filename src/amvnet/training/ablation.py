"""Studies that train: heads by tau and by neighbours, and the range-view network's ablation."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from amvnet.config.schema import AssertionConfig, Recipe
from amvnet.data.datasets.select import TrainingScans
from amvnet.evaluation.analysis import Swept
from amvnet.evaluation.metrics import metrics
from amvnet.evaluation.scoring import evaluate, label_by_weights
from amvnet.inference.segmenter import Segmenter
from amvnet.models.precision import choose_device
from amvnet.progress import Say, say_nothing
from amvnet.training.plan import Plan
from amvnet.training.run import train
from amvnet.weights.file import Weights


@dataclass(frozen=True)
class HeadStudy:
    """Heads for different values of tau or numbers of neighbours (Fig. 8 of the paper).

    Each is kept in OUT/NAME/VALUE; those that are finished are not trained again.

    Attributes:
        name: of the parameter, and of the folder.
        recipe: how the heads are trained.
        weights: whose networks they are trained for.
        scans: to train on, and to score.
        out: the folder of the analysis.
    """

    name: Literal["neighbours", "taus"]
    recipe: Recipe
    weights: Weights
    scans: TrainingScans
    out: Path

    def check(self) -> None:
        """Raise InputError if the recipe does not fit the scans."""
        Plan(self.recipe, self.scans, self.out)

    def sweep(
        self, values: Sequence[float], say: Say = say_nothing, device: str = "cpu"
    ) -> Iterator[Swept]:
        """Train a head for each value, and yield its figures.

        Raises:
            InputError: if OUT holds heads for other networks, other scans or another recipe.
        """
        for value in values:
            yield self._score(value, say, device)

    def _score(self, value: float, say: Say, device: str) -> Swept:
        networks = self._networks(value)
        recipe = dataclasses.replace(self.recipe, model=networks.model)
        out = self.out / self.name / str(value)
        plan = Plan(recipe, self.scans, out, resume=True, say=say)

        segmenter = Segmenter(train(plan, "head", networks), device)
        dataset = self.scans.dataset
        evaluation = evaluate(dataset, self.scans.val, label_by_weights(dataset, segmenter))
        uncertain = evaluation.uncertain / max(evaluation.asked, 1)
        matrix = evaluation.matrices["amvnet"][0]
        return Swept.of(value, uncertain, matrix, dataset.taxonomy)

    def _networks(self, value: float) -> Weights:
        """Return the weights without their head, for a head with a value of the parameter."""
        model = self.weights.model
        if self.name == "neighbours":
            head = dataclasses.replace(model.point_head, neighbours=int(value))
            model = dataclasses.replace(model, point_head=head)
        else:
            model = dataclasses.replace(model, assertion=AssertionConfig(value))

        networks = Weights(model, self.weights.taxonomy, self.weights.sensor)
        for part in ("range_net", "polar_net"):
            networks = networks.replace_part(part, self.weights)

        return networks


def ablate(plan: Plan, device: str = "cpu") -> Iterator[tuple[bool, bool, dict[str, Any]]]:
    """Train the range-view network with and without GRU and class weights (Table 5 of the paper).

    Each is kept in a folder of the plan's.

    Yields:
        Whether with the GRU, whether with class weights, and the figures of `metrics`.

    Raises:
        InputError: if OUT holds runs on other scans or of another recipe.
    """
    for gru, weighted in ((False, False), (True, False), (False, True), (True, True)):
        name = "rv" + ("-gru" if gru else "") + ("-weights" if weighted else "")
        plan.say(f"{name}:")
        recipe = _ablated(plan.recipe, gru, weighted)
        path = train(dataclasses.replace(plan, recipe=recipe, out=plan.out / name), "rv")

        segmenter = Segmenter(path, plan.processes.device(choose_device(device)), "rv")
        scans = plan.scans
        evaluation = evaluate(
            scans.dataset,
            scans.val,
            label_by_weights(scans.dataset, segmenter),
            processes=plan.processes,
        )
        yield gru, weighted, metrics(evaluation.matrices["rv"][0], scans.dataset.taxonomy)


def _ablated(recipe: Recipe, gru: bool, weighted: bool) -> Recipe:
    """Return a recipe with or without the GRU and the class weights of the range view."""
    range_net = dataclasses.replace(recipe.model.range_net, gru=gru)
    rv = dataclasses.replace(recipe.training.rv, class_weights=weighted)

    return dataclasses.replace(
        recipe,
        model=dataclasses.replace(recipe.model, range_net=range_net),
        training=dataclasses.replace(recipe.training, rv=rv),
    )
