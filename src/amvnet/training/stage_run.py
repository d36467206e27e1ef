"""The stages of a training run: what each begins with, how it is fitted, and what it writes."""

from __future__ import annotations

import dataclasses
import shutil
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import lightning as L
import numpy as np
import yaml
from lightning.pytorch.callbacks import Callback
from torch import Tensor, nn

from amvnet.config.schema import NetworkTraining
from amvnet.data.datasets.base import ScanRecord
from amvnet.data.datasets.simulated import SimulatedStreets
from amvnet.data.spacing import evenly_spaced
from amvnet.errors import InputError
from amvnet.files import atomic_write
from amvnet.models.amvnet import AMVNet, build_amvnet
from amvnet.models.views.points import PointBatch
from amvnet.sensors.intensity import (
    TrainedIntensity,
    match_scan,
    simulated_intensity,
    trained_intensity,
)
from amvnet.training.callbacks import KeepWeights, Pictures, Speed
from amvnet.training.fit import LAST, FitOptions, Loaders, fit
from amvnet.training.head_points import PointDraw, PointGatherer, make_head_loader
from amvnet.training.head_scores import NetworkScores, ScoreSource, score_source, scorer_with_head
from amvnet.training.head_stage import HeadStage
from amvnet.training.loaders import ScanSet, count_classes, make_loader, sensor_record
from amvnet.training.loggers import WITH_PICTURES
from amvnet.training.losses import class_weights
from amvnet.training.precision import SINGLE
from amvnet.training.run_plan import RunPlan
from amvnet.training.run_record import SETTINGS, check_begun, sequence_names, stage_settings
from amvnet.training.stages import NetworkStage, PolarStage, RangeStage
from amvnet.weights.file import Weights, load, part_state, save

PICTURED_SCANS = 2
VAL_FACTOR = 64  # a validation batch of the head is as large as this many training batches


