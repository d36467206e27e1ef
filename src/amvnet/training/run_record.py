"""What the folder of a run says of it: its recipe, what each call made of what, and how to make it again."""

from __future__ import annotations

import hashlib
import platform
import shlex
from collections.abc import Sequence
from importlib import metadata
from pathlib import Path
from typing import Any

import yaml

from amvnet.config.nested import to_dict
from amvnet.config.schema import Recipe
from amvnet.data.datasets.base import Dataset, ScanRecord
from amvnet.errors import InputError
from amvnet.files import atomic_write
from amvnet.inference.score_files import ScorePair
from amvnet.training.fit import LAST
from amvnet.weights.file import SIZES, Weights

SETTINGS = "stage.yaml"  # in a stage's folder: what it was begun with


def write_record(
    out: Path,
    recipe: Recipe,
    dataset: Dataset,
    train: Sequence[ScanRecord],
    val: Sequence[ScanRecord],
    stage: str,
    init: Weights | None,
    scores: ScorePair | None = None,
) -> None:
    """Write the recipe, and in run.yaml with what a stage (or all) is made, on what, and how to make it again."""
    # Another call of this folder may have trained another stage on other scans: its entry stays, before this one.
    earlier = {key: value for key, value in _calls(out / "run.yaml").items() if key != stage}
    said = {
        "repeat": shlex.join(map(str, _repeat(out, dataset, train, val, stage, init, scores))),
        "versions": {
            name: metadata.version(name) for name in ("amvnet", "torch", "lightning", "numpy")
        },
        "python": platform.python_version(),
        "data": str(dataset.root),
        "classes": dataset.taxonomy.name,
        "train": sequence_names(train),
        "val": sequence_names(val),
        "init": None if init is None else {part: init.digest(part) for part in init.parts},
        **({} if scores is None else {"scores": scores.said()}),
    }
    for name, tree in {
        "recipe.yaml": to_dict(recipe),
        "run.yaml": {**earlier, stage: said},
    }.items():
        with atomic_write(out / name) as part:
            part.write_text(yaml.safe_dump(tree, sort_keys=False, width=1000))


def _calls(path: Path) -> dict[str, Any]:
    """What run.yaml holds so far, by stage; nothing where it cannot be read."""
    try:
        found = yaml.safe_load(path.read_text())
    except (OSError, ValueError, yaml.YAMLError):
        return {}
    return found if isinstance(found, dict) else {}


def _repeat(
    out: Path,
    dataset: Dataset,
    train: Sequence[ScanRecord],
    val: Sequence[ScanRecord],
    stage: str,
    init: Weights | None,
    scores: ScorePair | None,
) -> list[Any]:
    """The command that makes a run again."""
    validated = ["--val-sequences", ",".join(sequence_names(val))] if val else ["--with-val"]
    return [
        *("amvnet", "train", out / "recipe.yaml", "--data", dataset.root, "--stage", stage),
        *("--train-sequences", ",".join(sequence_names(train)), *validated),
        # Weights that were given have no name here; their digests tell whether it is they.
        *([] if init is None else ["--init", "WEIGHTS"]),
        *([] if scores is None else scores.options()),
        *("--out", f"{out}-again"),
    ]


def stage_settings(
    recipe: Recipe,
    name: str,
    part: str,
    train: Sequence[ScanRecord],
    val: Sequence[ScanRecord],
    current: Weights,
    scores: ScorePair | None = None,
) -> dict[str, Any]:
    """What the weights of a stage depend on; the data may move to another folder meanwhile."""
    tree = to_dict(recipe)
    training = {key: tree["training"][key] for key in (name, "augment", "seed", "precision")}
    found = {"model": {key: tree["model"][key] for key in SIZES[part]}, "training": training}
    found["scans"] = {"train": _digest_of_scans(train), "val": _digest_of_scans(val)}
    if scores is not None:
        found["scores"] = scores.digests([*train, *val])
    elif name == "head":
        found["networks"] = {
            network: current.digest(network) for network in ("range_net", "polar_net")
        }
    return found


def check_begun(folder: Path, now: dict[str, Any], resume: bool) -> None:
    """Raises InputError where a folder holds a stage of a run that is not to be resumed, or of another run."""
    if not (folder / LAST).is_file():
        return
    if not resume:
        raise InputError(
            f"{folder}: expected no earlier run, found one; add --resume or give another"
        )
    begun = yaml.safe_load((folder / SETTINGS).read_text()) if (folder / SETTINGS).is_file() else {}
    if begun != now:
        other = ", ".join(key for key in now if begun.get(key) != now[key])
        raise InputError(f"{folder}: expected what it was begun with ({SETTINGS}), found another {other}; "
                         "resume it with that, or give another folder")  # fmt: skip


def sequence_names(records: Sequence[ScanRecord]) -> list[str]:
    """The sequences of some scans."""
    return sorted({record.sequence for record in records})


def _digest_of_scans(records: Sequence[ScanRecord]) -> str:
    """Tells scans from other ones by their names and sizes."""
    paths = [(record.name, record.points_path) for record in records]
    known = [(name, path.stat().st_size if path.is_file() else None) for name, path in paths]
    return hashlib.sha256(repr(known).encode()).hexdigest()[:16]
