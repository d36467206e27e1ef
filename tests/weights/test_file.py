"""A weights file explains itself, is loaded as it was saved, and is never executed."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor

import amvnet
import amvnet.weights
from amvnet.config.nested import to_dict
from amvnet.config.schema import PARTS
from amvnet.data.taxonomy import SEMANTICKITTI
from amvnet.weights.file import Weights, built_in, load, save

from fixtures.commands import fails
from fixtures.tiny import fresh_weights, street, with_model

POINTS = street(9)[0]


@pytest.fixture(scope="module")
def weights() -> Weights:
    return fresh_weights()


@pytest.fixture(scope="module")
def path(weights: Weights, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return save(weights, tmp_path_factory.mktemp("weights") / "w.safetensors")


def ensemble_scores(weights: Weights) -> np.ndarray:
    return amvnet.load(weights, method="ensemble")(POINTS).scores


def assert_same_tensors(first: Mapping[str, Tensor], second: Mapping[str, Tensor]) -> None:
    assert set(first) == set(second)
    for name, tensor in first.items():
        assert torch.equal(tensor, second[name])


# --- load and save ---


def test_an_error_of_the_disk_needs_no_message(
    weights: Weights, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*args: Any, **kwargs: Any) -> None:
        raise SafetensorError

    monkeypatch.setattr("amvnet.weights.file.save_file", fail)
    with pytest.raises(OSError, match="SafetensorError"):
        save(weights, tmp_path / "w.safetensors")
    assert not list(tmp_path.iterdir())


def test_saved_weights_are_loaded_unchanged(weights: Weights, path: Path) -> None:
    loaded = load(path)
    assert_same_tensors(loaded.tensors, weights.tensors)
    assert replace(loaded, tensors={}) == replace(weights, tensors={})


def test_the_folder_of_a_run_stands_for_its_weights(weights: Weights, tmp_path: Path) -> None:
    save(weights, tmp_path / "weights.safetensors")
    assert load(tmp_path).parts == PARTS


def test_the_description_can_be_read_without_this_package(weights: Weights, path: Path) -> None:
    with safe_open(path, "np") as file:
        description = json.loads(file.metadata()["amvnet"])
        names = set(file.keys())

    assert names == set(weights.tensors)
    assert description["model"] == to_dict(weights.model)
    assert description["taxonomy"]["classes"] == list(SEMANTICKITTI.classes)
    assert (description["sensor"], description["training"]) == (weights.sensor, weights.training)
    assert description["metrics"] == weights.metrics


def test_float16_parameters_hardly_change_the_scores(weights: Weights, tmp_path: Path) -> None:
    tensors = {}
    for name, tensor in weights.tensors.items():
        tensors[name] = tensor.half() if tensor.ndim > 1 else tensor
    half = save(replace(weights, tensors=tensors), tmp_path / "half.safetensors")
    assert np.abs(ensemble_scores(load(half)) - ensemble_scores(weights)).max() < 0.02


def test_parameters_that_do_not_fit_their_sizes_are_refused(weights: Weights) -> None:
    fails(lambda: with_model(weights, "range_net", stem=32).build(), "range_net")


# --- files that are not weights ---


def save_described(path: Path, description: Any) -> None:
    save_file({"range_net.a": torch.zeros(2)}, path, metadata={"amvnet": json.dumps(description)})


# How to write a broken file, given its path and the content of a good one.
BROKEN = {
    "no file": lambda path, content: None,
    "empty": lambda path, content: path.write_bytes(b""),
    "text": lambda path, content: path.write_text("weights"),
    "truncated": lambda path, content: path.write_bytes(content[: len(content) // 2]),
    "truncated header": lambda path, content: path.write_bytes(content[:100]),
    "pickle": lambda path, content: torch.save({"range_net.a": torch.zeros(2)}, path),
    "without description": lambda path, content: save_file({"range_net.a": torch.zeros(2)}, path),
    "description of another kind": lambda path, content: save_described(path, ["format"]),
    "only the format": lambda path, content: save_described(path, {"format": 1}),
}


@pytest.mark.parametrize("kind", BROKEN)
def test_a_file_that_is_no_weights_is_one_line(kind: str, path: Path, tmp_path: Path) -> None:
    broken = tmp_path / "broken.safetensors"
    BROKEN[kind](broken, path.read_bytes())
    fails(lambda: load(broken))


@pytest.mark.parametrize(
    ("miou", "uncertain", "words"),
    [
        (0.14, 0.94, ["mIoU of only 14.0%", "94.0% uncertain"]),
        (0.14, 0.2, ["14.0%"]),
        (0.6, 0.94, ["94.0%"]),
        (0.6, 0.2, []),
        (None, None, []),
    ],
)
def test_weights_say_if_their_own_validation_was_poor(
    weights: Weights, miou: float | None, uncertain: float | None, words: list[str]
) -> None:
    known = {"val/miou_present": miou, "val/uncertain": uncertain}
    weakness = replace(weights, metrics={"point_head": known}).weakness
    assert bool(weakness) == bool(words)
    assert all(word in weakness for word in words)


def test_the_built_in_weights_have_no_weakness() -> None:
    assert not any(load(name).weakness for name in built_in())