@dataclass(frozen=True)
class StageRun:
    """One stage of a run, in its folder.

    Attributes:
        plan: of the run.
        name: name of the stage, as for --stage.
        parts: the parts of the weights that the stage trains.
        weights: the weights that the stage begins with.
        train_networks: trains both networks of another plan, as the folds of the head need them;
            returns their weights file.
    """

    plan: RunPlan
    name: str
    parts: tuple[str, ...]
    weights: Weights
    train_networks: Callable[[RunPlan], Path]

    @property
    def folder(self) -> Path:
        return self.plan.out / self.name

    @property
    def done_path(self) -> Path:
        """The file whose existence marks the stage as finished."""
        return self.folder / "done"

    @property
    def weights_path(self) -> Path:
        """The weights file of the stage that is used in the end: the best or the last."""
        return self.folder / f"{self.plan.recipe.training.keep}.safetensors"

    @property
    def settings(self) -> dict[str, Any]:
        """What the trained weights of the stage depend on, for YAML."""
        return stage_settings(self.plan, self.name, self.parts, self.weights)

    @property
    def intensity(self) -> TrainedIntensity | None:
        """What the intensities of each scan are brought to, as in a prediction; None: nothing."""
        return trained_intensity(self.weights.training, self.weights.sensor)

    @property
    def is_begun(self) -> bool:
        return (self.folder / LAST).is_file()

    @property
    def is_finished(self) -> bool:
        return self.weights_path.is_file() and self.done_path.is_file()

    def check_begun(self) -> None:
        """Raise InputError if the folder holds a stage that cannot be resumed."""
        check_begun(self.folder, self.settings, self.plan.options.resume)

    def finished_weights(self) -> Weights:
        """Return the weights, with the parts that this stage trained if it is finished."""
        if self.is_finished:
            return self._replaced(self.weights, load(self.weights_path))
        return self.weights

    def train(self) -> Weights:
        """Fit the stage; return the weights with the trained parts.

        Raises:
            InputError: if the weights to begin with do not fit the recipe, or a scan is broken.
        """
        if self.done_path.is_file() and self.plan.options.resume:
            return self.finished_weights()

        # The recipe decides the sizes of the parts, whatever the weights have.
        L.seed_everything(self.plan.recipe.training.seed, verbose=False)
        resized = self.weights
        for part in self.parts:
            resized = resized.resized(part, self.plan.recipe.model)
        dataclasses.replace(self, weights=resized).fit()

        # The first process has written the weights; the others read them too.
        processes = self.plan.options.processes
        processes.wait()
        trained = self._replaced(resized, load(self.weights_path))
        if processes.first:
            self.done_path.write_text("")
        return trained

    def fit(self) -> None:
        """Fit the stage, and write its weights after each epoch."""
        raise NotImplementedError

    def _replaced(self, weights: Weights, trained: Weights) -> Weights:
        """Return weights with the parts of this stage taken from the trained ones."""
        for part in self.parts:
            weights = weights.replace_part(part, trained)
        return weights

    def state(self, module: nn.Module) -> dict[str, Tensor]:
        """Return the parameters of what Lightning has trained, named as in `Weights.tensors`."""
        (part,) = self.parts
        return part_state(part, module)

    def metrics_of(self, part: str, metrics: Mapping[str, float]) -> dict[str, float]:
        """Return those of the validation metrics that are about one of the parts."""
        return dict(metrics)

    def model(self) -> AMVNet:
        """Return a model; the parts to train have the parameters of the weights, if these do.

        Raises:
            InputError: if these parameters have other sizes.
        """
        model = build_amvnet(self.weights.model, self.weights.taxonomy.size)
        for part in self.parts:
            if part not in self.weights.parts:
                continue
            try:
                getattr(model, part).load_state_dict(self.weights.part(part))
            except RuntimeError:
                raise InputError(
                    f"expected weights whose {part} has the recipe's sizes, found others; "
                    "use the recipe of the weights"
                ) from None

        if self.plan.scans.dataset.is_normalised:
            model.range_view = model.range_view.by_ring()
        return model

    def class_weights(self) -> np.ndarray:
        """Return the (K,) weights of the classes in the loss (section 4.2 of the paper)."""
        counts = count_classes(
            self.plan.scans.dataset,
            self.plan.scans.train,
            self.plan.out / "class_counts.npz",
            self.plan.options.processes,
            self.plan.options.say,
        )
        return class_weights(counts)

    def keep_weights(self) -> KeepWeights:
        """Return the callback that writes the trained parts after each epoch."""
        # Only the first process writes.
        scans = self.plan.scans
        is_first = self.plan.options.processes.first
        sensor = sensor_record(scans.dataset, scans.train, self.intensity) if is_first else {}
        writer = PartWriter(self, self.settings, sensor, time.time())
        return KeepWeights(writer, self.folder)

    def pictures(self, score: Callable[[PointBatch], Tensor]) -> Pictures:
        """Return the callback that draws validation scans.

        Args:
            score: returns the (P, K) scores of a batch.
        """
        dataset = self.plan.scans.dataset
        options = self.plan.options
        is_drawn = options.processes.first and options.logger in WITH_PICTURES
        records = evenly_spaced(self.plan.scans.val, PICTURED_SCANS) if is_drawn else []
        scans = [match_scan(dataset.read(record), self.intensity) for record in records]
        return Pictures(scans, dataset.taxonomy, lambda batch: score(batch).argmax(dim=1) + 1)


@dataclass(frozen=True)
class PartWriter:
    """Writes the parts that a stage trains, with a description of their training.

    Attributes:
        stage: the stage.
        settings: those of the stage, computed only once because that takes long.
        sensor: what was measured of the sensor of the training scans.
        started: when the training was begun or resumed, by `time.time`.
    """

    stage: StageRun
    settings: dict[str, Any]
    sensor: dict[str, Any]
    started: float

    def __call__(self, module: nn.Module, path: Path, metrics: dict[str, float]) -> None:
        scans = self.stage.plan.scans
        description = {
            **self.settings["training"],
            "sequences": sequence_names(scans.train),
            "validated_on": sequence_names(scans.val),
            "scans": len(scans.train),
            **self.sensor,
        }
        if "scores" in self.settings:
            description["scores"] = self.settings["scores"]
        description["seconds"] = round(time.time() - self.started)

        trained = dataclasses.replace(
            self.stage.weights,
            tensors=self.stage.state(module),
            training=dict.fromkeys(self.stage.parts, description),
            metrics={part: self.stage.metrics_of(part, metrics) for part in self.stage.parts},
        )
        save(trained, path)
        with atomic_write(path.parent / SETTINGS) as file:
            file.write_text(yaml.safe_dump(self.settings, sort_keys=False))


