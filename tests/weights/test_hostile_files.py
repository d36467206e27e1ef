"""Weights and YAML from strangers: refused before they can do harm.

Each weights file is a good one with one change. Each file is refused in one line, and takes less
than one gigabyte of memory.
"""

from __future__ import annotations

import copy
import json
import math
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import pytest
import torch
from safetensors.torch import save_file

from amvnet.config.nested import to_dict
from amvnet.config.schema import ModelConfig
from amvnet.config.yaml_files import read_yaml
from amvnet.weights.card import model_card
from amvnet.weights.file import FORMAT, Weights, load

from fixtures.commands import fails, new_file, run_cli, succeed
from fixtures.memory import memory_below
from fixtures.tiny import fresh_weights

MEMORY = 1024**3  # bytes
HUGE = 10**12


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


def places(tree: Any, kind: type, path: str = "") -> Iterator[str]:
    """Yield the keys, with spaces between, of values of a type, but of 0, which is allowed."""
    if isinstance(tree, dict):
        for key, value in tree.items():
            yield from places(value, kind, f"{path} {key}".strip())
    elif isinstance(tree, list | tuple):
        for first in tree[:1]:
            yield from places(first, kind, f"{path} 0")
    elif type(tree) is kind and (tree or kind is float):
        yield path


# Changes of the model: a place in it, and a value that no file of this package has there.
SIZES = tuple(places(to_dict(ModelConfig()), int))
NUMBERS = tuple(places(to_dict(ModelConfig()), float))
MODEL: dict[str, tuple[str, Any]] = {
    **{f"{path} = 10**12": (path, HUGE) for path in SIZES},
    **{f"{path} = 0": (path, 0) for path in SIZES},
    **{f"{path} = 2.5": (path, 2.5) for path in SIZES},
    **{f"{path} = NaN": (path, math.nan) for path in NUMBERS},
    **{f"{path} = infinity": (path, math.inf) for path in NUMBERS},
    **{f"{path} = 10**400": (path, 10**400) for path in NUMBERS},
    "gru_padding = 10**12": ("range_net gru_padding", 1e12),
    "decoder = 10**12": ("polar_net decoder", [HUGE] * 3),
    "many widths": ("range_net widths", [4] * 100_000),
    "widths in widths": ("range_net widths", [[4], [4]]),
    "large image": ("range_view", {"height": 16384, "width": 16384}),
    "large grid": ("polar_view", {"radial": 16384, "angular": 16384}),
    "many large layers": ("point_head", {"hidden": [8192] * 12}),
    "removed pooling": ("point_head pooling", "mean"),
    "long text as a size": ("range_net stem", "9" * 1_000_000),
    "long key": ("range_net", {"k" * 1_000_000: 1}),
}

# The same for the other fields of the description.
DESCRIPTION: dict[str, tuple[str, Any]] = {
    "model as a number": ("model", 5),
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


# Changes of a parameter.
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
        "expects": weights.expects.to_dict(),
        "training": weights.training,
        "metrics": weights.metrics,
    }
    return json.loads(json.dumps(fields))  # lists instead of tuples, as in a file


def write_weights(path: Path, tensors: Mapping[str, torch.Tensor], text: str) -> Path:
    """Write tensors with a text in the place of the description in JSON."""
    save_file(dict(tensors), path, metadata={"amvnet": text})
    return path


