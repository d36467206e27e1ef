"""The folder of a run: what earlier calls have left there, and what a call writes."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any, Literal

import numpy as np

from amvnet.config.nested import flat, to_dict
from amvnet.config.schema import PART_OF, Recipe, StageName
from amvnet.config.yaml_files import read_entries
from amvnet.data.datasets.open import is_dataset
from amvnet.errors import InputError, listed
from amvnet.files import alone_in, atomic_write, check_not_read, remove_unfinished, write_yaml
from amvnet.weights.file import DONE, RECORD, RUN_WEIGHTS, SETTINGS, Weights, read, save
from amvnet.weights.parts import replace_part

# Names of files in the folder of a stage.
LAST = "last.ckpt"  # the checkpoint that --resume continues from

# Names of files in the folder of a run.
RECIPE = "recipe.yaml"
CURVES = "curves.png"
COUNTS = "class_counts.npz"  # the number of points of each class

# What messages say about settings that are digests.
CHANGED = {
    "scans.train": "other scans to train on",
    "scans.val": "other scans to validate with",
    "init": "other weights to begin with (--init)",
    "classes": "other classes or ids of classes",
}
MAX_CHANGES = 6  # largest number of changed settings that a message names


class StageFolder:
    """The folder of a stage: its weights, its checkpoint, and the settings it was begun with."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.checkpoint = path / LAST

    @property
    def is_finished(self) -> bool:
        """Whether the stage was trained to its end."""
        return (self.path / DONE).is_file()

    @property
    def is_begun(self) -> bool:
        """Whether an epoch of the stage was trained."""
        # A finished stage does not need its checkpoint, so the file may be gone.
        return self.is_finished or self.checkpoint.is_file()

    def check_begun(self, settings: Mapping[str, Any] | None = None) -> None:
        """Check that the stage can begin here, or be resumed with some settings.

        Args:
            settings: the settings to resume with; None if an earlier run is not to be resumed.

        Raises:
            InputError: if the stage was begun before without settings, or with others.
        """
        if not self.is_begun:
            return
        if settings is None:
            raise InputError(
                f"{self.path}: expected no earlier run, found one; add --resume or give another "
                "folder"
            )
        begun = read_entries(self.path / SETTINGS)
        if begun != settings:
            changes = listed(describe_changes(begun, settings), MAX_CHANGES)
            raise InputError(
                f"{self.path}: expected the settings of the earlier run ({SETTINGS}), found "
                f"{changes}; resume it with them, or train further from its weights in another "
                f"folder: --init {self.path.parent} --out FOLDER"
            )

    def write(self, weights: Weights, kept: Sequence[str], settings: Mapping[str, Any]) -> None:
        """Write the part that an epoch has trained, and the settings of the stage.

        Args:
            kept: what the weights are: the "last" ones, and perhaps the "best" ones.
        """
        for name in kept:
            save(weights, self.path / f"{name}.safetensors")
        write_yaml(self.path / SETTINGS, settings)

    def finish(self) -> None:
        """Mark the stage as finished."""
        (self.path / DONE).write_text("")


