"""A training run: its stages in order, and the weights file at its end."""

from __future__ import annotations

import dataclasses
from contextlib import nullcontext
from pathlib import Path

import lightning as L

from amvnet.config.schema import StageName
from amvnet.training.checking import Checked, check
from amvnet.training.curves import Curves, draw_curves, read_curves
from amvnet.training.head import train_head
from amvnet.training.networks import train_network
from amvnet.training.plan import Plan
from amvnet.training.run_folder import RunFolder
from amvnet.weights.file import Weights


def train(plan: Plan) -> Path:
    """Train the stages of a plan, and return the path of the weights file.

    The file holds all parts that have been trained so far.

    Raises:
        InputError: if the head is to be trained before the networks; if the folder holds a run
            that was begun with other settings, or that is not to be resumed; if another call is
            training one of the stages there; or if the check of the plan (`check`) finds an error.
    """
    folder = plan.folder
    folder.check_place(plan.roots, plan.also_read)
    with folder.alone(plan.stage) if plan.processes.first else nullcontext():
        checked = check(plan)
        if plan.processes.first:
            record = plan.record()
            folder.write_record(plan.stage, record, plan.recipe, checked.counts(plan.data))

        # Save after each stage, so that a stage that fails does not lose the earlier ones.
        weights = checked.weights
        for name in plan.stages:
            weights = train_stage(plan, checked, name, weights)
            if plan.processes.first:
                folder.save(weights)
            plan.processes.wait()
        if plan.processes.first:
            _draw_curves(folder, plan)
        return folder.weights


def _draw_curves(folder: RunFolder, plan: Plan) -> None:
    stages: dict[str, Curves] = {}
    for name, stage in folder.stages.items():
        if stage.is_finished:
            stages[name] = read_curves(stage.path, plan.data.taxonomy)
    if stages:
        path = draw_curves(stages, folder.curves)
        plan.report(f"loss, mIoU by epoch and IoU by class: {path}")


def train_stage(plan: Plan, checked: Checked, name: StageName, weights: Weights) -> Weights:
    """Train one stage, unless an earlier run has finished it. Return the weights with the new part.

    Raises:
        InputError: if the weights to begin with do not fit the recipe, or a scan is broken.
    """
    folder = plan.folder
    is_finished = plan.resume and folder.stages[name].is_finished
    if not is_finished:
        L.seed_everything(plan.recipe.training.seed, verbose=False)
        weights = dataclasses.replace(weights, expects=checked.expects)
        if name == "head":
            train_head(plan, weights)
        else:
            train_network(plan, checked, name, weights)
        plan.processes.wait()  # until the first one has written the weights that all read

    weights = folder.with_trained(name, weights)
    if plan.processes.first and not is_finished:
        folder.stages[name].finish()
    return weights
