"""Read and write the folder of a run: its recipe, its data, and the progress of each stage."""

from __future__ import annotations

import hashlib
import os
import platform
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from amvnet.config.nested import flat, to_dict
from amvnet.config.yaml_files import parse_yaml
from amvnet.data.datasets.base import ScanRecord
from amvnet.data.datasets.open import is_dataset
from amvnet.data.datasets.training_data import TrainingData
from amvnet.errors import InputError, listed
from amvnet.files import alone_in, atomic_write, remove_unfinished
from amvnet.models.methods import BOTH_NETWORKS
from amvnet.outputs import check_not_read
from amvnet.training.expectation import NETWORK_OF
from amvnet.training.plan import Plan
from amvnet.weights.file import Weights, read
from amvnet.weights.parts import SIZES, replace_part

# The stages in order, and the part of the weights that each of them trains.
PART_OF = {**NETWORK_OF, "head": "point_head"}

# Names of files in the folder of a stage.
LAST = "last.ckpt"  # the checkpoint that --resume continues from
DONE = "done"  # an empty file, which exists if the stage is finished
SETTINGS = "stage.yaml"  # the settings that the stage was begun with

# Names of files in the folder of a run.
RECORD = "run.yaml"  # the inputs of each call
RECIPE = "recipe.yaml"
WEIGHTS = "weights.safetensors"
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
PACKAGES = ("amvnet", "torch", "lightning", "numpy")  # the packages whose versions are recorded


def is_run(out: Path) -> bool:
    """Return whether a folder is the folder of a run."""
    if any((out / stage / SETTINGS).is_file() for stage in PART_OF):
        return True
    entries = _entries(out / RECORD).values()
    return any(isinstance(entry, dict) and "versions" in entry for entry in entries)


def check_folder(plan: Plan) -> None:
    """Check that a run may write into its folder: the folder is new, or an earlier run made it.

    Raises:
        InputError: if a file that the run would write exists in the folder of no run, or is an
            input, or the folder is a dataset.
    """
    names = (RECIPE, WEIGHTS, COUNTS, CURVES, RECORD, *PART_OF)
    check_not_read([plan.out / name for name in names], plan.also_read)
    if is_run(plan.out):
        return
    roots = [source.dataset.root.resolve() for source in plan.data.sources]
    if is_dataset(str(plan.out)) or plan.out.resolve() in roots:
        raise InputError(
            f"{plan.out}: expected a new folder or the folder of a run, found a dataset; give "
            "another folder"
        )
    for name in names:
        if os.path.lexists(plan.out / name):
            raise InputError(
                f"{plan.out}: expected a new folder or the folder of a run, found {name} without "
                f"{RECORD}; give another folder"
            )


@contextmanager
def alone_in_run(plan: Plan) -> Iterator[None]:
    """Keep out other calls that train the same stages, and remove what killed calls have left.

    Both networks may be trained at the same time, by two calls. Of the processes that share a call,
    the first one does this.

    Raises:
        InputError: if another call is training one of the stages.
    """
    if not plan.processes.first:
        yield
        return

    with ExitStack() as locks:
        for name in PART_OF if plan.stage == "all" else (plan.stage,):
            locks.enter_context(alone_in(plan.out, f".{name}.lock"))
        remove_unfinished(plan.out if plan.stage == "all" else plan.out / plan.stage)
        yield


def is_finished(plan: Plan, name: str) -> bool:
    """Return whether a stage is finished in the folder of the run."""
    return (plan.out / name / DONE).is_file()


def with_trained(plan: Plan, name: str, weights: Weights) -> Weights:
    """Return the weights with the part that a stage has trained: its best or last one.

    The recipe decides which of the two is kept.
    """
    path = plan.out / name / f"{plan.recipe.training.keep}.safetensors"
    return replace_part(weights, PART_OF[name], read(path))


def with_finished(plan: Plan, weights: Weights) -> Weights:
    """Return the weights with the parts that the finished stages of this folder have trained.

    Another process may have finished some stages while this process trained.
    """
    for name in stages_of_folder(plan):
        if is_finished(plan, name):
            weights = with_trained(plan, name, weights)
    return weights


def stages_of_folder(plan: Plan) -> Sequence[str]:
    """Return the names of the stages that the folder can hold."""
    # The networks of this folder cannot use a head that was trained on other models' scores.
    return list(PART_OF) if plan.scores is None else ["head"]


