"""A weights file explains itself, is loaded as it was saved, and is never executed."""

from __future__ import annotations

import json
import subprocess
import sys
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
from amvnet.data.taxonomy import NUSCENES, SEMANTICKITTI
from amvnet.errors import InputError
from amvnet.inference.segmenter import Segmentation
from amvnet.weights.file import PARTS, Weights, load, save

from fixtures.tiny import fresh_weights, street, without

POINTS = street(9)[0]


@pytest.fixture(scope="module")
def weights() -> Weights:
    return fresh_weights()


@pytest.fixture(scope="module")
def path(weights: Weights, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return save(weights, tmp_path_factory.mktemp("weights") / "w.safetensors")


def segment(weights: Weights | str) -> Segmentation:
    return amvnet.load(weights)(POINTS)


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


def test_loaded_weights_segment_like_the_saved_ones(weights: Weights, path: Path) -> None:
    saved = segment(weights)
    loaded = segment(str(path))
    assert np.array_equal(loaded.scores, saved.scores)
    assert np.array_equal(loaded.labels, saved.labels)


def test_the_folder_of_a_run_stands_for_its_weights(weights: Weights, tmp_path: Path) -> None:
    save(weights, tmp_path / "weights.safetensors")
    assert load(tmp_path).parts == PARTS


def test_the_package_offers_load_and_weights() -> None:
    assert amvnet.weights.load is load
    assert amvnet.weights.Weights is Weights


def test_importing_the_package_does_not_import_torch() -> None:
    code = "import sys, amvnet.weights; sys.exit('torch' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code]).returncode == 0


def test_the_description_can_be_read_without_this_package(weights: Weights, path: Path) -> None:
    with safe_open(path, "np") as file:
        description = json.loads(file.metadata()["amvnet"])
        names = set(file.keys())

    assert names == set(weights.tensors)
    assert description["model"] == to_dict(weights.model)
    assert description["taxonomy"]["classes"] == list(SEMANTICKITTI.classes)
    assert description["sensor"] == weights.sensor
    assert description["training"] == weights.training
    assert description["metrics"] == weights.metrics


def test_parameters_of_half_precision_hardly_change_the_scores(
    weights: Weights, tmp_path: Path
) -> None:
    tensors = {}
    for name, tensor in weights.tensors.items():
        tensors[name] = tensor.half() if tensor.ndim > 1 else tensor
    half = save(replace(weights, tensors=tensors), tmp_path / "half.safetensors")
    assert np.abs(ensemble_scores(load(half)) - ensemble_scores(weights)).max() < 0.02


# --- parts ---


@pytest.mark.parametrize("part", PARTS)
def test_a_part_brings_its_metrics_and_the_record_of_its_training(
    weights: Weights, part: str
) -> None:
    mine = {name: {"val/miou": 0.1} for name in PARTS}
    theirs = {name: {"val/miou": 0.9} for name in PARTS}
    other = replace(fresh_weights(seed=1), metrics=theirs)
    mixed = replace(weights, metrics=mine).replace_part(part, other)
    assert mixed.metrics == mine | {part: theirs[part]}
    assert mixed.training == {**weights.training, part: other.training[part]}


@pytest.mark.parametrize("part", PARTS)
def test_replacing_a_part_changes_only_that_part(weights: Weights, part: str) -> None:
    other = fresh_weights(seed=1)
    mixed = weights.replace_part(part, other)

    for name in PARTS:
        source = other if name == part else weights
        assert mixed.training[name] == source.training[name]
        assert_same_tensors(mixed.part(name), source.part(name))

    assert not np.array_equal(segment(mixed).scores, segment(weights).scores)


def test_replacing_all_parts_gives_the_other_weights(weights: Weights) -> None:
    other = fresh_weights(seed=1)
    mixed = weights
    for part in PARTS:
        mixed = mixed.replace_part(part, other)
    assert np.array_equal(ensemble_scores(mixed), ensemble_scores(other))


def test_a_part_brings_its_sizes(weights: Weights) -> None:
    config = replace(weights.model, range_view=replace(weights.model.range_view, width=128))
    mixed = weights.replace_part("range_net", replace(weights, model=config))
    assert mixed.model.range_view.width == 128
    assert mixed.model.polar_view == weights.model.polar_view


def test_networks_and_head_of_two_files_add_up(weights: Weights) -> None:
    networks = without(weights, "point_head")
    head = without(weights, "range_net", "polar_net")
    assert networks.parts == ("range_net", "polar_net")
    assert head.parts == ("point_head",)

    whole = networks.replace_part("point_head", head)
    assert np.array_equal(segment(whole).scores, segment(weights).scores)


@pytest.mark.parametrize("part", PARTS)
def test_a_part_for_other_classes_is_refused(weights: Weights, part: str) -> None:
    with pytest.raises(InputError, match="nuscenes"):
        weights.replace_part(part, fresh_weights(NUSCENES))


def test_a_missing_part_is_refused(weights: Weights) -> None:
    with pytest.raises(InputError, match="point_head"):
        weights.replace_part("point_head", without(weights, "point_head"))


def test_parameters_that_do_not_fit_their_sizes_are_refused(weights: Weights) -> None:
    config = replace(weights.model, range_net=replace(weights.model.range_net, stem=32))
    with pytest.raises(InputError, match="range_net"):
        replace(weights, model=config).build()


# --- files that are not weights ---


def read_description(content: bytes) -> dict[str, Any]:
    """Return the description in the bytes of a weights file."""
    size = int.from_bytes(content[:8], "little")
    header = json.loads(content[8 : 8 + size])
    return json.loads(header["__metadata__"]["amvnet"])


def save_described(path: Path, description: Any) -> None:
    """Write a safetensors file with any description."""
    save_file({"range_net.a": torch.zeros(2)}, path, metadata={"amvnet": json.dumps(description)})


def save_changed(path: Path, content: bytes, **changes: object) -> None:
    """Write a safetensors file with some fields of a good description changed."""
    save_described(path, {**read_description(content), **changes})


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
    "another format": lambda path, content: save_described(path, {"format": 99}),
    "only the format": lambda path, content: save_described(path, {"format": 1}),
    "model of another kind": lambda path, content: save_changed(path, content, model=5),
    "no taxonomy": lambda path, content: save_changed(path, content, taxonomy={}),
}


