"""Weights, recipes and exported descriptions from strangers: refused before they can do harm.

Each file is a good one with one change. All are refused with exit code 2 and one line, within two
seconds each and one gigabyte together.
"""

from __future__ import annotations

import copy
import json
import math
import subprocess
import sys
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
import yaml
from safetensors.torch import save_file

from amvnet.config.nested import to_dict
from amvnet.config.schema import Recipe
from amvnet.sensors.lidars import make_sensor
from amvnet.weights.card import model_card
from amvnet.weights.file import FORMAT, Weights, load

from fixtures.commands import fails
from fixtures.tiny import fresh_weights

SECONDS = 2.0
MEMORY = 1024**3  # bytes
HUGE = 10**12

# Runs a command for each file, after the command of its arguments, which imports what the others
# need. Prints the exit code, the lines on stderr and the seconds of each, and the largest memory of
# the process in bytes.
RUNNER = """
import contextlib, io, json, sys, time
from amvnet.cli.main import main

# What is imported does not count.
with contextlib.redirect_stderr(io.StringIO()), contextlib.redirect_stdout(io.StringIO()):
    main(sys.argv[1:])

results = {}
for line in sys.stdin:
    name, command = json.loads(line)
    errors = io.StringIO()
    start = time.process_time()
    with contextlib.redirect_stderr(errors), contextlib.redirect_stdout(io.StringIO()):
        code = main(command)
    results[name] = code, errors.getvalue(), time.process_time() - start
# Not ru_maxrss: it counts the memory of the parent before the exec, too.
with open("/proc/self/status") as file:
    status = dict(line.split(":", 1) for line in file)
memory = 1024 * int(status["VmHWM"].split()[0])
sys.stdout.write("\\n" + json.dumps([results, memory]))
"""


def nested(depth: int = 100_000) -> str:
    """Return JSON that is nested deeply."""
    return "[" * depth + "]" * depth


def change(tree: Any, path: str, value: Any) -> Any:
    """Return a copy of nested dictionaries and lists with one value changed."""
    changed = copy.deepcopy(tree)
    *parents, last = path.split()
    node = changed
    for key in parents:
        node = node[int(key)] if isinstance(node, list) else node[key]
    if isinstance(node, list):
        node[int(last)] = value
    else:
        node[last] = value
    return changed


# Values of the model that no file of this package has, by their places.
SIZES = (
    "range_view height",
    "range_view width",
    "polar_view radial",
    "polar_view angular",
    "polar_view vertical",
    "range_net stem",
    "range_net widths 0",
    "range_net blocks 1",
    "range_net height_strides 0",
    "range_net decoder",
    "range_net head",
    "polar_net point_widths 0",
    "polar_net pillar",
    "polar_net widths 1",
    "polar_net dropblock_size",
    "point_head neighbours",
    "point_head hidden 0",
    "point_head fc",
)
NUMBERS = (
    "range_view fov_up",
    "range_view fov_down",
    "polar_view radius_min",
    "polar_view radius_max",
    "polar_view z_min",
    "polar_view z_max",
    "range_net dropout",
    "range_net gru_padding",
    "polar_net dropblock",
    "assertion threshold",
    "point_head position_scale",
)
MODEL: dict[str, tuple[str, Any]] = {
    **{f"{path} = 10**12": (path, HUGE) for path in SIZES},
    **{f"{path} = 0": (path, 0) for path in SIZES},
    **{f"{path} = 2.5": (path, 2.5) for path in SIZES},
    **{f"{path} = NaN": (path, math.nan) for path in NUMBERS},
    **{f"{path} = infinity": (path, math.inf) for path in NUMBERS},
    **{f"{path} = 10**400": (path, 10**400) for path in NUMBERS},
    "gru_padding = 10**12": ("range_net gru_padding", 1e12),
    "many widths": ("range_net widths", [4] * 100_000),
    "widths in widths": ("range_net widths", [[4], [4]]),
    "large image": ("range_view", {"height": 16384, "width": 16384}),
    "large grid": ("polar_view", {"radial": 16384, "angular": 16384}),
    "many large layers": ("point_head", {"hidden": [8192] * 12}),
    "removed pooling": ("point_head pooling", "mean"),
    "long text as a size": ("range_net stem", "9" * 1_000_000),
    "long key": ("range_net", {"k" * 1_000_000: 1}),
}