def write_record(plan: Plan, counts: np.ndarray) -> None:
    """Write the entry of this call into run.yaml, recipe.yaml, and the points of each class.

    Args:
        counts: (K,) counts of points by class, from which later calls take their class weights.
    """
    specs = plan.data.specs
    entry: dict[str, Any] = {
        "versions": {name: version(name) for name in PACKAGES},
        "python": platform.python_version(),
        "data": specs if len(specs) > 1 else specs[0],
        "classes": plan.data.taxonomy.name,
        "train": sequence_names(plan.data.train),
        "val": sequence_names(plan.data.val),
        "init": None if plan.init is None else plan.init.digests(),
    }
    if plan.scores is not None:
        entry["scores"] = repr(plan.scores)

    # Entries of earlier calls for other stages stay. The new entry comes last.
    entries = _entries(plan.out / RECORD)
    entries.pop(plan.stage, None)
    entries[plan.stage] = entry
    write_yaml(plan.out / RECORD, entries)  # first, because it marks the folder of a run
    recipe = to_dict(plan.recipe)
    if plan.recipe.from_init:
        del recipe["model"]
    write_yaml(plan.out / RECIPE, recipe)
    with atomic_write(plan.out / COUNTS) as part:
        names = [record.name for record in plan.data.train]
        np.savez(part, counts=counts, scans=names, classes=plan.data.taxonomy.classes)


def write_yaml(path: Path, tree: dict[str, Any]) -> None:
    """Write a YAML file, whole or not at all, with its keys in their order."""
    with atomic_write(path) as part:
        part.write_text(yaml.safe_dump(tree, sort_keys=False, width=1000))


def _entries(path: Path) -> dict[str, Any]:
    try:
        entries = parse_yaml(path.read_text(), f"{path}: expected the record of a run")
    except (OSError, ValueError):
        return {}
    return entries if isinstance(entries, dict) else {}


def stage_settings(plan: Plan, name: str, weights: Weights) -> dict[str, Any]:
    """Return all settings that the trained weights of a stage depend on, as a tree for YAML.

    Paths are left out, so that the data may move to another folder before the stage is resumed.
    """
    recipe = to_dict(plan.recipe)
    training_keys = [name, "augment", "seed", "precision"]
    part = PART_OF[name]
    train = plan.data.train
    val = plan.data.val
    settings: dict[str, Any] = {
        "model": {key: recipe["model"][key] for key in SIZES[part]},
        "training": {key: recipe["training"][key] for key in training_keys},
        "scans": {"train": _digest_of_scans(train), "val": _digest_of_scans(val)},
        "init": plan.init.digest(part) if plan.init and part in plan.init.parts else None,
        "classes": _digest_of_classes(plan.data),
    }

    if plan.scores is not None:
        settings["scores"] = plan.scores.digests([*train, *val])
    elif name == "head":
        settings["networks"] = {network: weights.digest(network) for network in BOTH_NETWORKS}
    return settings


def stage_record(plan: Plan, settings: dict[str, Any]) -> dict[str, Any]:
    """Return the record of a stage's training by some `stage_settings`; its weights store it."""
    scores = {"scores": settings["scores"]} if "scores" in settings else {}
    return {
        **settings["training"],
        "sequences": sequence_names(plan.data.train),
        "validated_on": sequence_names(plan.data.val),
        "scans": len(plan.data),
        **scores,
    }


def check_new(folder: Path) -> None:
    """Raise InputError if a stage was begun in a folder before."""
    if _is_begun(folder):
        raise InputError(
            f"{folder}: expected no earlier run, found one; add --resume or give another folder"
        )


def _is_begun(folder: Path) -> bool:
    # A finished stage does not need its checkpoint, so the file may be gone.
    return any((folder / name).is_file() for name in (LAST, DONE))


def check_begun(folder: Path, settings: dict[str, Any], resume: bool) -> None:
    """Check that a stage can begin in a folder, or be resumed there.

    Raises:
        InputError: if the stage was begun before, and either is not to be resumed or had other
            settings.
    """
    if not resume:
        check_new(folder)
    if not _is_begun(folder):
        return

    begun = _entries(folder / SETTINGS)
    for key in ("init", "classes"):  # which runs of version 0.3 do not have
        if key in settings:
            begun.setdefault(key, settings[key])
    if begun != settings:
        changes = listed(describe_changes(begun, settings), MAX_CHANGES)
        raise InputError(
            f"{folder}: expected the settings of the earlier run ({SETTINGS}), found {changes}; "
            "resume it with them, or train further from its weights in another folder: "
            f"--init {folder.parent} --out FOLDER"
        )


def describe_changes(earlier: dict[str, Any], settings: dict[str, Any]) -> list[str]:
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


def sequence_names(records: Sequence[ScanRecord]) -> list[str]:
    """Return the sorted names of the sequences of some scans, each once."""
    return sorted({record.sequence for record in records})


def _digest_of_classes(data: TrainingData) -> str:
    """Return a digest of the classes' names in order, and of their raw ids in each dataset."""
    classes = []
    for source in data.sources:
        taxonomy = source.dataset.taxonomy
        classes.append((taxonomy.classes, sorted(taxonomy.raw_to_train.items(), key=str)))
    return hashlib.sha256(repr(classes).encode()).hexdigest()[:16]


def _digest_of_scans(records: Sequence[ScanRecord]) -> str:
    """Return a digest of the names of some scans and the sizes of their files."""
    sizes = []
    for record in records:
        path = record.points_path
        sizes.append((record.name, path.stat().st_size if path.is_file() else None))
    return hashlib.sha256(repr(sizes).encode()).hexdigest()[:16]
