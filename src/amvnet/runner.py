"""The run of a training: its folder, its stages in order, and the weights file at its end."""

from __future__ import annotations

import dataclasses
import hashlib
import platform
import shlex
import shutil
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path
from typing import Any, Literal

import lightning as L
import yaml
from torch import nn

from amvnet import weights as weights_file
from amvnet.callbacks import KeepWeights
from amvnet.config import Recipe
from amvnet.data.files import whole_file
from amvnet.data.labels import NUSCENES, SEMANTICKITTI
from amvnet.data.records import Dataset, ScanRecord
from amvnet.errors import InputError
from amvnet.head_training import HeadStage, gather_points, head_loader
from amvnet.loading import ScanSet, count_classes, loader
from amvnet.losses import class_weights
from amvnet.models.amvnet import AMVNet, build_amvnet
from amvnet.training import LAST, PolarStage, RangeStage, Stage, fit, names_of
from amvnet.trees import to_dict
from amvnet.weights import SIZES, Weights, state_of

StageName = Literal["rv", "bev", "head", "all"]
SETTINGS = "stage.yaml"  # in a stage's folder: what it was begun with
PART = {"rv": "range_net", "bev": "polar_net", "head": "point_head"}


@dataclass
class Run:
    """One training run in its folder.

    Attributes:
        recipe: what to train.
        dataset: where the scans are.
        train, val: the scans to learn from, and those to validate with; none may be in both.
        out: the folder of the run.
        resume: go on where an earlier run in this folder stopped.
        say: told what happens, in lines.
        bars: show progress bars instead of a line an epoch.
    """

    recipe: Recipe
    dataset: Dataset
    train: Sequence[ScanRecord]
    val: Sequence[ScanRecord]
    out: Path
    resume: bool = False
    say: Callable[[str], None] = lambda line: None
    bars: bool = False

    def __post_init__(self) -> None:
        self.out = Path(self.out)
        common = {r.name for r in self.train} & {r.name for r in self.val}
        if common:
            raise InputError(f"expected validation scans apart from training, found {min(common)} in both; name others")
        benchmarks = {SEMANTICKITTI.name, NUSCENES.name}  # a user's own classes fit any recipe
        if self.dataset.taxonomy.name in benchmarks - {self.recipe.taxonomy}:
            raise InputError(
                f"expected a data set with the classes of {self.recipe.taxonomy}, found {self.dataset.taxonomy.name}; "
                "use the recipe of that benchmark"
            )

    def stages(self, stage: StageName, init: Weights | None = None) -> Path:
        """Train one stage, or all three; returns the weights file with what is trained so far.

        Raises:
            InputError: where the head is to be trained and there are no networks to train it for, or the
                folder holds a run and `resume` is not said.
        """
        names = ("rv", "bev", "head") if stage == "all" else (stage,)
        current, path = self._start(init), self.out / "weights.safetensors"
        for name in names:
            self._check_earlier(name, current)  # before anything is written, and hours are spent on the first
        self._describe(stage, init)
        for name in names:
            current = self._stage(name, current)
            weights_file.save(current, path)  # after each stage, so that one that fails takes nothing with it
        return path

    def _start(self, init: Weights | None) -> Weights:
        """Fresh weights, or those that are given; earlier stages of this folder are taken up."""
        current = Weights(self.recipe.model, self.dataset.taxonomy, self.recipe.sensor)
        if init is not None:
            for part in init.parts:
                current = current.replace_part(part, init)
        for name, part in PART.items():
            kept = self._folder(name) / f"{self.recipe.training.keep}.safetensors"
            if kept.is_file() and (self._folder(name) / "done").is_file():
                current = current.replace_part(part, weights_file.load(kept))
        return current

    def _describe(self, stage: str, init: Weights | None) -> None:
        """Write the recipe, and in run.yaml with what a stage (or all) is made, on what, and how to make it again."""
        path = self.out / "run.yaml"
        # Another call of this folder may have trained another stage on other scans: its entry stays, before this one.
        earlier = {key: value for key, value in self._calls(path).items() if key != stage}
        trees = {"recipe.yaml": to_dict(self.recipe), path.name: {**earlier, stage: self._described(stage, init)}}
        for name, tree in trees.items():
            with whole_file(self.out / name) as part:
                part.write_text(yaml.safe_dump(tree, sort_keys=False, width=1000))

    @staticmethod
    def _calls(path: Path) -> dict[str, Any]:
        """What run.yaml holds so far, by stage; nothing where it cannot be read."""
        try:
            found = yaml.safe_load(path.read_text())
        except (OSError, ValueError, yaml.YAMLError):
            return {}
        return found if isinstance(found, dict) else {}

    def _described(self, stage: str, init: Weights | None) -> dict[str, Any]:
        train, val = names_of(self.train), names_of(self.val)
        command = ["amvnet", "train", self.out / "recipe.yaml", "--data", self.dataset.root, "--stage", stage]
        command += ["--train-sequences", ",".join(train), "--val-sequences", ",".join(val)]
        # Weights that were given have no name here; their digests below tell whether it is they.
        command += ["--init", "WEIGHTS"] if init is not None else []
        command += ["--out", f"{self.out}-again"]
        return {
            "repeat": shlex.join(map(str, command)),
            "versions": {name: metadata.version(name) for name in ("amvnet", "torch", "lightning", "numpy")},
            "python": platform.python_version(),
            "data": str(self.dataset.root),
            "classes": self.dataset.taxonomy.name,
            "train": train,
            "val": val,
            "init": None if init is None else {part: init.digest(part) for part in init.parts},
        }

    def _folder(self, name: str) -> Path:
        return self.out / name

    def _settings(self, name: str, current: Weights) -> dict[str, Any]:
        """What the weights of a stage depend on; the data may move to another folder meanwhile."""
        tree = to_dict(self.recipe)
        training = {key: tree["training"][key] for key in (name, "augment", "seed", "precision", "accumulate")}
        found = {"model": {key: tree["model"][key] for key in SIZES[PART[name]]}, "training": training}
        found["scans"] = {split: _digest_of_scans(getattr(self, split)) for split in ("train", "val")}
        if name == "head":
            found["networks"] = {part: current.digest(part) for part in ("range_net", "polar_net")}
        return found

    def _check_earlier(self, name: str, current: Weights) -> None:
        """Raises InputError where the folder holds this stage of a run that is not to be resumed, or of another."""
        folder = self._folder(name)
        if not (folder / LAST).is_file():
            return
        if not self.resume:
            raise InputError(f"{folder}: expected no earlier run, found one; add --resume or give another")
        begun = yaml.safe_load((folder / SETTINGS).read_text()) if (folder / SETTINGS).is_file() else {}
        now = self._settings(name, current)
        if begun != now:
            other = ", ".join(key for key in now if begun.get(key) != now[key])
            raise InputError(f"{folder}: expected what it was begun with ({SETTINGS}), found another {other}; "
                             "resume it with that, or give another folder")  # fmt: skip

    def _stage(self, name: str, current: Weights) -> Weights:
        done = self._folder(name) / "done"
        if done.is_file() and self.resume:
            return current
        L.seed_everything(self.recipe.training.seed, verbose=False)
        current = current.resized(PART[name], self.recipe.model)
        kept = self._fit_head(current) if name == "head" else self._fit_network(name, current)
        current = current.replace_part(PART[name], weights_file.load(kept))
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

    def _fit_network(self, name: str, current: Weights) -> Path:
        training = self.recipe.training
        config = training.rv if name == "rv" else training.bev
        model = self._module(PART[name], current)
        weights = class_weights(self._counts()) if config.class_weights else None
        shared = (config, self.dataset.taxonomy, weights)
        stage: Stage = (
            RangeStage(model.range_view, model.range_net, *shared)
            if name == "rv"
            else PolarStage(model.polar_view, model.polar_net, *shared)
        )
        keep = self._keep(name, current)
        part = config.batch // training.accumulate
        fit(
            stage,
            training,
            config.epochs,
            loader(ScanSet(self.dataset, self.train, training.augment, training.seed), part, training.workers, True),
            loader(ScanSet(self.dataset, self.val), 1, training.workers, False),
            self._folder(name),
            keep,
            self.resume,
            self.say,
            self.bars,
            training.accumulate,
            config.clip,
        )
        return getattr(keep.kept, training.keep)

    def _fit_head(self, current: Weights) -> Path:
        training, config = self.recipe.training, self.recipe.training.head
        missing = [part for part in ("range_net", "polar_net") if part not in current.parts]
        if missing:
            raise InputError(f"expected trained networks for the head, found no {missing[0]}; train it, or give --init")
        sources = self._sources(current)
        folder = self._folder("head")
        train = gather_points(sources, self.dataset, training, config.views, folder / "train", self.say)
        val = gather_points([(current, self.val)], self.dataset, training, 0, folder / "val")
        head = self._module(PART["head"], current).point_head
        assert head is not None
        weights = class_weights(self._counts()) if config.class_weights else None
        keep = self._keep("head", current)
        fit(
            HeadStage(head, val.certain, config, self.dataset.taxonomy, weights),
            dataclasses.replace(training, precision="32-true"),
            config.epochs,
            head_loader(train, config.batch, training.seed, True),
            head_loader(val, 64 * config.batch, training.seed, False),
            folder,
            keep,
            self.resume,
            self.say,
            self.bars,
        )
        for points in (train, val):
            shutil.rmtree(points.folder)
        return getattr(keep.kept, training.keep)

    def _sources(self, current: Weights) -> list[tuple[Weights, Sequence[ScanRecord]]]:
        """Which networks score which training scans for the head: with folds, such as have not seen them."""
        folds = self.recipe.training.head.folds
        if folds < 2:
            return [(current, self.train)]
        names = names_of(self.train)
        if len(names) < folds:
            raise InputError(f"expected at least {folds} training sequences for {folds} folds, found {len(names)}")
        return [self._fold(index, set(names[index::folds])) for index in range(folds)]

    def _fold(self, index: int, left_out: set[str]) -> tuple[Weights, list[ScanRecord]]:
        """Networks trained without some sequences, and the scans of these."""
        seen = [r for r in self.train if r.sequence not in left_out]
        unseen = [r for r in self.train if r.sequence in left_out]
        fold = Run(self.recipe, self.dataset, seen, unseen, self.out / "folds" / str(index), True, self.say, self.bars)
        fold.stages("rv")
        return weights_file.load(fold.stages("bev")), unseen

    def _counts(self) -> Any:
        return count_classes(self.dataset, self.train, self.out / "class_counts.npz")

    def _keep(self, name: str, current: Weights) -> KeepWeights:
        """How the part of a stage is written: with the description of what made it."""
        part, started = PART[name], time.time()
        settings = self._settings(name, current)
        made = {**settings["training"], "sequences": names_of(self.train),
                "validated_on": names_of(self.val), "scans": len(self.train)}  # fmt: skip

        def write(module: nn.Module, path: Path, reached: dict[str, float]) -> None:
            seconds = round(time.time() - started)
            kept = dataclasses.replace(
                current,
                tensors=state_of(part, module),
                training={part: {**made, "seconds": seconds}},
                metrics={part: reached},
            )
            weights_file.save(kept, path)
            with whole_file(path.parent / SETTINGS) as file:
                file.write_text(yaml.safe_dump(settings, sort_keys=False))

        return KeepWeights(write, self._folder(name))


def _digest_of_scans(records: Sequence[ScanRecord]) -> str:
    """Tells scans from other ones by their names and sizes."""
    paths = [(record.name, record.points_path) for record in records]
    known = [(name, path.stat().st_size if path.is_file() else None) for name, path in paths]
    return hashlib.sha256(repr(known).encode()).hexdigest()[:16]