@pytest.mark.parametrize("kind", BROKEN)
def test_a_file_that_is_not_weights_is_refused_in_one_line(
    kind: str, path: Path, tmp_path: Path
) -> None:
    broken = tmp_path / "broken.safetensors"
    BROKEN[kind](broken, path.read_bytes())
    with pytest.raises(InputError) as error:
        load(broken)
    assert "\n" not in str(error.value)


def test_for_other_classes_only_the_layers_that_depend_on_their_number_are_new() -> None:
    weights = fresh_weights()
    few = replace(
        weights.taxonomy,
        name="few",
        classes=("ground", "thing"),
        colors=((0, 0, 0),) * 3,
        raw_to_train={0: 0, 1: 1, 2: 2},
        train_to_raw=(0, 1, 2),
    )
    assert weights.training
    assert weights.metrics
    begun, new = weights.for_classes(few, seed=1)
    assert begun.taxonomy == few
    assert not begun.training  # of other classes
    assert not begun.metrics

    assert {name.split(".")[0] for name in new} == {"range_net", "polar_net", "point_head"}
    for name, tensor in weights.tensors.items():
        if name in new:
            assert begun.tensors[name].shape != tensor.shape or not begun.tensors[name].equal(
                tensor
            )
        else:
            assert begun.tensors[name].equal(tensor)
    last = {name for name in new if name.startswith(("range_net", "polar_net"))}
    assert all(".scores." in name for name in last)
    assert begun.build()  # the sizes fit

    again, _ = weights.for_classes(few, seed=1)
    other, _ = weights.for_classes(few, seed=2)
    key = "range_net.scores.weight"
    assert again.tensors[key].equal(begun.tensors[key])
    assert not other.tensors[key].equal(begun.tensors[key])


def test_for_other_classes_of_the_same_number_the_same_layers_are_new() -> None:
    weights = fresh_weights()
    renamed = replace(
        weights.taxonomy, classes=tuple(f"other-{name}" for name in weights.taxonomy.classes)
    )
    begun, new = weights.for_classes(renamed, seed=1)
    assert not begun.tensors["range_net.scores.weight"].equal(
        weights.tensors["range_net.scores.weight"]
    )
    assert len(new) < len(weights.tensors) / 3


def test_weights_that_name_values_of_removed_options_are_read(
    weights: Weights, path: Path, tmp_path: Path
) -> None:
    with safe_open(path, "np") as file:
        description = json.loads(file.metadata()["amvnet"])
    description["model"]["assertion"] |= {"name": "disagreement", "others": [], "combine": "any"}
    description["model"]["point_head"] |= {"pooling": "max", "heads": 1}

    earlier = tmp_path / "earlier.safetensors"
    save_file(dict(weights.tensors), earlier, metadata={"amvnet": json.dumps(description)})
    assert load(earlier).model == weights.model


def test_weights_for_other_classes_leave_the_random_state_as_it_was() -> None:
    weights = fresh_weights()
    few = replace(weights.taxonomy, name="few")
    torch.manual_seed(5)
    expected = torch.rand(3)
    torch.manual_seed(5)
    weights.for_classes(few, seed=1)
    assert torch.equal(torch.rand(3), expected)
