"""A training run: its stages in order, and the weights file at its end."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Literal

from amvnet.config.schema import StageName
from amvnet.errors import InputError
from amvnet.training.memory_estimate import check_memory
from amvnet.training.run_plan import RunOptions, RunPlan
from amvnet.training.run_record import initial_digests, write_record
from amvnet.training.stage_run import HeadRun, NetworkRun, StageRun
from amvnet.weights.file import Weights, save

# The stages in order: the part of the weights that each trains, and how.
STAGES: dict[str, tuple[str, type[StageRun]]] = {
    "rv": ("range_net", NetworkRun),
    "bev": ("polar_net", NetworkRun),
    "head": ("point_head", HeadRun),
}
TRIAL_STEPS = 2  # the second of them is timed


@dataclass(frozen=True)
class Run:
    """A training run in its folder."""

    plan: RunPlan

    def stages(
        self, stage: StageName | Literal["all"] = "all", init: Weights | None = None
    ) -> Path:
        """Train one stage, or all stages of the recipe.

        Args:
            stage: name of the stage, or "all".
            init: weights to begin with.

        Returns:
            The weights file, with all parts that have been trained so far.

        Raises:
            InputError: if the head is to be trained without trained networks, or the folder holds a
                run that is not to be resumed or was begun with other settings.
        """
        plan = self.plan
        names = plan.recipe.stages if stage == "all" else (stage,)
        if plan.scores is not None and names != ("head",):
            raise InputError(
                f"expected --stage head for scores of other models, found {stage}; add it"
            )

        # Check all stages before anything is written, and before hours are spent on the first.
        if init is not None:
            self._check_init(init, names)
        weights = self._start(init, names)
        for name in names:
            self._stage(name, weights).check_begun()
        processes = plan.options.processes
        processes.wait()
        if processes.first:
            write_record(plan, stage, init)

        # Save after each stage, so that one that fails does not lose the others.
        path = plan.out / "weights.safetensors"
        for name in names:
            weights = self._stage(name, weights).train()
            if processes.first:
                save(self._with_finished(weights), path)
            processes.wait()
        return path

    def _start(self, init: Weights | None, trained: Sequence[str] = ()) -> Weights:
        """Return fresh weights with the parts of `init`, and of this folder's finished stages.

        If `init` has other classes, its parts are only taken for the stages that are to be trained.
        """
        plan = self.plan
        weights = Weights(plan.recipe.model, plan.scans.dataset.taxonomy, plan.recipe.sensor)
        for name in self._of_folder:
            part, _ = STAGES[name]
            if init is None or part not in init.parts:
                continue
            # A new kind of head can be trained on the networks of any weights.
            if name == "head" and name in trained and not init.fits(part, plan.recipe.model):
                plan.options.say("head: new, as that of the initial weights has other sizes")
                continue
            if init.taxonomy.classes == weights.taxonomy.classes:
                weights = weights.replace_part(part, init)
            elif name in trained:
                weights = weights.replace_part(part, self._for_classes(init, part))

        return self._with_finished(weights)

    @property
    def _of_folder(self) -> Sequence[str]:
        """Return the names of the stages that the folder can hold."""
        # A head for other models' scores is of no use to these networks.
        return list(STAGES) if self.plan.scores is None else ["head"]

    def _with_finished(self, weights: Weights) -> Weights:
        """Return the weights with the parts of this folder's finished stages.

        Another process may have finished some of them while this one trained.
        """
        for name in self._of_folder:
            weights = self._stage(name, weights).finished_weights()
        return weights

    def _for_classes(self, init: Weights, part: str) -> Weights:
        """Return initial weights whose last layers are new, for the classes of the dataset."""
        plan = self.plan
        taxonomy = plan.scans.dataset.taxonomy
        weights, new = init.for_classes(taxonomy, plan.recipe.training.seed)
        of_part = [name.removeprefix(f"{part}.") for name in new if name.startswith(f"{part}.")]
        plan.options.say(
            f"{part}: for the classes of {taxonomy.name}, all layers of the initial weights "
            f"({init.taxonomy.name}) but {', '.join(of_part)}, which are new"
        )
        return weights

    def _check_init(self, init: Weights, names: Sequence[str]) -> None:
        """Check that no part of the initial weights would be ignored.

        A finished stage of this folder, or one that is resumed, goes on from its own weights. If it
        was begun with the same initial weights, or has become them, nothing is ignored.

        Args:
            init: the initial weights.
            names: of the stages to train.

        Raises:
            InputError: if a part would be ignored.
        """
        empty = Weights(self.plan.recipe.model, self.plan.scans.dataset.taxonomy)
        for name, (part, _) in STAGES.items():
            stage = self._stage(name, empty)
            is_resumed = name in names and stage.is_begun
            if part not in init.parts or not (stage.is_finished or is_resumed):
                continue

            digest = init.digest(part)
            finished = stage.finished_weights()
            is_the_same = part in finished.parts and finished.digest(part) == digest
            if not is_the_same and digest not in initial_digests(self.plan.out, part):
                raise InputError(
                    f"{stage.folder}: expected no earlier run of the stage {name} for other "
                    f"weights with {part}, found one; leave out --init, or give another folder"
                )

    def _stage(self, name: str, weights: Weights) -> StageRun:
        part, kind = STAGES[name]
        return kind(self.plan, name, (part,), weights, train_networks=train_networks)

    def trials(self, stage: StageName | Literal["all"]) -> Iterator[str]:
        """Take some steps of each network; yield lines on their memory and time. Write nothing.

        Raises:
            InputError: if a step clearly needs more memory than is free, or the stage trains none
                of the networks alone; then no step is taken.
        """
        weights = self._start(None)
        names = [name for name in ("rv", "bev") if stage in (name, "all")]
        if not names:
            raise InputError(
                f"expected --stage rv, bev or all for a dry run, found {stage}; give one of these"
            )

        plan = self.plan
        scan = plan.scans.dataset.read(plan.scans.train[0], labels=False)
        for name in names:
            processes = plan.options.processes.size
            yield check_memory(plan.recipe, name, scan, weights.taxonomy.size, processes)

        for name in names:
            with TemporaryDirectory() as folder:
                yield self._trial(name, weights, Path(folder))

    def _trial(self, name: str, weights: Weights, folder: Path) -> str:
        train = self.plan.scans.train
        batch = getattr(self.plan.recipe.training, name).batch
        epochs = getattr(self.plan.recipe.training, name).epochs

        # Whole steps, even if there are fewer scans.
        scans = [train[index % len(train)] for index in range(TRIAL_STEPS * batch)]
        plan = dataclasses.replace(
            self.plan,
            scans=dataclasses.replace(self.plan.scans, train=scans, val=()),
            out=folder,
            options=RunOptions(bars=self.plan.options.bars, processes=self.plan.options.processes),
        )
        trial = Run(plan)._stage(name, weights)
        assert isinstance(trial, NetworkRun)
        speed = trial.trial(TRIAL_STEPS)

        step_seconds = speed.seconds[-1]
        steps_per_epoch = -(-len(train) // batch)  # rounded up
        hours = steps_per_epoch * epochs * step_seconds / 3600
        return (
            f"{name}: {step_seconds:.3g} s for a step of {batch} scans "
            f"({batch / step_seconds:.3g} scans/s), "
            f"memory so far {speed.memory / 2**30:.1f} GiB; "
            f"{epochs} epochs of {len(train)} scans would take {hours:.3g} h"
        )


def train_networks(plan: RunPlan) -> Path:
    """Train both networks of a plan; return their weights file."""
    run = Run(plan)
    run.stages("rv")
    return run.stages("bev")
