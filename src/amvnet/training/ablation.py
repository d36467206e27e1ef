"""Studies that train networks: heads by tau and by neighbours, and an ablation of the range view.

They repeat Fig. 8 and Table 5 of the paper.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from amvnet.config.schema import BOTH_NETWORKS, ModelConfig, Recipe
from amvnet.engines.compute import choose_device
from amvnet.evaluation.analysis import SweptRow, swept_row
from amvnet.evaluation.metrics import metrics
from amvnet.evaluation.scoring import evaluate, label_by_weights
from amvnet.inference.loading import load
from amvnet.training.plan import Plan
from amvnet.training.run import train
from amvnet.training.run_folder import RunFolder
from amvnet.weights.file import Weights
from amvnet.weights.parts import replace_part

# The variants of the ablation: whether it has the GRU, and whether it has class weights.
VARIANTS = ((False, False), (True, False), (False, True), (True, True))


def sweep_heads(
    plan: Plan,
    models: Mapping[int, ModelConfig] | Mapping[float, ModelConfig],
    weights: Weights,
    device: str = "cpu",
) -> Iterator[SweptRow]:
    """Train a head for each value of a parameter, and yield its figures (Fig. 8 of the paper).

    Args:
        plan: how the heads are trained, with the stage `head`. Each head is kept in a folder inside
            the plan's folder. It is not trained again if it is finished.
        device: the device on which the heads are scored, such as "cpu" or "cuda".

    Raises:
        InputError: if a folder holds a head for other networks, other scans or another recipe.
    """
    dataset = plan.data.sources[0].dataset
    for value, model in models.items():
        networks = _networks(weights, model)
        recipe = dataclasses.replace(plan.recipe, model=model)
        out = plan.out / f"{value:g}"
        head_plan = dataclasses.replace(plan, recipe=recipe, out=out, init=networks)

        segmenter = load(train(head_plan), device)
        evaluation = evaluate(dataset, plan.data.val, label_by_weights(segmenter))
        uncertain = evaluation.uncertain / max(evaluation.asked, 1)
        yield swept_row(value, uncertain, evaluation.matrices["amvnet"][0], dataset.taxonomy)


def with_neighbours(model: ModelConfig, count: int) -> ModelConfig:
    """Return the configuration with another number of neighbours of a point."""
    head = dataclasses.replace(model.point_head, neighbours=count)
    return dataclasses.replace(model, point_head=head)


def with_tau(model: ModelConfig, tau: float) -> ModelConfig:
    """Return the configuration with another tau. With a tau of 1, every point is uncertain."""
    assertion = dataclasses.replace(model.assertion, threshold=tau)
    return dataclasses.replace(model, assertion=assertion)


def _networks(weights: Weights, model: ModelConfig) -> Weights:
    """Return the two networks of some weights in another configuration, without a head."""
    networks = Weights(model, weights.taxonomy, weights.sensor)
    for part in BOTH_NETWORKS:
        networks = replace_part(networks, part, weights)
    return networks


def is_begun(out: Path) -> bool:
    """Return whether an earlier call of `ablate` has trained in a folder."""
    return any(RunFolder(out / _name(gru, weighted)).is_run for gru, weighted in VARIANTS)


def ablate(plan: Plan, device: str = "cpu") -> Iterator[tuple[bool, bool, dict[str, Any]]]:
    """Train the range-view network with and without GRU and class weights (Table 5 of the paper).

    Args:
        plan: how the networks are trained, with the stage `rv`. Each network is kept in a folder
            inside the plan's.
        device: the device on which the networks are scored, such as "cpu" or "cuda".

    Yields:
        Whether the network has the GRU, whether its loss has class weights, and its figures as
        `metrics` returns them.

    Raises:
        InputError: if a folder holds a run on other scans or with another recipe.
    """
    for gru, weighted in VARIANTS:
        name = _name(gru, weighted)
        plan.report(f"{name}:")
        recipe = _ablated(plan.recipe, gru, weighted)
        path = train(dataclasses.replace(plan, recipe=recipe, out=plan.out / name))

        segmenter = load(path, plan.processes.device(choose_device(device)), "rv")
        dataset = plan.data.sources[0].dataset
        labeller = label_by_weights(segmenter)
        evaluation = evaluate(dataset, plan.data.val, labeller, processes=plan.processes)
        yield gru, weighted, metrics(evaluation.matrices["rv"][0], dataset.taxonomy)


def _name(gru: bool, weighted: bool) -> str:
    return "rv" + ("-gru" if gru else "") + ("-weights" if weighted else "")


def _ablated(recipe: Recipe, gru: bool, weighted: bool) -> Recipe:
    range_net = dataclasses.replace(recipe.model.range_net, gru=gru)
    rv = dataclasses.replace(recipe.training.rv, class_weights=0.5 if weighted else 0.0)

    return dataclasses.replace(
        recipe,
        model=dataclasses.replace(recipe.model, range_net=range_net),
        training=dataclasses.replace(recipe.training, rv=rv),
    )
