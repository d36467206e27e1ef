"""The plan of a training run: what it is asked to train, on which scans, and how."""

from __future__ import annotations

import dataclasses
import platform
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any, Literal

from amvnet.config.nested import to_dict
from amvnet.config.schema import (
    BOTH_NETWORKS,
    NETWORK_STAGES,
    PART_OF,
    NetworkName,
    Recipe,
    StageName,
)
from amvnet.data.datasets.base import Dataset
from amvnet.data.datasets.open import open_dataset
from amvnet.data.datasets.training_data import (
    Source,
    TrainingData,
    digest_of_scans,
    sequence_names,
    to_mix_in,
)
from amvnet.data.taxonomy import TAXONOMIES, Taxonomy, describe_difference
from amvnet.errors import InputError, counted
from amvnet.inference.scores import ScorePair
from amvnet.models.amvnet import AMVNet
from amvnet.progress import Reporter, report_nothing
from amvnet.runtime.distributed import ALONE, Processes
from amvnet.sensors.expectation import Expectation
from amvnet.sensors.normalise import Normaliser, normalised
from amvnet.training.expectation import with_options
from amvnet.training.run_folder import RunFolder
from amvnet.weights.file import Weights

PACKAGES = ("amvnet", "torch", "lightning", "numpy")  # the packages whose versions are recorded
MAX_MEASURED_RECORDINGS = 20  # largest number of a user's recordings that are measured


