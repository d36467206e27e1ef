"""A weights file explains itself, comes back as it was, and is never run; parts are replaced one by one."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from safetensors import safe_open
from safetensors.torch import save_file

from amvnet.config.nested import to_dict
from amvnet.data.taxonomy import NUSCENES, SEMANTICKITTI
from amvnet.errors import InputError
from amvnet.inference.segmenter import Segmenter
from amvnet.weights.file import PARTS, Weights, load, save

from fixtures.worlds import fresh_weights, street, without


@pytest.fixture(scope="module")
def weights() -> Weights:
    return fresh_weights()


@pytest.fixture(scope="module")
def path(weights: Weights, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return save(weights, tmp_path_factory.mktemp("weights") / "w.safetensors")


def scores(weights: Weights) -> np.ndarray:
    return Segmenter(weights, method="ensemble")(street(9)[0]).scores


def test_what_was_saved_is_loaded(weights: Weights, path: Path) -> None:
    loaded = load(path)
    assert set(loaded.tensors) == set(weights.tensors)
    assert all(torch.equal(loaded.tensors[name], value) for name, value in weights.tensors.items())
    assert replace(loaded, tensors={}) == replace(weights, tensors={})


def test_loaded_weights_segment_as_the_saved_ones(weights: Weights, path: Path) -> None:
    ours, theirs = (Segmenter(w)(street(9)[0]) for w in (weights, str(path)))
    assert np.array_equal(ours.scores, theirs.scores)
    assert np.array_equal(ours.labels, theirs.labels)


def test_the_folder_of_a_run_stands_for_its_weights(weights: Weights, tmp_path: Path) -> None:
    save(weights, tmp_path / "weights.safetensors")
    assert load(tmp_path).parts == PARTS


def test_the_description_is_read_without_our_code(weights: Weights, path: Path) -> None:
    with safe_open(path, "np") as file:
        said = json.loads(file.metadata()["amvnet"])
        names = set(file.keys())
    assert names == set(weights.tensors)
    assert said["model"] == to_dict(weights.model)
    assert said["taxonomy"]["classes"] == list(SEMANTICKITTI.classes)
    assert (said["sensor"], said["training"], said["metrics"]) == (
        weights.sensor,
        dict(weights.training),
        dict(weights.metrics),
    )


def test_half_is_half_the_size_and_nearly_the_same(
    weights: Weights, path: Path, tmp_path: Path
) -> None:
    half = save(weights, tmp_path / "half.safetensors", half=True)
    count = sum(v.numel() for v in weights.tensors.values() if v.ndim > 1)
    assert path.stat().st_size - half.stat().st_size == pytest.approx(2 * count, abs=2000)
    assert np.abs(scores(load(half)) - scores(weights)).max() < 0.02


@pytest.mark.parametrize("part", PARTS)
def test_replacing_a_part_changes_that_part_alone(weights: Weights, part: str) -> None:
    other = fresh_weights(seed=1)
    mixed = weights.replace_part(part, other)
    for name in PARTS:
        source = other if name == part else weights
        assert mixed.training[name] == source.training[name]
        assert all(torch.equal(v, source.part(name)[k]) for k, v in mixed.part(name).items())
    assert not np.array_equal(
        Segmenter(mixed)(street(9)[0]).scores, Segmenter(weights)(street(9)[0]).scores
    )


def test_all_parts_replaced_are_the_other_weights(weights: Weights) -> None:
    other = fresh_weights(seed=1)
    mixed = weights
    for part in PARTS:
        mixed = mixed.replace_part(part, other)
    assert np.array_equal(scores(mixed), scores(other))


def test_a_part_brings_its_sizes(weights: Weights) -> None:
    config = replace(weights.model, range_view=replace(weights.model.range_view, width=128))
    mixed = weights.replace_part("range_net", replace(weights, model=config))
    assert mixed.model.range_view.width == 128
    assert mixed.model.polar_view == weights.model.polar_view


def test_parts_add_up(weights: Weights) -> None:
    networks, head = without(weights, "point_head"), without(weights, "range_net", "polar_net")
    assert (networks.parts, head.parts) == (PARTS[:2], PARTS[2:])
    whole = networks.replace_part("point_head", head)
    assert np.array_equal(
        Segmenter(whole)(street(9)[0]).scores, Segmenter(weights)(street(9)[0]).scores
    )


@pytest.mark.parametrize("part", PARTS)
def test_a_part_for_other_classes_is_refused(weights: Weights, part: str) -> None:
    with pytest.raises(InputError, match="nuscenes"):
        weights.replace_part(part, fresh_weights(NUSCENES))


def test_a_part_that_is_not_there_is_refused(weights: Weights) -> None:
    with pytest.raises(InputError, match="point_head"):
        weights.replace_part("point_head", without(weights, "point_head"))


def test_parameters_that_do_not_fit_their_sizes_are_refused(weights: Weights) -> None:
    config = replace(weights.model, range_net=replace(weights.model.range_net, stem=32))
    with pytest.raises(InputError, match="range_net"):
        replace(weights, model=config).build()


def described(path: Path, description: Any) -> None:
    save_file({"range_net.a": torch.zeros(2)}, path, metadata={"amvnet": json.dumps(description)})


BROKEN = {
    "no file": lambda path, good: None,
    "empty": lambda path, good: path.write_bytes(b""),
    "text": lambda path, good: path.write_text("weights"),
    "truncated": lambda path, good: path.write_bytes(good[: len(good) // 2]),
    "truncated header": lambda path, good: path.write_bytes(good[:100]),
    "pickle": lambda path, good: torch.save({"range_net.a": torch.zeros(2)}, path),
    "without description": lambda path, good: save_file({"range_net.a": torch.zeros(2)}, path),
    "description of another kind": lambda path, good: described(path, ["format"]),
    "another format": lambda path, good: described(path, {"format": 99}),
    "format alone": lambda path, good: described(path, {"format": 1}),
    "model of another kind": lambda path, good: described(path, {**said(good), "model": 5}),
    "no taxonomy": lambda path, good: described(path, {**said(good), "taxonomy": {}}),
}


def said(good: bytes) -> dict[str, Any]:
    """The description in the bytes of a weights file."""
    header = json.loads(good[8 : 8 + int.from_bytes(good[:8], "little")])
    return json.loads(header["__metadata__"]["amvnet"])


@pytest.mark.parametrize("kind", BROKEN)
def test_what_is_not_a_weights_file_is_refused_in_one_line(
    kind: str, path: Path, tmp_path: Path
) -> None:
    bad = tmp_path / "bad.safetensors"
    BROKEN[kind](bad, path.read_bytes())
    with pytest.raises(InputError) as error:
        load(bad)
    assert "\n" not in str(error.value)
