"""Tiny worlds for tests: made-up scans that a network can learn, recipes of a few thousand parameters, weights."""

from __future__ import annotations

import contextlib
import io
import re
import shlex
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import yaml

from amvnet.cli.main import main
from amvnet.config.nested import from_dict, merge_trees
from amvnet.config.schema import ModelConfig
from amvnet.data.taxonomy import NUSCENES, SEMANTICKITTI, Taxonomy
from amvnet.errors import InputError
from amvnet.models.amvnet import build_amvnet
from amvnet.weights.file import Weights, part_state

GOLDEN = Path(__file__).parent / "golden"
CAR, ROAD, SIDEWALK, BUILDING, UNLABELLED = 10, 40, 48, 50, 0  # raw ids of SemanticKITTI
THRESHOLD = 0.95  # of the assertion: tiny networks are unsure, and so agree more than real ones

MODEL: dict[str, Any] = {
    "range_view": {"height": 16, "width": 64},
    "polar_view": {"radial": 12, "angular": 16, "vertical": 4, "radius_min": 0.0},
    "range_net": {"stem": 16, "widths": [16] * 7, "blocks": [1] * 7, "decoder": 16, "head": 16},
    "polar_net": {"point_widths": [8, 8], "pillar": 8, "widths": [16, 16], "dropblock": 0.2},
    "assertion": {"threshold": THRESHOLD},
    "point_head": {"neighbours": 4, "hidden": [8, 8], "fc": 8},
}
TRAINING: dict[str, Any] = {
    "rv": {"epochs": 3, "batch": 2, "lr": 0.02},
    "bev": {"epochs": 3, "batch": 2, "lr": 0.02},
    "head": {"epochs": 2, "batch": 64, "lr": 0.05, "points": 800},
    "precision": "32-true",
    "accelerator": "cpu",
}
NUSCENES_MODEL: dict[str, Any] = {
    "range_view": {"height": 32, "width": 64},
    "range_net": {
        **MODEL["range_net"],
        "widths": [16] * 6,
        "blocks": [1] * 6,
        "height_strides": [1, 1, 1, 2, 2, 2],
    },
}


def street(seed: int, count: int = 500) -> tuple[np.ndarray, np.ndarray]:
    """(N, 4) float32 points of a flat street between walls with a car in it, and their (N,) raw labels."""
    rng = np.random.default_rng(seed)
    azimuth, elevation = rng.uniform(-np.pi, np.pi, count), np.radians(rng.uniform(-25, 3, count))
    ground = elevation < np.radians(-6)
    car = np.abs(azimuth - rng.uniform(-2, 2)) < 0.3
    distance = np.where(
        car, 6.0, np.where(ground, 1.7 / np.sin(np.where(ground, -elevation, 1)), 20.0)
    )
    flat = distance * np.cos(elevation)
    points = np.stack(
        [flat * np.cos(azimuth), flat * np.sin(azimuth), distance * np.sin(elevation)], axis=1
    )
    raw = np.where(ground, np.where(np.abs(points[:, 1]) < 4, ROAD, SIDEWALK), BUILDING)
    raw = np.where(car, CAR, raw)
    raw[rng.random(count) < 0.02] = UNLABELLED
    intensity = (raw % 7) / 7 + rng.uniform(0, 0.1, count)
    return np.column_stack([points + rng.normal(0, 0.02, points.shape), intensity]).astype(
        np.float32
    ), raw


def write_scan(
    root: Path, sequence: str, name: str, points: np.ndarray, raw: np.ndarray | None
) -> Path:
    """One scan in SemanticKITTI's layout; returns the file of its points."""
    path = root / "sequences" / sequence / "velodyne" / f"{name}.bin"
    path.parent.mkdir(parents=True, exist_ok=True)
    points.astype(np.float32).tofile(path)
    if raw is not None:
        labels = root / "sequences" / sequence / "labels" / f"{name}.label"
        labels.parent.mkdir(exist_ok=True)
        raw.astype(np.uint32).tofile(labels)
    return path