class RunFolder:
    """The folder of a run, which holds a folder for each stage.

    Args:
        held: the stages whose parts belong together in the folder.
        kept: which weights of a stage count, the "best" or the "last" ones.
    """

    def __init__(
        self, path: Path, held: Sequence[StageName] = tuple(PART_OF), kept: str = "last"
    ) -> None:
        self.path = path
        self.held = held
        self.kept = kept
        self.weights = path / RUN_WEIGHTS
        self.curves = path / CURVES
        self.stages = {name: StageFolder(path / name) for name in PART_OF}

    @property
    def is_run(self) -> bool:
        """Whether an earlier call has trained here."""
        if any((stage.path / SETTINGS).is_file() for stage in self.stages.values()):
            return True
        entries = read_entries(self.path / RECORD).values()
        return any(isinstance(entry, dict) and "versions" in entry for entry in entries)

    def check_place(self, roots: Sequence[Path], also_read: Sequence[Path | str | None]) -> None:
        """Check that a run may write here: the folder is new, or an earlier run made it.

        Args:
            roots: the folders of the datasets.
            also_read: other inputs of the run.

        Raises:
            InputError: if a file that the run would write exists in the folder of no run, or is an
                input, or the folder is a dataset.
        """
        names = (RECIPE, RUN_WEIGHTS, COUNTS, CURVES, RECORD, *PART_OF)
        expected = f"{self.path}: expected a new folder or the folder of a run"
        is_data = self.path.resolve() in [root.resolve() for root in roots]
        if not self.is_run and (is_data or is_dataset(str(self.path))):
            raise InputError(f"{expected}, found a dataset; give another folder")
        check_not_read([self.path / name for name in names], also_read)
        present = [name for name in names if os.path.lexists(self.path / name)]
        if present and not self.is_run:
            raise InputError(
                f"{expected}, found {present[0]} without {RECORD}; give another folder"
            )

    @contextmanager
    def alone(self, stage: StageName | Literal["all"]) -> Iterator[None]:
        """Keep out other calls that train the same stages, and remove what killed calls have left.

        Both networks may be trained at the same time, by two calls.

        Raises:
            InputError: if another call is training one of the stages.
        """
        with ExitStack() as locks:
            for name in self.stages if stage == "all" else (stage,):
                locks.enter_context(alone_in(self.path, f".{name}.lock"))
            remove_unfinished(self.path if stage == "all" else self.path / stage)
            yield

    def with_trained(self, stage: StageName, weights: Weights) -> Weights:
        """Return weights with the part that a stage has trained."""
        trained = read(self.stages[stage].path / f"{self.kept}.safetensors")
        return replace_part(weights, PART_OF[stage].name, trained)

    def with_finished(self, weights: Weights) -> Weights:
        """Return weights with the parts that finished stages have trained.

        Another process may have finished some stages while this process trained.
        """
        for stage in self.held:
            if self.stages[stage].is_finished:
                weights = self.with_trained(stage, weights)
        return weights

    def networks(self) -> list[Weights]:
        """Return the networks that earlier calls have trained, or else those of their --init."""
        paths = [self.stages[name].path / "last.safetensors" for name in ("rv", "bev")]
        paths = [path for path in paths if path.is_file()]
        if not paths and self.weights.is_file():
            paths = [self.weights]
        return [read(path) for path in paths]

    def write_record(
        self, stage: str, entry: Mapping[str, Any], recipe: Recipe, counts: Mapping[str, Any]
    ) -> None:
        """Write the entry of a call into run.yaml, its recipe, and the points of each class.

        Entries of earlier calls for other stages stay. The new entry comes last.

        Args:
            counts: the arrays of `COUNTS`.
        """
        tree = to_dict(recipe)
        if recipe.from_init:
            del tree["model"]
        entries = read_entries(self.path / RECORD)
        entries.pop(stage, None)
        entries[stage] = entry

        write_yaml(self.path / RECORD, entries)  # first, because it marks the folder of a run
        write_yaml(self.path / RECIPE, tree)
        with atomic_write(self.path / COUNTS) as part:
            np.savez(part, **counts)

    def save(self, weights: Weights) -> None:
        """Write the weights of the run: some weights, with all parts that the folder has."""
        whole = self.with_finished(weights)
        save(whole, self.weights)


def describe_changes(earlier: Mapping[str, Any], settings: Mapping[str, Any]) -> list[str]:
    """Return the differences between the settings of a stage, a text for each.

    A text reads "training.rv.lr 0.1 instead of 0.2". Digests mean nothing to people. If one has
    changed, the text says what it stands for, such as "other scans to train on".
    """
    before = dict(flat(earlier))
    now = dict(flat(settings))
    changes = []
    for name in now | before:
        if now.get(name) == before.get(name):
            continue
        if name.startswith(("model.", "training.")):
            changes.append(f"{name} {now.get(name)} instead of {before.get(name)}")
        elif name in CHANGED:
            changes.append(CHANGED[name])
        else:
            changes.append(f"another {name}")
    return changes
