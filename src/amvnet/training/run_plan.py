"""The plan of a training run: what it trains, on which scans, and how it runs."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from pathlib import Path

from amvnet.config.schema import NetworkTraining, Recipe
from amvnet.data.datasets.select import TrainingScans
from amvnet.data.taxonomy import TAXONOMIES, Taxonomy
from amvnet.distributed import ALONE, Processes
from amvnet.errors import InputError
from amvnet.inference.scores import ScorePair
from amvnet.progress import Say, say_nothing
from amvnet.training.loggers import LoggerName, check_logger
from amvnet.weights.file import Weights


@dataclass(frozen=True)
class RunOptions:
    """How a training runs.

    Attributes:
        resume: continue an earlier run in the same folder.
        say: prints a line about what happens.
        bars: show progress bars instead of a line for each epoch.
        processes: those that share the run; all must see its folder.
        logger: where the curves and pictures go.

    Raises:
        InputError: if the logger lacks its library.
    """

    resume: bool = False
    say: Say = say_nothing
    bars: bool = False
    processes: Processes = ALONE
    logger: LoggerName = "tensorboard"

    def __post_init__(self) -> None:
        check_logger(self.logger)


@dataclass(frozen=True)
class RunPlan:
    """One training run.

    Attributes:
        recipe: what to train.
        scans: to train on and to validate with. Without validation scans, the last weights are
            kept as the best.
        out: the folder of the run.
        options: how it runs.
        scores: two other models' scores of the scans; the head is trained on them instead of on
            those of the networks. None without other models.

    Raises:
        InputError: if the processes cannot share the scans or the batches, or the recipe is for
            other classes than the dataset's.
    """

    recipe: Recipe
    scans: TrainingScans
    out: Path
    options: RunOptions = RunOptions()
    scores: ScorePair | None = None

    def __post_init__(self) -> None:
        size = self.options.processes.size
        val = self.scans.val
        if 0 < len(val) < size:  # a process without a scan would keep the others waiting
            raise InputError(
                f"expected a validation scan for each of {size} processes, found {len(val)}; "
                "name more validation sequences"
            )
        for name in ("rv", "bev"):
            check_batch(getattr(self.recipe.training, name), name, size)

        taxonomy = self.scans.dataset.taxonomy.name
        # A user's own classes fit any recipe.
        if taxonomy in TAXONOMIES and taxonomy != self.recipe.taxonomy:
            raise InputError(
                f"expected a dataset with the classes of {self.recipe.taxonomy}, "
                f"found {taxonomy}; use the recipe of that benchmark"
            )


def sized_by_init(recipe: Recipe, init: Weights | None) -> Recipe:
    """Return a recipe with the classes, sensor and sizes of weights, if it asks for them.

    Raises:
        InputError: if it does, and there are no weights.
    """
    if not recipe.from_init:
        return recipe
    if init is None:
        raise InputError("expected weights to begin with for this recipe, found none; add --init")

    name = init.taxonomy.name
    taxonomy = name if name in TAXONOMIES else recipe.taxonomy
    return dataclasses.replace(
        recipe,
        model=init.model,
        sensor=init.sensor,
        taxonomy=taxonomy,  # type: ignore[arg-type]
    )


def without_mean(recipe: Recipe, init: Weights | None, classes: Taxonomy, say: Say) -> Recipe:
    """Return a recipe that keeps no share of initial weights if these have other classes.

    Their last layers are new then, and of no use in a mean.

    Args:
        recipe: of the training.
        init: weights to begin with.
        classes: of the data.
        say: told what is left out.
    """
    if init is None or init.taxonomy.classes == classes.classes:
        return recipe

    networks = {}
    for name in ("rv", "bev"):
        config = getattr(recipe.training, name)
        if config.initial:
            say(f"{name}: no mean with the initial weights, which have other classes")
            networks[name] = dataclasses.replace(config, initial=0.0)
    return dataclasses.replace(recipe, training=dataclasses.replace(recipe.training, **networks))


def check_batch(config: NetworkTraining, name: str, processes: int) -> None:
    """Raise InputError if a batch of a stage cannot be divided evenly among processes."""
    if config.batch % (processes * config.accumulate):
        raise InputError(
            f"expected a batch for {processes} processes, each in {config.accumulate} parts, found "
            f"{config.batch}; set --training.{name}.batch or --training.{name}.accumulate"
        )
