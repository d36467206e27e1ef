"""A training run: its stages in order, and the weights file at its end."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Literal

import lightning as L

from amvnet.config.nested import flat, to_dict
from amvnet.config.schema import StageName
from amvnet.errors import InputError
from amvnet.sensors.expectation import Expectation
from amvnet.training.checking import check_data, keep_counts
from amvnet.training.curves import draw_curves, read_curves
from amvnet.training.expectation import expected_after
from amvnet.training.head import train_head
from amvnet.training.networks import train_network
from amvnet.training.plan import Plan
from amvnet.training.run_folder import (
    CURVES,
    DONE,
    PART_OF,
    WEIGHTS,
    alone_in_run,
    check_begun,
    check_folder,
    is_finished,
    stage_settings,
    with_trained,
    write_record,
)
from amvnet.weights.file import Weights, save
from amvnet.weights.parts import SIZES, fits, for_classes, replace_part, resized


def train(
    plan: Plan, stage: StageName | Literal["all"] = "all", init: Weights | None = None
) -> Path:
    """Train one stage, or all stages, and return the path of the weights file.

    The file holds all parts that have been trained so far.

    Args:
        plan: the scans, the folder and the recipe of the run.
        stage: the stage to train, or "all".
        init: the weights to begin with.

    Raises:
        InputError: if the head is to be trained before the networks; if the folder holds a run
            that was begun with other settings, or that is not to be resumed; if another call is
            training one of the stages there; or if the check of the data (`check_data`) finds an
            error.
    """
    names = plan.recipe.stages if stage == "all" else (stage,)
    if plan.scores is not None and names != ("head",):
        raise InputError(f"expected --stage head for scores of other models, found {stage}; add it")

    check_folder(plan)
    initial = {} if init is None else init.digests()
    plan = dataclasses.replace(plan, stages=names, initial=initial)
    with alone_in_run(plan, stage):
        return _train_stages(plan, stage, init)


def _train_stages(plan: Plan, stage: str, init: Weights | None) -> Path:
    """Train the stages of a plan in a folder that no other call writes into."""
    names = plan.stages
    # Check all stages before anything is written, and before hours are spent on the first one.
    weights = first_weights(plan, init, names)
    for name in names:
        check_begun(plan.out / name, stage_settings(plan, name, weights), plan.resume)
        _check_initial(plan, name)
    counts, taught = check_data(plan)
    plan.processes.wait()  # until all streets of the first epoch are simulated
    expects = plan.expects or expected_after(plan.scans, weights, plan.recipe, names)
    plan = dataclasses.replace(plan, class_counts=counts, taught=taught, expects=expects)
    if plan.processes.first:
        write_record(plan, stage, init)
    keep_counts(plan, counts)

    # Save after each stage, so that a stage that fails does not lose the earlier ones.
    path = plan.out / WEIGHTS
    for name in names:
        weights = train_stage(plan, name, weights)
        if plan.processes.first:
            save(_with_finished(plan, weights), path)
        plan.processes.wait()
    if plan.processes.first:
        _draw_curves(plan)
    return path


def _check_initial(plan: Plan, name: str) -> None:
    """Raise InputError if a network needs initial weights that --init does not have."""
    config = getattr(plan.recipe.training, name)
    part = PART_OF[name]
    for option in ("initial", "distill"):
        if getattr(config, option, 0) and part not in plan.initial:
            found = f"{', '.join(plan.initial)} in --init" if plan.initial else "none"
            raise InputError(
                f"training.{name}.{option}: expected weights of {part} to begin with, found "
                f"{found}; give --init with this part, set the option to 0, or train another "
                "--stage"
            )


def _draw_curves(plan: Plan) -> None:
    """Draw the curves of all finished stages of the folder."""
    stages = {}
    taxonomy = plan.scans.dataset.taxonomy
    for name in PART_OF:
        if is_finished(plan, name):
            epochs = getattr(plan.recipe.training, name).epochs
            stages[name] = read_curves(plan.out / name, taxonomy, epochs)
    if stages:
        path = draw_curves(stages, plan.out / CURVES)
        plan.report(f"loss, mIoU by epoch and IoU by class: {path}")


def train_stage(plan: Plan, name: str, weights: Weights) -> Weights:
    """Train one stage, unless an earlier run has finished it. Return the weights with the new part.

    Raises:
        InputError: if the weights to begin with do not fit the recipe, or a scan is broken.
    """
    if plan.resume and is_finished(plan, name):
        return with_trained(plan, name, weights)

    # The recipe decides the sizes of the part, whatever sizes the weights state.
    L.seed_everything(plan.recipe.training.seed, verbose=False)
    weights = resized(weights, PART_OF[name], plan.recipe.model)
    if name == "head":
        train_head(plan, weights)
    else:
        train_network(plan, name, weights)

    # The first process has written the weights that all read.
    plan.processes.wait()
    trained = with_trained(plan, name, weights)
    if plan.processes.first:
        (plan.out / name / DONE).write_text("")
    return trained


def first_weights(plan: Plan, init: Weights | None, trained: Sequence[str]) -> Weights:
    """Return new weights with the parts of `init`, and the parts that this folder has finished.

    If `init` has other classes, its parts are only taken for the stages to train.
    """
    sensor = plan.recipe.sensor
    expects = Expectation.of_sensor(sensor)
    weights = Weights(plan.recipe.model, plan.scans.dataset.taxonomy, sensor, expects)
    for name in _stages_of_folder(plan):
        part = PART_OF[name]
        if init is None or part not in init.parts:
            continue
        # A new kind of head can be trained on the networks of any weights.
        if name == "head" and name in trained and not fits(init, part, plan.recipe.model):
            plan.report("head: new, because the head of the initial weights has other sizes")
            continue
        if init.taxonomy.classes == weights.taxonomy.classes:
            weights = replace_part(weights, part, init)
            if name not in trained:
                _report_kept(plan, init, part)
        elif name in trained:
            weights = replace_part(weights, part, _for_classes(plan, init, part))

    return _with_finished(plan, weights)


def _report_kept(plan: Plan, init: Weights, part: str) -> None:
    """Report the settings of a part that is not trained, if the recipe has others."""
    of_recipe = dict(flat(to_dict(plan.recipe.model), "model"))
    kept = []
    for section in SIZES[part]:
        for key, value in flat(to_dict(getattr(init.model, section)), f"model.{section}"):
            if value != of_recipe[key]:
                kept.append(f"{key} is {value}, not {of_recipe[key]}")
    if kept:
        plan.report(f"{part}: is not trained, so it stays as in --init: {'; '.join(kept)}")


def _with_finished(plan: Plan, weights: Weights) -> Weights:
    """Return the weights with the parts that the finished stages of this folder have trained.

    Another process may have finished some stages while this process trained.
    """
    for name in _stages_of_folder(plan):
        if is_finished(plan, name):
            weights = with_trained(plan, name, weights)
    return weights


def _stages_of_folder(plan: Plan) -> Sequence[str]:
    """Return the names of the stages that the folder can hold."""
    # The networks of this folder cannot use a head that was trained on other models' scores.
    return list(PART_OF) if plan.scores is None else ["head"]


def _for_classes(plan: Plan, init: Weights, part: str) -> Weights:
    """Return the initial weights with new last layers for the classes of the dataset."""
    taxonomy = plan.scans.dataset.taxonomy
    weights, new = for_classes(init, taxonomy, plan.recipe.training.seed)
    of_part = [name for name in new if name.startswith(f"{part}.")]
    plan.report(
        f"{part}: the initial weights ({init.taxonomy.name}), with new layers for the classes of "
        f"{taxonomy.name}: {', '.join(of_part)}"
    )
    return weights