@dataclass(frozen=True)
class Network:
    """How one of the two networks is trained.

    Attributes:
        stage: makes its Lightning module.
        view: the attribute of `AMVNet` that projects a batch.
        score: the method of `AMVNet` that returns the scores of a batch.
    """

    stage: Callable[..., NetworkStage]
    view: str
    score: str


NETWORKS = {
    "rv": Network(RangeStage, "range_view", "score_range_view"),
    "bev": Network(PolarStage, "polar_view", "score_polar_view"),
}


@dataclass(frozen=True)
class ScanRun(StageRun):
    """A stage that learns from batches of scans."""

    @property
    def config(self) -> NetworkTraining:
        config: NetworkTraining = getattr(self.plan.recipe.training, self.name)
        return config

    def fit_options(self) -> FitOptions:
        """Return how the stage is fitted."""
        config = self.config
        return FitOptions(
            self.plan.recipe.training,
            self.folder,
            config.epochs,
            self.plan.options,
            accumulate=config.accumulate,
            clip=config.clip,
            ema=config.ema,
        )

    def loaders(self) -> Loaders:
        """Return the batches of scans."""
        training = self.plan.recipe.training
        scans = self.plan.scans
        processes = self.plan.options.processes

        # Scans that one process takes at a time.
        batch = self.config.batch // self.config.accumulate // processes.size
        train = make_loader(
            ScanSet(scans.dataset, scans.train, training.augment, training.seed, self.intensity),
            batch,
            shuffle=True,
            workers=training.workers,
            processes=processes,
        )
        if not scans.val:
            return Loaders(train, None)

        val = make_loader(
            ScanSet(scans.dataset, scans.val, intensity=self.intensity),
            1,
            shuffle=False,
            workers=training.workers,
            processes=processes,
        )
        return Loaders(train, val)


@dataclass(frozen=True)
class NetworkRun(ScanRun):
    """Stage `rv` or `bev`: one of the two networks (section 3.1 of the paper)."""

    @property
    def config(self) -> NetworkTraining:
        config: NetworkTraining = getattr(self.plan.recipe.training, self.name)
        return config

    @property
    def intensity(self) -> TrainedIntensity | None:
        dataset = self.plan.scans.dataset
        if isinstance(dataset, SimulatedStreets):
            return simulated_intensity(dataset.sensor)
        return super().intensity

    def fit_options(self) -> FitOptions:
        """Return how the stage is fitted."""
        return dataclasses.replace(super().fit_options(), initial=self.config.initial)

    def fit(self) -> None:
        # Before the scans are read for the class weights.
        if self.config.initial and self.parts[0] not in self.weights.parts:
            raise InputError(
                f"training.{self.name}.initial: expected weights to begin with, found none; give "
                "--init, or set it to 0"
            )

        model = self.model()
        weights = self.class_weights() if self.config.class_weights else None
        score = getattr(model, NETWORKS[self.name].score)
        callbacks = [self.keep_weights(), self.pictures(score)]
        fit(self._stage(model, weights), self.fit_options(), self.loaders(), callbacks)

    def trial(self, steps: int) -> Speed:
        """Take some steps, and return their speed; nothing is written."""
        model = self.model()
        # To compute class weights would need every scan; their values do not change the speed.
        uniform = class_weights(np.ones(self.weights.taxonomy.size))
        stage = self._stage(model, uniform if self.config.class_weights else None)
        options = dataclasses.replace(self.fit_options(), steps=steps)
        return fit(stage, options, self.loaders())

    def _stage(self, model: AMVNet, weights: np.ndarray | None) -> NetworkStage:
        network = NETWORKS[self.name]
        return network.stage(
            getattr(model, network.view),
            getattr(model, self.parts[0]),
            config=self.config,
            taxonomy=self.weights.taxonomy,
            weights=weights,
            processes=self.plan.options.processes,
        )


