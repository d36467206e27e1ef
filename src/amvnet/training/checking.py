"""Check a training before its first epoch: its folder, its weights to begin with, and its scans."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from amvnet.config.schema import PART_OF
from amvnet.data.check import check_scans
from amvnet.data.datasets.base import Dataset
from amvnet.data.datasets.training_data import TrainingData
from amvnet.progress import Progress, Tenths
from amvnet.sensors.expectation import Expectation
from amvnet.training.expectation import expectation_of
from amvnet.training.plan import Plan
from amvnet.weights.file import Weights
from amvnet.weights.parts import for_classes, replace_part

# A dataset teaches a class if more than this share of its labelled points have it. A few points may
# have it by mistake.
STRAY_SHARE = 1e-5


@dataclass(frozen=True)
class Checked:
    """What the check of a plan has found.

    Attributes:
        weights: the weights to begin with: new ones, with the parts of `Plan.init`, and the parts
            that finished stages of the folder have trained.
        class_counts: (K,) int64, the number of points of each class in the training scans of an
            epoch.
        taught: (M, K) bool, whether each of the M datasets teaches each class, as `rival_classes`
            takes it.
    """

    weights: Weights
    expects: Expectation
    class_counts: np.ndarray
    taught: np.ndarray

    def counts(self, data: TrainingData) -> dict[str, Any]:
        """Return the class counts as the record of a run has them, with the scans and classes."""
        scans = [record.name for record in data.train]
        return {"counts": self.class_counts, "scans": scans, "classes": data.taxonomy.classes}


def check(plan: Plan) -> Checked:
    """Check all stages of a plan before anything is written, and before hours are spent on one.

    Raises:
        InputError: if a stage cannot begin or be resumed, or `check_data` finds an error.
    """
    weights = first_weights(plan)
    for name, folder in plan.folder.stages.items():
        if name in plan.stages:
            folder.check_begun(plan.settings(name, weights) if plan.resume else None)
    counts, taught = check_data(plan)
    plan.processes.wait()  # until all streets of the first epoch are simulated
    expects = plan.expects or expectation_of(plan.data, weights, plan.recipe, plan.stages)
    return Checked(weights, expects, counts, taught)


def first_weights(plan: Plan) -> Weights:
    """Return new weights with the parts of `init`, and the parts that the folder has finished.

    If `init` has other classes, its parts are only taken for the stages to train.
    """
    sensor = plan.recipe.sensor
    taxonomy = plan.data.taxonomy
    weights = Weights(plan.recipe.model, taxonomy, sensor, Expectation.of_sensor(sensor))
    init = plan.init or weights
    has_classes = init.taxonomy.classes == taxonomy.classes
    seed = plan.recipe.training.seed
    begun, new = (init, []) if has_classes else for_classes(init, taxonomy, seed)
    for name in plan.folder.held:
        part = PART_OF[name].name
        is_trained = name in plan.stages
        if part not in begun.parts or not (is_trained or has_classes):
            continue
        own, wanted = begun.model.point_head, plan.recipe.model.point_head
        # A new kind of head can be trained on the networks of any weights.
        if name == "head" and is_trained and (own.hidden, own.fc) != (wanted.hidden, wanted.fc):
            plan.report("head: new, because the head of the initial weights has other sizes")
            continue
        # What is trained has the recipe's sizes, whatever sizes its initial weights state.
        sizes = plan.recipe.model if is_trained else begun.model
        weights = replace_part(weights, part, begun, sizes)
        kept = PART_OF[name].differences(sizes, plan.recipe.model)
        if kept:
            plan.report(f"{part}: is not trained, so it stays as in --init: {'; '.join(kept)}")
        if not has_classes:
            of_part = ", ".join(key for key in new if key.startswith(f"{part}."))
            plan.report(
                f"{part}: the initial weights ({init.taxonomy.name}), with new layers for the "
                f"classes of {taxonomy.name}: {of_part}"
            )
    return plan.folder.with_finished(weights)


def check_data(plan: Plan) -> tuple[np.ndarray, np.ndarray]:
    """Check all labels of the scans of a training, and report what may be a mistake.

    Of simulated streets, only those of the first epoch are checked: the streets of later epochs are
    simulated when they are needed, and may have other classes.

    Returns:
        The class counts and the taught classes, as in `Checked`.

    Raises:
        InputError: if a label has an unknown id, a scan cannot be read, or there is nothing to
            learn or to validate with.
    """
    totals = np.zeros(plan.data.taxonomy.size + 1, dtype=np.int64)
    taught = []
    for number, source in enumerate(plan.data.sources):
        dataset = source.dataset
        progress = _progress(plan, dataset)
        in_epoch = plan.data.in_epoch(number)
        train = in_epoch if dataset.simulated_sensor else source.train
        splits = {"train": train, "val": source.val}
        checked = check_scans(dataset, splits, progress, plan.processes)
        checked.require_trainable()
        totals += checked.count_points(in_epoch)
        if dataset.simulated_sensor:
            taught.append(np.ones(len(totals) - 1, dtype=bool))
            continue

        for line in checked.warnings():
            plan.report(f"{checked.spec}: {line}")
        points = checked.splits["train"].points[1:]
        taught.append(points > STRAY_SHARE * points.sum())
    return totals[1:], np.array(taught)


def _progress(plan: Plan, dataset: Dataset) -> Progress:
    """Return a function that reports tenths of the scans of a dataset as checked."""
    tenths = Tenths()
    size = plan.processes.size

    def progress(done: int, total: int) -> None:
        if tenths.ends(done, total):
            every = total * size
            plan.report(f"{dataset.spec}: checked {min(done * size, every)} of {every} scans")

    return progress