# Other values of the description.
DESCRIPTION: dict[str, tuple[str, Any]] = {
    "no taxonomy": ("taxonomy", {}),
    "raw ids as text": ("taxonomy train_to_raw 3", "ten"),
    "raw ids as fractions": ("taxonomy train_to_raw 3", 1.5),
    "raw ids beyond 16 bits": ("taxonomy train_to_raw 3", HUGE),
    "train ids as lists": ("taxonomy raw_to_train 2", [5, [1]]),
    "raw ids as null": ("taxonomy raw_to_train 2", [None, 1]),
    "raw ids that are NaN": ("taxonomy train_to_raw 3", math.nan),
    "infinite train ids": ("taxonomy raw_to_train 2", [5, math.inf]),
    "no pairs": ("taxonomy raw_to_train", 5),
    "colours as text": ("taxonomy colors 1", "red"),
    "colours beyond 255": ("taxonomy colors 1", [0, 0, 999]),
    "two classes of one name": ("taxonomy classes 0", "bicycle"),
    "raw ids that are all the same": ("taxonomy train_to_raw", [10] * 20),
    "no classes": ("taxonomy classes", []),
    "class names as numbers": ("taxonomy classes 0", 5),
    "class names of several lines": ("taxonomy classes 0", "car\n\x1b[2J"),
    "long class names": ("taxonomy classes 0", "c" * 1_000_000),
    "many classes": ("taxonomy classes", [f"c{index}" for index in range(100_000)]),
    "splits as a list": ("taxonomy splits", []),
    "sensor of several lines": ("sensor", "hdl64e\namvnet: all is well"),
    "sensor as a number": ("sensor", 64),
    "training as a list": ("training", []),
    "a record as text": ("training", {"range_net": "long"}),
    "metrics of another part": ("metrics", {"__class__": {}}),
    "metrics as a number": ("metrics", {"range_net": 5}),
    "another format": ("format", HUGE),
}


def to_infinity(tensor: torch.Tensor) -> torch.Tensor:
    return torch.full_like(tensor, torch.inf)


def to_nan(tensor: torch.Tensor) -> torch.Tensor:
    changed = tensor.clone()
    changed.flatten()[-1] = torch.nan
    return changed


# Changes of the parameter `WEIGHT`.
WEIGHT = "range_net.scores.weight"
TENSORS: dict[str, Callable[[torch.Tensor], torch.Tensor]] = {
    "NaN": to_nan,
    "infinite": to_infinity,
    "complex": lambda tensor: tensor.to(torch.complex64),
    "boolean": lambda tensor: tensor > 0,
    "bytes": lambda tensor: tensor.to(torch.uint8),
    "integers": lambda tensor: tensor.to(torch.int64),
    "8-bit floats": lambda tensor: tensor.to(torch.float8_e4m3fn),
    "fewer channels": lambda tensor: tensor[:-1].contiguous(),
    "flat": lambda tensor: tensor.flatten(),
    "empty": lambda tensor: tensor[:0].contiguous(),
    "larger": lambda tensor: torch.zeros(1000, *tensor.shape[1:]),
}


@pytest.fixture(scope="module")
def weights() -> Weights:
    return fresh_weights()


@pytest.fixture(scope="module")
def description(weights: Weights) -> dict[str, Any]:
    fields = {
        "format": FORMAT,
        "model": to_dict(weights.model),
        "taxonomy": weights.taxonomy.to_dict(),
        "sensor": weights.sensor,
        "training": weights.training,
        "metrics": weights.metrics,
    }
    return json.loads(json.dumps(fields))  # lists instead of tuples, as in a file


def write_weights(path: Path, tensors: Mapping[str, torch.Tensor], text: str) -> Path:
    """Write a weights file with any description."""
    save_file(dict(tensors), path, metadata={"amvnet": text})
    return path


