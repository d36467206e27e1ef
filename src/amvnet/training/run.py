"""The run of a training: its folder, its stages in order, and the weights file at its end."""

from __future__ import annotations

import dataclasses
import functools
import shutil
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Literal

import lightning as L
import numpy as np
import yaml
from torch import Tensor, nn

from amvnet.config.schema import NetworkTraining, Recipe, StageName
from amvnet.data.datasets.base import Dataset, ScanRecord
from amvnet.data.taxonomy import NUSCENES, SEMANTICKITTI
from amvnet.distributed import ALONE, Processes
from amvnet.errors import InputError
from amvnet.files import atomic_write
from amvnet.inference.score_files import ScorePair
from amvnet.models.amvnet import AMVNet, build_amvnet
from amvnet.models.views.points import PointBatch
from amvnet.training.callbacks import KeepWeights, Pictures, Speed
from amvnet.training.fit import FitOptions, fit
from amvnet.training.head_points import gather_points, make_head_loader
from amvnet.training.head_scores import NetworkScores, ScoreSource, score_source, scorer_with_head
from amvnet.training.head_stage import HeadStage
from amvnet.training.loaders import ScanSet, count_classes, make_loader
from amvnet.training.losses import class_weights
from amvnet.training.run_record import (
    SETTINGS,
    check_begun,
    sequence_names,
    stage_settings,
    write_record,
)
from amvnet.training.stages import PolarStage, RangeStage, Stage
from amvnet.weights import file as weights_file
from amvnet.weights.file import Weights, part_state

PART = {"rv": "range_net", "bev": "polar_net", "head": "point_head"}
PICTURED_SCANS = 2
TRIAL_STEPS = 2  # the second of them is timed


