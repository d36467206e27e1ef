"""What the folder of a run records: its recipe, and how each call can be repeated."""

from __future__ import annotations

import hashlib
import platform
import shlex
from collections.abc import Sequence
from importlib.metadata import version
from pathlib import Path
from typing import Any

import yaml

from amvnet.config.nested import to_dict
from amvnet.data.datasets.base import ScanRecord
from amvnet.errors import InputError
from amvnet.files import atomic_write
from amvnet.training.fit import LAST
from amvnet.training.run_plan import RunPlan
from amvnet.weights.file import SIZES, Weights

SETTINGS = "stage.yaml"  # in a stage's folder: what it was begun with
PACKAGES = ("amvnet", "torch", "lightning", "numpy")


def write_record(plan: RunPlan, stage: str, init: Weights | None) -> None:
    """Write recipe.yaml, and the entry of a stage (or "all") in run.yaml.

    The entry says what is made, on which data, and by which command it can be repeated.
    """
    dataset = plan.scans.dataset
    entry: dict[str, Any] = {
        "repeat": shlex.join(_repeat_command(plan, stage, init is not None)),
        "versions": {name: version(name) for name in PACKAGES},
        "python": platform.python_version(),
        "data": str(dataset.root),
        "classes": dataset.taxonomy.name,
        "train": sequence_names(plan.scans.train),
        "val": sequence_names(plan.scans.val),
        "init": None if init is None else {part: init.digest(part) for part in init.parts},
    }
    if plan.scores is not None:
        entry["scores"] = plan.scores.to_dict()

    # Another call may have trained another stage on other scans: its entry stays, before this one.
    entries = _entries(plan.out / "run.yaml")
    entries.pop(stage, None)
    entries[stage] = entry
    _write_yaml(plan.out / "recipe.yaml", to_dict(plan.recipe))
    _write_yaml(plan.out / "run.yaml", entries)


def _write_yaml(path: Path, tree: dict[str, Any]) -> None:
    with atomic_write(path) as part:
        part.write_text(yaml.safe_dump(tree, sort_keys=False, width=1000))


def _entries(path: Path) -> dict[str, Any]:
    """Return what run.yaml holds so far, by stage; nothing if it cannot be read."""
    try:
        entries = yaml.safe_load(path.read_text())
    except (OSError, ValueError, yaml.YAMLError):
        return {}
    return entries if isinstance(entries, dict) else {}


def _repeat_command(plan: RunPlan, stage: str, has_init: bool) -> list[str]:
    """Return the command that repeats a run."""
    scans = plan.scans
    command = ["amvnet", "train", str(plan.out / "recipe.yaml")]
    command += ["--data", str(scans.dataset.root), "--stage", stage]
    command += ["--train-sequences", ",".join(sequence_names(scans.train))]
    if scans.val:
        command += ["--val-sequences", ",".join(sequence_names(scans.val))]
    else:
        command += ["--with-val"]
    if has_init:
        # The file of the initial weights has no name here; run.yaml has the digests of its parts.
        command += ["--init", "WEIGHTS"]
    if plan.scores is not None:
        command += plan.scores.options()
    return [*command, "--out", f"{plan.out}-again"]


def stage_settings(plan: RunPlan, name: str, part: str, weights: Weights) -> dict[str, Any]:
    """Return what the weights of a stage depend on.

    The data may move to another folder meanwhile.

    Args:
        name: of the stage.
        part: of the weights, which the stage trains.
        weights: what the stage begins with.
    """
    recipe = to_dict(plan.recipe)
    train = plan.scans.train
    val = plan.scans.val
    settings: dict[str, Any] = {
        "model": {key: recipe["model"][key] for key in SIZES[part]},
        "training": {
            key: recipe["training"][key] for key in (name, "augment", "seed", "precision")
        },
        "scans": {"train": _digest_of_scans(train), "val": _digest_of_scans(val)},
    }
    if plan.scores is not None:
        settings["scores"] = plan.scores.digests([*train, *val])
    elif name == "head":
        settings["networks"] = {
            network: weights.digest(network) for network in ("range_net", "polar_net")
        }
    return settings


def check_begun(folder: Path, settings: dict[str, Any], resume: bool) -> None:
    """Check that a stage can begin, or resume, in a folder.

    Raises:
        InputError: if the folder holds a stage that is not to be resumed, or of another run.
    """
    if not (folder / LAST).is_file():
        return
    if not resume:
        raise InputError(
            f"{folder}: expected no earlier run, found one; add --resume or give another"
        )

    path = folder / SETTINGS
    begun = yaml.safe_load(path.read_text()) if path.is_file() else {}
    if begun != settings:
        changed = [key for key in settings if begun.get(key) != settings[key]]
        raise InputError(
            f"{folder}: expected what it was begun with ({SETTINGS}), "
            f"found another {', '.join(changed)}; resume it with that, or give another folder"
        )


def sequence_names(records: Sequence[ScanRecord]) -> list[str]:
    """Return the sequences of some scans, sorted."""
    return sorted({record.sequence for record in records})


def _digest_of_scans(records: Sequence[ScanRecord]) -> str:
    """Return a digest of the names and sizes of some scans."""
    sizes = []
    for record in records:
        path = record.points_path
        sizes.append((record.name, path.stat().st_size if path.is_file() else None))
    return hashlib.sha256(repr(sizes).encode()).hexdigest()[:16]