@pytest.fixture(scope="module")
def good(weights: Weights, description: Any, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("good") / "good.safetensors"
    return write_weights(path, weights.tensors, json.dumps(description))


def hostile_weights(folder: Path, weights: Weights, description: dict[str, Any]) -> list[Path]:
    """Write a file for each change."""
    texts = {}
    for name, (place, value) in MODEL.items():
        texts[name] = json.dumps(change(description, f"model {place}", value))
    for name, (place, value) in DESCRIPTION.items():
        texts[name] = json.dumps(change(description, place, value))
    texts["nested"] = nested()
    texts["nested in the training"] = json.dumps(description).replace(
        '"training": {', f'"training": {{"range_net": {nested()}, '
    )
    texts["long"] = json.dumps({**description, "more": "x" * 20_000_000})
    texts["digits"] = "9" * 1_000_000

    paths = []
    for index, text in enumerate(texts.values()):
        paths.append(write_weights(folder / f"d{index}.safetensors", weights.tensors, text))

    good_text = json.dumps(description)
    changes: list[dict[str, torch.Tensor]] = []
    for convert in TENSORS.values():
        changes.append({**weights.tensors, WEIGHT: convert(weights.tensors[WEIGHT])})
    variance = next(name for name in weights.tensors if name.endswith("running_var"))
    changes.append({**weights.tensors, variance: -torch.ones_like(weights.tensors[variance])})
    changes.append({**weights.tensors, "range_net.more": torch.zeros(2)})
    changes.append({**weights.tensors, "other.more": torch.zeros(2)})
    changes.append({name: value for name, value in weights.tensors.items() if name != WEIGHT})
    for index, tensors in enumerate(changes):
        paths.append(write_weights(folder / f"t{index}.safetensors", tensors, good_text))

    # A network that the file lacks would be built all the same, with random values.
    large = change(description, "model polar_net widths", [8192] * 8)
    present = {name: value for name, value in weights.tensors.items() if "range_net" in name}
    paths.append(write_weights(folder / "absent.safetensors", present, json.dumps(large)))
    return paths


RECIPES = {
    **{path: (f"model {path}", HUGE) for path in SIZES},
    **{f"{path} is NaN": (f"model {path}", math.nan) for path in NUMBERS},
    "infinite rate": ("training rv lr", math.inf),
    "rate without limits": ("training rv lr", 10**400),
    "many stages": ("training stages", ["rv"] * 100_000),
}
YAML_TEXTS = {
    "nested": nested(20_000),
    "nested in blocks": "- " * 20_000,
    "laughs": "a0: &a0 [x, x]\n"
    + "".join(f"a{i}: &a{i} [{', '.join([f'*a{i - 1}'] * 9)}]\n" for i in range(1, 30))
    + "model: *a29\n",
    "laughs as a size": "base: nuscenes\nmodel: {range_net: {stem: &a [*a, *a]}}\n",
    "long": "a: " + "x" * 10_000_000,
    "digits": "model: {range_net: {stem: " + "9" * 50_000 + "}}",
    "python": "model: !!python/object/apply:os.system ['true']\n",
    "no date": "model: 2001-99-99\n",
}


def hostile_recipes(folder: Path) -> list[Path]:
    """Write a file for each change, and for each text."""
    texts = dict(YAML_TEXTS)
    for name, (place, value) in RECIPES.items():
        # Only the part that is changed, because YAML takes long to read.
        part, name_within = place.split()[:2]
        changed = change(to_dict(Recipe()), place, value)[part][name_within]
        texts[name] = yaml.safe_dump({"base": "nuscenes", part: {name_within: changed}})

    paths = []
    for index, text in enumerate(texts.values()):
        path = folder / f"r{index}.yaml"
        path.write_text(text)
        paths.append(path)
    return paths


def run(importing: list[str], commands: Mapping[str, list[str]]) -> None:
    """Run commands in a process of their own; check that each is refused, soon and in one line.

    Args:
        importing: a command that imports what the others need.
        commands: the commands by name.
    """
    lines = "\n".join(json.dumps(item) for item in commands.items())
    process = subprocess.run(
        [sys.executable, "-c", RUNNER, *importing], input=lines, capture_output=True, text=True
    )
    assert process.returncode == 0, process.stderr[-2000:]
    results, memory = json.loads(process.stdout.splitlines()[-1])

    assert set(results) == set(commands)
    for name, (code, error, seconds) in results.items():
        assert code == 2, (name, code, error[-500:])
        assert error.count("\n") == 1, (name, error[-500:])
        assert len(error) < 2000, name
        assert error[:-1].isprintable(), name
        assert seconds < SECONDS, (name, seconds)
    assert memory < MEMORY


def test_hostile_weights_are_refused(
    good: Path, weights: Weights, description: dict[str, Any], tmp_path: Path
) -> None:
    paths = hostile_weights(tmp_path, weights, description)
    run(["info", str(good)], {path.name: ["info", str(path)] for path in paths})


@pytest.mark.parametrize("text", YAML_TEXTS)
def test_hostile_sensors_are_refused(text: str, tmp_path: Path) -> None:
    path = tmp_path / "mine.yaml"
    path.write_text(YAML_TEXTS[text])
    fails(lambda: make_sensor(str(path)), "mine.yaml")


def test_hostile_recipes_are_refused(tmp_path: Path) -> None:
    options = ["--data", "semantickitti:none", "--out", str(tmp_path / "out")]
    paths = hostile_recipes(tmp_path)
    commands = {path.name: ["train", str(path), *options] for path in paths}
    run(["train", "nuscenes", *options], commands)


# ---- what is said of files that are not hostile but unlucky, and of records that are deep


@pytest.mark.parametrize("share", [0.01, 0.5, 0.999])
def test_truncated_weights_are_called_truncated(share: float, good: Path, tmp_path: Path) -> None:
    content = good.read_bytes()
    path = tmp_path / "w.safetensors"
    path.write_bytes(content[: int(share * len(content))])
    fails(lambda: load(path), path, "truncated", "copy it again")


def test_a_card_abridges_what_is_long_or_deep() -> None:
    deep: object = "deep"
    for level in range(400):
        deep = {"a": deep} if level % 2 else [deep]
    record = {"deep": deep, "many": list(range(10**5)), "ends": ["x" * 10**6] * 20}
    weights = replace(fresh_weights(), training={"range_net": record})
    text = model_card(weights, "w")
    assert "[0, 1, 2, " in text
    assert "..." in text
    assert len(text) < 10_000