@dataclass(frozen=True)
class HeadRun(StageRun):
    """Stage `head`: the point head on scores of frozen networks (section 3.3 of the paper)."""

    @property
    def intensity(self) -> TrainedIntensity | None:
        # Other models' scores are of the scans as they are.
        return super().intensity if self.plan.scores is None else None

    def fit(self) -> None:
        training = self.plan.recipe.training
        config = training.head
        scans = self.plan.scans
        options = self.plan.options
        processes = options.processes

        # Gather the uncertain points of all scans, with their scores and neighbours.
        val_source = self._score_source(scans.val)
        model = self.weights.model
        gatherer = PointGatherer(scans.dataset, model, training, processes, self.intensity)
        train = gatherer.gather(
            self._score_sources(), self.folder / "train", config.views, options.say
        )
        val = None
        if scans.val:
            val = gatherer.gather([val_source], self.folder / "val")

        head = self.model().point_head
        assert head is not None
        weights = self.class_weights() if config.class_weights else None
        stage = HeadStage(
            head,
            train,
            val,
            config=config,
            taxonomy=scans.dataset.taxonomy,
            weights=weights,
            processes=processes,
        )

        labels = train.labels() if config.balance else None
        train_loader = make_head_loader(
            train,
            config.batch,
            shuffle=True,
            seed=training.seed,
            processes=processes,
            draw=PointDraw(len(train), config.drawn, labels, config.balance),
        )
        val_loader = None
        if val is not None:
            val_loader = make_head_loader(
                val,
                VAL_FACTOR * config.batch,
                shuffle=False,
                seed=training.seed,
                processes=processes,
            )

        callbacks: list[Callback] = [self.keep_weights()]
        # Pictures show batches of points, which do not say whose scores to read from files.
        if self.plan.scores is None:
            callbacks.append(
                self.pictures(scorer_with_head(self.weights, head, scans.dataset.is_normalised))
            )

        # The head multiplies so little that a lower precision would save nothing.
        in_float32 = dataclasses.replace(training, precision=SINGLE)
        fit_options = FitOptions(in_float32, self.folder, config.epochs, options)
        fit(stage, fit_options, Loaders(train_loader, val_loader), callbacks)

        # The gathered points take much space, and no process needs them any more.
        processes.wait()
        if processes.first:
            for folder in ("train", "val"):
                shutil.rmtree(self.folder / folder, ignore_errors=True)

    def _score_source(self, records: Sequence[ScanRecord]) -> ScoreSource:
        """Return the source of the scores of some scans."""
        by_ring = self.plan.scans.dataset.is_normalised
        return score_source(self.weights, self.plan.scores, records, by_ring)

    def _score_sources(self) -> list[ScoreSource]:
        """Return the sources of the scores to train on, which together have all training scans.

        With folds, the scans of each are scored by networks that were trained without them.

        Raises:
            InputError: if a network is missing, or there are fewer sequences than folds.
        """
        train = self.plan.scans.train
        folds = self.plan.recipe.training.head.folds
        if folds < 2 or self.plan.scores is not None:
            return [self._score_source(train)]

        names = sequence_names(train)
        if len(names) < folds:
            raise InputError(
                f"expected at least {folds} training sequences for {folds} folds, "
                f"found {len(names)}; name more, or set --training.head.folds"
            )
        return [self._fold(index, set(names[index::folds])) for index in range(folds)]

    def _fold(self, index: int, left_out: set[str]) -> NetworkScores:
        """Train networks without some sequences, and return them as the scorers of these.

        Args:
            index: number of the fold.
            left_out: names of the sequences.
        """
        scans = self.plan.scans
        seen = [record for record in scans.train if record.sequence not in left_out]
        unseen = [record for record in scans.train if record.sequence in left_out]
        # The scans that a fold scores say nothing about which of its epochs to use. Its networks
        # have no initial weights.
        training = self.plan.recipe.training
        training = dataclasses.replace(
            training,
            keep="last",
            rv=dataclasses.replace(training.rv, initial=0.0),
            bev=dataclasses.replace(training.bev, initial=0.0),
        )
        plan = dataclasses.replace(
            self.plan,
            recipe=dataclasses.replace(self.plan.recipe, training=training),
            scans=dataclasses.replace(scans, train=seen, val=unseen),
            out=self.plan.out / "folds" / str(index),
            options=dataclasses.replace(self.plan.options, resume=True),
        )

        weights = load(self.train_networks(plan))
        return NetworkScores(weights, unseen, scans.dataset.is_normalised)