@dataclass(frozen=True)
class Plan:
    """One training run, as it is asked for. `Checked` is what its check finds.

    Attributes:
        data: the scans to train on and to validate with. If there are no scans to validate with,
            the last weights are kept as the best.
        stage: the stage to train, or "all" for the stages of the recipe.
        bars: show progress bars instead of a line for each epoch.
        processes: the processes that share the run. All of them must see its folder.
        scores: the scores of two other models for the scans. If they are given, the head learns
            from them instead of from the scores of the networks.
        also_read: files besides the scans that the run reads. Entries that name no file are
            ignored.
        expects: what the networks expect of a scan, and the weights will say. By default, the
            training measures it on its scans before the first stage (`expectation_of`).

    Raises:
        InputError: if the processes cannot share the scans or the batches, the recipe is for other
            classes than the dataset's or needs a network that `init` lacks, or `scores` are for
            another stage than the head.
    """

    recipe: Recipe
    data: TrainingData
    out: Path
    init: Weights | None = None
    stage: StageName | Literal["all"] = "all"
    resume: bool = False
    report: Reporter = report_nothing
    bars: bool = False
    processes: Processes = ALONE
    scores: ScorePair | None = None
    also_read: Sequence[Path | str | None] = ()
    expects: Expectation | None = None

    def __post_init__(self) -> None:
        if self.scores is not None and self.stages != ("head",):
            raise InputError(
                f"expected --stage head for scores of other models, found {self.stage}; add it"
            )
        size = self.processes.size
        val = self.data.val
        if 0 < len(val) < size:  # a process without a scan would keep the others waiting
            raise InputError(
                f"expected a validation scan for each of {size} processes, found {len(val)}; "
                "name more validation sequences"
            )
        for name in NETWORK_STAGES:
            config = self.recipe.training.of(name)
            if config.batch % (size * config.accumulate):
                raise InputError(
                    f"expected a batch that {counted(size, 'process', 'processes')} can share, "
                    f"each in {counted(config.accumulate, 'part')}, found {config.batch} scans; "
                    f"set --training.{name}.batch or --training.{name}.accumulate"
                )

        taxonomy = self.data.taxonomy.name
        # A user's own classes fit any recipe, and any classes fit a recipe without classes.
        is_open = self.recipe.from_init or taxonomy not in TAXONOMIES
        if not is_open and taxonomy != self.recipe.taxonomy:
            raise InputError(
                f"expected a dataset with the classes of {self.recipe.taxonomy}, "
                f"found {taxonomy}; use the recipe of that benchmark"
            )

        for name in NETWORK_STAGES:
            if name in self.stages:
                self._check_initial(name)

    def _check_initial(self, name: NetworkName) -> None:
        """Raise InputError if the network of a stage needs initial weights and there are none."""
        config = self.recipe.training.of(name)
        part = PART_OF[name].name
        parts = self.init.parts if self.init else ()
        for option in ("initial", "distill"):
            if getattr(config, option) and part not in parts:
                found = f"{', '.join(parts)} in --init" if parts else "none"
                raise InputError(
                    f"training.{name}.{option}: expected weights of {part} to begin with, found "
                    f"{found}; give --init with this part, set the option to 0, or train another "
                    "--stage"
                )

    @property
    def stages(self) -> tuple[StageName, ...]:
        """The stages to train, in order."""
        return self.recipe.stages if self.stage == "all" else (self.stage,)

    @property
    def roots(self) -> list[Path]:
        """The folders of the datasets."""
        return [source.dataset.root for source in self.data.sources]

    @property
    def folder(self) -> RunFolder:
        """The folder of the run."""
        # The networks of a folder cannot use a head that was trained on other models' scores.
        held: tuple[StageName, ...] = tuple(PART_OF) if self.scores is None else ("head",)
        return RunFolder(self.out, held, self.recipe.training.keep)

    def settings(self, name: StageName, weights: Weights) -> dict[str, Any]:
        """Return all settings that the trained weights of a stage depend on, as a tree for YAML.

        Paths are left out, so that the data may move to another folder before the stage is resumed.

        Args:
            weights: the weights that the stage begins with.
        """
        recipe = to_dict(self.recipe)
        training_keys = (name, "augment", "seed", "precision")
        part = PART_OF[name].name
        train, val = self.data.train, self.data.val
        settings: dict[str, Any] = {
            "model": {key: recipe["model"][key] for key in PART_OF[name].sizes},
            "training": {key: recipe["training"][key] for key in training_keys},
            "scans": {"train": digest_of_scans(train), "val": digest_of_scans(val)},
            "init": self.init.digest(part) if self.init and part in self.init.parts else None,
            "classes": self.data.digest_of_classes(),
        }

        if self.scores is not None:
            settings["scores"] = self.scores.digests([*train, *val])
        elif name == "head":
            settings["networks"] = {network: weights.digest(network) for network in BOTH_NETWORKS}
        return settings

    def stage_record(self, settings: Mapping[str, Any]) -> dict[str, Any]:
        """Return the record of a stage's training by some `settings`; its weights store it."""
        scores = {"scores": settings["scores"]} if "scores" in settings else {}
        return {
            **settings["training"],
            "sequences": sequence_names(self.data.train),
            "validated_on": sequence_names(self.data.val),
            "scans": len(self.data),
            **scores,
        }

    def record(self) -> dict[str, Any]:
        """Return the inputs of the run, for the record of its folder."""
        specs = self.data.specs
        record: dict[str, Any] = {
            "versions": {name: version(name) for name in PACKAGES},
            "python": platform.python_version(),
            "data": specs if len(specs) > 1 else specs[0],
            "classes": self.data.taxonomy.name,
            "train": sequence_names(self.data.train),
            "val": sequence_names(self.data.val),
            "init": None if self.init is None else self.init.digests(),
        }
        if self.scores is not None:
            record["scores"] = repr(self.scores)
        return record

    @classmethod
    def open(
        cls,
        recipe: Recipe,
        specs: Sequence[str],
        out: Path,
        choose: Callable[[Dataset], Source],
        init: Weights | None = None,
        *,
        stage: StageName | Literal["all"] = "all",
        report: Reporter = report_nothing,
        **settings: Any,
    ) -> Plan:
        """Open the datasets of a training run, and return its plan.

        Args:
            recipe: what to train. Sizes and classes come from `init` if the recipe says so.
            specs: the datasets, as `open_dataset` takes them. The training scans of the second and
                of later datasets are mixed in.
            choose: a function that returns the scans of the first dataset to train on and to
                validate with.
            out, init, stage, report, settings: attributes of the plan.

        Raises:
            InputError: if a dataset cannot be opened or mixed in, the recipe needs `init`, or the
                scans do not fit the recipe.
        """
        recipe = sized_by_init(recipe, init)
        stages = recipe.stages if stage == "all" else (stage,)
        first, *others = [
            open_for_training(spec, recipe, out, init, stages=stages, report=report)
            for spec in specs
        ]
        recipe = without_initial_weights(recipe, init, first.taxonomy, stages, report)
        mixed = [to_mix_in(dataset) for dataset in others]
        data = TrainingData([choose(first), *mixed], recipe.training.others)
        return cls(recipe, data, out, init, stage, report=report, **settings)

    def build(self, weights: Weights) -> AMVNet:
        """Return a model with some weights. Parts that the weights lack are initialised at random.

        Raises:
            InputError: if the parameters do not fit the sizes of the model. The recipe states the
                sizes of a part that is to be trained.
        """
        try:
            return weights.build(with_head=True)
        except InputError as error:
            raise InputError(f"{error}, or use the recipe of the weights") from None


