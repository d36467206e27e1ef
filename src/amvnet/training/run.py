"""A training run: its stages in order, and the weights file at its end."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import lightning as L

from amvnet.training.checking import Checked, check
from amvnet.training.curves import draw_curves, read_curves
from amvnet.training.head import train_head
from amvnet.training.networks import train_network
from amvnet.training.plan import Plan
from amvnet.training.run_folder import (
    CURVES,
    DONE,
    PART_OF,
    WEIGHTS,
    alone_in_run,
    check_folder,
    is_finished,
    with_finished,
    with_trained,
    write_record,
)
from amvnet.weights.file import Weights, save


def train(plan: Plan) -> Path:
    """Train the stages of a plan, and return the path of the weights file.

    The file holds all parts that have been trained so far.

    Raises:
        InputError: if the head is to be trained before the networks; if the folder holds a run
            that was begun with other settings, or that is not to be resumed; if another call is
            training one of the stages there; or if the check of the plan (`check`) finds an error.
    """
    check_folder(plan)
    with alone_in_run(plan):
        checked = check(plan)
        if plan.processes.first:
            write_record(plan, checked.class_counts)

        # Save after each stage, so that a stage that fails does not lose the earlier ones.
        path = plan.out / WEIGHTS
        weights = checked.weights
        for name in plan.stages:
            weights = train_stage(plan, checked, name, weights)
            if plan.processes.first:
                save(with_finished(plan, weights), path)
            plan.processes.wait()
        if plan.processes.first:
            _draw_curves(plan)
        return path


def _draw_curves(plan: Plan) -> None:
    stages = {}
    for name in PART_OF:
        if is_finished(plan, name):
            stages[name] = read_curves(plan.out / name, plan.data.taxonomy)
    if stages:
        path = draw_curves(stages, plan.out / CURVES)
        plan.report(f"loss, mIoU by epoch and IoU by class: {path}")


def train_stage(plan: Plan, checked: Checked, name: str, weights: Weights) -> Weights:
    """Train one stage, unless an earlier run has finished it. Return the weights with the new part.

    Raises:
        InputError: if the weights to begin with do not fit the recipe, or a scan is broken.
    """
    if plan.resume and is_finished(plan, name):
        return with_trained(plan, name, weights)

    L.seed_everything(plan.recipe.training.seed, verbose=False)
    weights = dataclasses.replace(weights, expects=checked.expects)
    if name == "head":
        train_head(plan, weights)
    else:
        train_network(plan, checked, name, weights)

    # The first process has written the weights that all read.
    plan.processes.wait()
    trained = with_trained(plan, name, weights)
    if plan.processes.first:
        (plan.out / name / DONE).write_text("")
    return trained