@pytest.fixture(scope="module")
def good(weights: Weights, description: Any, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a file without a change, which is not refused: the changes alone are at fault."""
    path = tmp_path_factory.mktemp("good") / "good.safetensors"
    write_weights(path, weights.tensors, json.dumps(description))
    succeed("info", path)
    return path


@dataclass(frozen=True)
class Content:
    tensors: Mapping[str, torch.Tensor]
    text: str


def hostile_weights(weights: Weights, description: dict[str, Any]) -> dict[str, Content]:
    """Return the content of a file for each change, by the name of the change."""
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
    contents = {name: Content(weights.tensors, text) for name, text in texts.items()}

    changes: dict[str, dict[str, torch.Tensor]] = {}
    for name, convert in TENSORS.items():
        changes[f"{name} tensor"] = {WEIGHT: convert(weights.tensors[WEIGHT])}
    variance = next(name for name in weights.tensors if name.endswith("running_var"))
    changes["negative variance"] = {variance: -torch.ones_like(weights.tensors[variance])}
    changes["another tensor"] = {"range_net.more": torch.zeros(2)}
    changes["another part"] = {"other.more": torch.zeros(2)}
    good_text = json.dumps(description)
    for name, changed in changes.items():
        contents[name] = Content({**weights.tensors, **changed}, good_text)
    fewer = {name: value for name, value in weights.tensors.items() if name != WEIGHT}
    contents["fewer tensors"] = Content(fewer, good_text)

    # A network of which the file has no tensor, which a reader could build with random values.
    large = change(description, "model polar_net widths", [8192] * 8)
    present = {name: value for name, value in weights.tensors.items() if "range_net" in name}
    contents["absent"] = Content(present, json.dumps(large))
    return contents


# One change of each kind, for the tests of each change to this package.
QUICK = (
    "range_net stem = 10**12",
    "polar_view radial = 0",
    "point_head hidden 0 = 2.5",
    "assertion threshold = NaN",
    "range_view fov_up = 10**400",
    "large image",
    "many large layers",
    "raw ids beyond 16 bits",
    "class names of several lines",
    "nested",
    "infinite tensor",
    "larger tensor",
    "fewer tensors",
    "absent",
)


YAML_TEXTS = {
    "nested": nested(20_000),
    "nested in blocks": "- " * 20_000,
    "laughs": "a0: &a0 [x, x]\n"
    + "".join(f"a{i}: &a{i} [{', '.join([f'*a{i - 1}'] * 9)}]\n" for i in range(1, 30))
    + "model: *a29\n",
    "long": "a: " + "x" * 10_000_000,
    "python": "model: !!python/object/apply:os.system ['true']\n",
    "no date": "model: !!timestamp 2001-99-99\n",
    "digits": f"model: {'9' * 10_000}\n",
}


def check_refused(paths: Iterable[Path]) -> None:
    """Check that `info` refuses each file in one line, and all in little memory."""
    with memory_below(MEMORY):
        for path in paths:
            code, error = run_cli("info", path)
            assert code == 2, (path, code, error[-500:])
            assert error.count("\n") == 1, (path, error[-500:])
            assert len(error) < 2000, path
            assert error[:-1].isprintable(), path


@pytest.mark.usefixtures("good")
@pytest.mark.parametrize(
    "names", [QUICK, pytest.param(None, marks=pytest.mark.full)], ids=["of each kind", "all"]
)
def test_hostile_weights_are_refused(
    names: tuple[str, ...] | None, weights: Weights, description: dict[str, Any], tmp_path: Path
) -> None:
    contents = hostile_weights(weights, description)
    paths = []
    for index, name in enumerate(names or contents):
        path = tmp_path / f"{index}.safetensors"
        paths.append(write_weights(path, contents[name].tensors, contents[name].text))
    check_refused(paths)


@pytest.mark.parametrize("text", YAML_TEXTS.values(), ids=YAML_TEXTS)
def test_hostile_yaml_is_refused(text: str, tmp_path: Path) -> None:
    path = new_file(tmp_path / "mine.yaml", text)
    with memory_below(MEMORY):
        fails(lambda: read_yaml(path, "a recipe"), "mine.yaml")


# ---- files that are unlucky, not hostile


@pytest.mark.parametrize("share", [0.01, 0.5, 0.999])
def test_truncated_weights_are_called_truncated(share: float, good: Path, tmp_path: Path) -> None:
    content = good.read_bytes()
    path = new_file(tmp_path / "w.safetensors", content[: int(share * len(content))])
    fails(lambda: load(path), path, "truncated", "copy it again")


def test_a_card_abridges_what_is_long_or_deep() -> None:
    deep: object = "deep"
    for level in range(400):
        deep = {"a": deep} if level % 2 else [deep]
    record = {"deep": deep, "many": list(range(10**5)), "ends": ["x" * 10**6] * 20}
    text = model_card(replace(fresh_weights(), training={"range_net": record}), "w")
    assert "[0, 1, 2, " in text
    assert "..." in text
    assert len(text) < 10_000