def make_streets(
    root: Path, sequences: tuple[str, ...] = ("00", "01", "08"), scans: int = 2
) -> Path:
    """A data set in SemanticKITTI's layout; every sequence has other streets."""
    for place, sequence in enumerate(sequences):
        for scan in range(scans):
            write_scan(root, sequence, f"{scan:06d}", *street(100 * place + scan))
    return root


def write_recipe(path: Path, base: str = "semantickitti-compact", **over: Any) -> Path:
    """A user's recipe that makes a built-in one tiny."""
    model = merge_trees(MODEL, NUSCENES_MODEL) if base.startswith("nuscenes") else MODEL
    tree = merge_trees({"base": base, "model": model, "training": TRAINING}, over)
    path.write_text(yaml.safe_dump(tree))
    return path


def fresh_weights(taxonomy: Taxonomy = SEMANTICKITTI, seed: int = 0) -> Weights:
    """All three parts untrained, but sure of themselves: their last layers are scaled up."""
    torch.manual_seed(seed)
    config = from_dict(
        ModelConfig, merge_trees(MODEL, NUSCENES_MODEL) if taxonomy is NUSCENES else MODEL
    )
    if taxonomy is NUSCENES:
        config = replace(config, range_view=replace(config.range_view, rows="ring"))
    model = build_amvnet(config, taxonomy.size)
    assert model.point_head is not None
    with torch.no_grad():
        for last in (model.range_net.scores, model.polar_net.scores, model.point_head.fc[-1]):
            last.weight.mul_(10)
    parts = {
        "range_net": model.range_net,
        "polar_net": model.polar_net,
        "point_head": model.point_head,
    }
    tensors = {
        key: value for name, part in parts.items() for key, value in part_state(name, part).items()
    }
    said = {name: {"seed": seed} for name in parts}
    return Weights(
        config, taxonomy, "tiny", tensors, training=said, metrics={"range_net": {"val/miou": 0.5}}
    )


def without(weights: Weights, *parts: str) -> Weights:
    """The weights less some parts."""
    return replace(
        weights, tensors={k: v for k, v in weights.tensors.items() if k.split(".")[0] not in parts}
    )


def amvnet(*arguments: object) -> tuple[int, str]:
    """Run the command line in this process: the exit code, and what it wrote to stderr."""
    stderr = io.StringIO()
    with contextlib.redirect_stderr(stderr):
        code = main([str(a) for a in arguments])
    return code, stderr.getvalue()


def commands_of(page: str) -> list[list[str]]:
    """The words of every command in the bash blocks of a page of the documentation, named from the project's root."""
    text = (Path(__file__).parents[1] / page).read_text()
    blocks = re.findall(r"```bash\n(.*?)```", text, re.S)
    lines = [line for block in blocks for line in block.replace("\\\n", " ").splitlines()]
    return [words for words in (shlex.split(line, comments=True) for line in lines) if words]


def files(folder: Path) -> set[str]:
    """Every file below a folder, relative to it."""
    return {str(path.relative_to(folder)) for path in folder.rglob("*") if path.is_file()}


def fails(call: Callable[[], object], *words: object) -> None:
    """The call raises InputError in one line that has all the words."""
    with pytest.raises(InputError) as caught:
        call()
    message = str(caught.value)
    assert "\n" not in message
    for word in words:
        assert str(word) in message


def label_map() -> dict[str, Any]:
    """SEMANTICKITTI in the format of the benchmark's own YAML file (colours are BGR there)."""
    raws, forward = SEMANTICKITTI.train_to_raw, SEMANTICKITTI.raw_to_train
    names = ("unlabeled", *SEMANTICKITTI.classes)
    train = {
        ours: [int(s) for s in SEMANTICKITTI.splits[ours]] for ours in ("train", "val", "test")
    }
    return {
        "labels": {raw: names[t] for raw, t in forward.items()},
        "color_map": {raw: list(SEMANTICKITTI.colors[t])[::-1] for raw, t in forward.items()},
        "learning_map": dict(forward),
        "learning_map_inv": dict(enumerate(raws)),
        "learning_ignore": {t: t == 0 for t in range(20)},
        "split": {"train": train["train"], "valid": train["val"], "test": train["test"]},
    }