def sized_by_init(recipe: Recipe, init: Weights | None) -> Recipe:
    """Return a recipe with the sensor and the sizes of `init`, if it asks for them.

    Raises:
        InputError: if the recipe asks for them, and `init` is None.
    """
    if not recipe.from_init:
        return recipe
    if init is None:
        raise InputError(
            "expected weights to begin with for this recipe, found none; add --init sim-any"
        )

    return dataclasses.replace(recipe, model=init.model, sensor=init.sensor)


def without_initial_weights(
    recipe: Recipe, init: Weights | None, classes: Taxonomy, stages: Sequence[str], report: Reporter
) -> Recipe:
    """Return the recipe without averages and distillation of initial weights of other classes.

    Their last layers would then be replaced by new ones, which are useless in an average, and
    teach nothing. A line reports this for the stages that are trained.
    """
    if init is None or init.taxonomy.classes == classes.classes:
        return recipe

    networks: dict[str, Any] = {}
    changed: list[str] = []
    for name in NETWORK_STAGES:
        config = recipe.training.of(name)
        if name in stages and (config.initial or config.distill):
            changed.append(name)
        networks[name] = dataclasses.replace(config, initial=0.0, distill=0.0)
    if changed:
        difference = describe_difference(init.taxonomy.classes, classes.classes, "data")
        report(
            f"{' and '.join(changed)}: begin with --init, but because its classes are others "
            f"({difference}), they are neither averaged with it (initial) nor taught by it "
            "(distill)"
        )
    return dataclasses.replace(recipe, training=dataclasses.replace(recipe.training, **networks))


def open_for_training(
    data: str,
    recipe: Recipe,
    out: Path,
    init: Weights | None = None,
    *,
    stages: Sequence[StageName] = (),
    report: Reporter = report_nothing,
) -> Dataset:
    """Open the dataset of a training.

    A user's own scans are normalised as `predict` normalises them: to what the initial weights
    expect, or else to what the weights of an earlier call in `out` expect, or else to the sensor
    of the recipe.

    Raises:
        InputError: if the dataset cannot be opened (`open_dataset`).
    """
    begun = RunFolder(out).networks() if init is None else [init]
    known = begun[-1].expects if begun else Expectation.of_sensor(recipe.sensor)
    parts = {part for weights in begun for part in weights.parts}
    expected = with_options(known, parts, recipe, stages)

    opened = normalised(open_dataset(data), Normaliser(expected, report=report))
    if isinstance(opened.normalise, Normaliser):
        _report_recordings(opened, opened.normalise, report)
    return opened


def _report_recordings(dataset: Dataset, normaliser: Normaliser, report: Reporter) -> None:
    """Measure the first recordings, and report what is assumed of them.

    The processes that read them report nothing.
    """
    recordings = dataset.recordings()
    for recording in recordings[:MAX_MEASURED_RECORDINGS]:
        with suppress(InputError):  # the check of the scans reports broken ones
            recording.scan(recording.scans[0])
    more = len(recordings) - MAX_MEASURED_RECORDINGS
    rest = f"; {counted(more, 'further recording')} not shown" if more > 0 else ""
    report(f"{dataset.spec}: if an assumption is wrong, state the right value under sensor{rest}")
    normaliser.quiet()