@dataclass
class Run:
    """One training run in its folder.

    Attributes:
        recipe: what to train.
        dataset: where the scans are.
        train, val: the scans to learn from, and those to validate with; none may be in both. Without any of the
            latter nothing is validated, and the last weights are kept.
        out: the folder of the run.
        resume: go on where an earlier run in this folder stopped.
        say: told what happens, in lines.
        bars: show progress bars instead of a line an epoch.
        processes: those that share the run; all must see its folder.
        scores: two other models' scores of the scans, for which the head is trained in place of the networks'.
    """

    recipe: Recipe
    dataset: Dataset
    train: Sequence[ScanRecord]
    val: Sequence[ScanRecord]
    out: Path
    resume: bool = False
    say: Callable[[str], None] = lambda line: None
    bars: bool = False
    processes: Processes = ALONE
    scores: ScorePair | None = None

    def __post_init__(self) -> None:
        self.out = Path(self.out)
        common = {r.name for r in self.train} & {r.name for r in self.val}
        if common:
            raise InputError(
                f"expected validation scans apart from training, found {min(common)} in both; name others"
            )
        size = self.processes.size
        if 0 < len(self.val) < size:  # each must have one, or they would wait for each other
            raise InputError(
                f"expected a validation scan for each of {size} processes, found {len(self.val)}; name more"
            )
        for name in ("rv", "bev"):
            config = getattr(self.recipe.training, name)
            if config.batch % (size * config.accumulate):
                raise InputError(
                    f"expected a batch for {size} processes, each in {config.accumulate} parts, found "
                    f"{config.batch}; set --training.{name}.batch or --training.{name}.accumulate"
                )
        benchmarks = {SEMANTICKITTI.name, NUSCENES.name}  # a user's own classes fit any recipe
        if self.dataset.taxonomy.name in benchmarks - {self.recipe.taxonomy}:
            raise InputError(
                f"expected a data set with the classes of {self.recipe.taxonomy}, found {self.dataset.taxonomy.name}; "
                "use the recipe of that benchmark"
            )

    def stages(
        self, stage: StageName | Literal["all"] = "all", init: Weights | None = None
    ) -> Path:
        """Train one stage, or all three; returns the weights file with what is trained so far.

        Raises:
            InputError: where the head is to be trained and there are no networks to train it for, or the
                folder holds a run and `resume` is not said.
        """
        names = self.recipe.stages if stage == "all" else (stage,)
        if self.scores is not None and names != ("head",):
            raise InputError(
                f"expected --stage head for scores of other models, found {stage}; add it"
            )
        current, path = self._start(init), self.out / "weights.safetensors"
        for name in names:  # before anything is written, and hours are spent on the first
            check_begun(self._folder(name), self._settings(name, current), self.resume)
        self.processes.wait()
        if self.processes.first:
            write_record(
                self.out, self.recipe, self.dataset, self.train, self.val, stage, init, self.scores
            )
        for name in names:
            current = self._stage(name, current)
            if self.processes.first:
                weights_file.save(
                    current, path
                )  # after each stage, so that one that fails takes nothing with it
            self.processes.wait()
        return path

    def _start(self, init: Weights | None) -> Weights:
        """Fresh weights, or those that are given; earlier stages of this folder are taken up."""
        current = Weights(self.recipe.model, self.dataset.taxonomy, self.recipe.sensor)
        # A head for other models is kept by itself: these networks are not those that it knows.
        used = PART if self.scores is None else {"head": PART["head"]}
        if init is not None:
            for part in [part for part in init.parts if part in used.values()]:
                current = current.replace_part(part, init)
        for name, part in used.items():
            kept = self._kept(name)
            if kept.is_file() and (self._folder(name) / "done").is_file():
                current = current.replace_part(part, weights_file.load(kept))
        return current

    def _folder(self, name: str) -> Path:
        return self.out / name

    def _kept(self, name: str) -> Path:
        """The weights of a stage that are used in the end."""
        return self._folder(name) / f"{self.recipe.training.keep}.safetensors"

    def _settings(self, name: str, current: Weights) -> dict[str, Any]:
        return stage_settings(
            self.recipe, name, PART[name], self.train, self.val, current, self.scores
        )

    def _stage(self, name: str, current: Weights) -> Weights:
        done = self._folder(name) / "done"
        if done.is_file() and self.resume:
            return current
        L.seed_everything(self.recipe.training.seed, verbose=False)
        current = current.resized(PART[name], self.recipe.model)
        if name == "head":
            self._fit_head(current)
        else:
            self._fit_network(name, current)
        self.processes.wait()
        current = current.replace_part(PART[name], weights_file.load(self._kept(name)))
        if self.processes.first:
            done.write_text("")
        return current

    def _module(self, part: str, current: Weights) -> AMVNet:
        """A model whose part to be trained begins as in the weights, where they have it."""
        model = build_amvnet(current.model, self.dataset.taxonomy.size)
        if part in current.parts:
            try:
                getattr(model, part).load_state_dict(current.part(part))
            except RuntimeError:
                raise InputError(
                    f"expected weights whose {part} has the recipe's sizes, found others; use the recipe of the weights"
                ) from None
        return model

    def trials(self, stage: StageName | Literal["all"]) -> Iterator[str]:
        """Take some steps of each network, and say what they cost; nothing is written."""
        fresh = self._start(None)
        for name in [n for n in ("rv", "bev") if stage in (n, "all")]:
            config = self._config(name)
            with TemporaryDirectory() as folder:
                # Whole steps, where there are fewer scans, too.
                scans = [
                    self.train[place % len(self.train)]
                    for place in range(TRIAL_STEPS * config.batch)
                ]
                trial = dataclasses.replace(
                    self, train=scans, val=(), out=Path(folder), resume=False
                )
                trial.say = lambda line: None
                # The classes' weights cost a look at every scan, and nothing else.
                speed = trial._fit_network(
                    name, fresh, np.ones(self.dataset.taxonomy.size), TRIAL_STEPS
                )
            step = speed.seconds[-1]
            hours = -(-len(self.train) // config.batch) * config.epochs * step / 3600
            yield (
                f"{name}: {step:.3g} s for a step of {config.batch} scans ({config.batch / step:.3g} scans/s), "
                f"memory so far {speed.memory / 2**30:.1f} GiB; "
                f"{config.epochs} epochs of {len(self.train)} scans would take {hours:.3g} h"
            )

    def _config(self, name: str) -> NetworkTraining:
        return self.recipe.training.rv if name == "rv" else self.recipe.training.bev

    def _fit_network(
        self,
        name: str,
        current: Weights,
        counts: np.ndarray | None = None,
        steps: int | None = None,
    ) -> Speed:
        training, config = self.recipe.training, self._config(name)
        model = self._module(PART[name], current)
        weights = (
            class_weights(self._counts() if counts is None else counts)
            if config.class_weights
            else None
        )
        shared = (config, self.dataset.taxonomy, weights, self.processes)
        stage: Stage = (
            RangeStage(model.range_view, model.range_net, *shared)
            if name == "rv"
            else PolarStage(model.polar_view, model.polar_net, *shared)
        )
        scored = model.score_range_view if name == "rv" else model.score_polar_view
        part = config.batch // config.accumulate // self.processes.size
        load = functools.partial(make_loader, workers=training.workers, processes=self.processes)
        course = self._course(name, config.epochs, config.accumulate, config.clip)
        return fit(
            stage,
            dataclasses.replace(course, steps=steps),
            load(
                ScanSet(self.dataset, self.train, training.augment, training.seed),
                part,
                shuffle=True,
            ),
            load(ScanSet(self.dataset, self.val), 1, shuffle=False) if self.val else None,
            []
            if steps
            else [self._keep(name, current), self._pictures(lambda batch: scored(batch))],
        )

    def _fit_head(self, current: Weights) -> None:
        training, config = self.recipe.training, self.recipe.training.head
        folder, validated = self._folder("head"), score_source(current, self.scores, self.val)
        gather = functools.partial(gather_points, dataset=self.dataset, model=current.model, training=training,
                                   processes=self.processes)  # fmt: skip
        train = gather(
            self._sources(current), views=config.views, folder=folder / "train", say=self.say
        )
        val = gather([validated], views=0, folder=folder / "val") if self.val else None
        head = self._module(PART["head"], current).point_head
        assert head is not None
        weights = class_weights(self._counts()) if config.class_weights else None
        load = functools.partial(make_head_loader, seed=training.seed, processes=self.processes)
        fit(
            HeadStage(head, train, val, config, self.dataset.taxonomy, weights, self.processes),
            self._course("head", config.epochs),
            load(train, config.batch, shuffle=True),
            load(val, 64 * config.batch, shuffle=False) if val is not None else None,
            # The pictures' scans are scored as they come, and of files nobody knows which scan that is.
            [
                self._keep("head", current),
                *([] if self.scores else [self._pictures(scorer_with_head(current, head))]),
            ],
        )
        self.processes.wait()
        if self.processes.first:
            for kind in ("train", "val"):
                shutil.rmtree(folder / kind, ignore_errors=True)

    def _course(
        self, name: str, epochs: int, parts: int = 1, clip: float | None = None
    ) -> FitOptions:
        training = self.recipe.training
        if name == "head":  # of so few multiplications bfloat16 would save nothing
            training = dataclasses.replace(training, precision="32-true")
        return FitOptions(
            training,
            self._folder(name),
            epochs,
            parts,
            clip,
            self.resume,
            self.say,
            self.bars,
            self.processes,
        )

    def _pictures(self, score: Callable[[PointBatch], Tensor]) -> Pictures:
        """Of the first and the last validation scan, say, by the (P, K) scores of a batch of one scan."""
        places = np.linspace(0, len(self.val) - 1, min(PICTURED_SCANS, len(self.val))).astype(int)
        scans = (
            [self.dataset.read(self.val[place]) for place in places] if self.processes.first else []
        )
        return Pictures(scans, self.dataset.taxonomy, lambda batch: score(batch).argmax(dim=1) + 1)

    def _sources(self, current: Weights) -> list[ScoreSource]:
        """What scores which training scans for the head: with folds, networks that have not seen them."""
        folds = self.recipe.training.head.folds
        if folds < 2 or self.scores is not None:
            return [score_source(current, self.scores, self.train)]
        names = sequence_names(self.train)
        if len(names) < folds:
            raise InputError(
                f"expected at least {folds} training sequences for {folds} folds, found {len(names)}"
            )
        return [self._fold(index, set(names[index::folds])) for index in range(folds)]

    def _fold(self, index: int, left_out: set[str]) -> NetworkScores:
        """Networks trained without some sequences, and the scans of these."""
        seen = [r for r in self.train if r.sequence not in left_out]
        unseen = [r for r in self.train if r.sequence in left_out]
        out = self.out / "folds" / str(index)
        fold = Run(
            self.recipe, self.dataset, seen, unseen, out, True, self.say, self.bars, self.processes
        )
        fold.stages("rv")
        return NetworkScores(weights_file.load(fold.stages("bev")), unseen)

    def _counts(self) -> Any:
        return count_classes(
            self.dataset, self.train, self.out / "class_counts.npz", self.processes
        )

    def _keep(self, name: str, current: Weights) -> KeepWeights:
        """How the part of a stage is written: with the description of what made it."""
        part, started = PART[name], time.time()
        settings = self._settings(name, current)
        made = {**settings["training"], "sequences": sequence_names(self.train),
                "validated_on": sequence_names(self.val), "scans": len(self.train),
                **{key: settings[key] for key in ("scores",) if key in settings}}  # fmt: skip

        def write(module: nn.Module, path: Path, reached: dict[str, float]) -> None:
            seconds = round(time.time() - started)
            kept = dataclasses.replace(
                current,
                tensors=part_state(part, module),
                training={part: {**made, "seconds": seconds}},
                metrics={part: reached},
            )
            weights_file.save(kept, path)
            with atomic_write(path.parent / SETTINGS) as file:
                file.write_text(yaml.safe_dump(settings, sort_keys=False))

        return KeepWeights(write, self._folder(name))
