"""Configurations survive the way to dictionaries and back; wrong keys and values are named."""

from __future__ import annotations

import dataclasses
import json
import math
from collections.abc import Iterator
from dataclasses import is_dataclass
from pathlib import Path
from typing import Annotated, Any, get_args, get_origin, get_type_hints

import pytest
import yaml

from amvnet.config.bounds import Range
from amvnet.config.nested import from_dict, to_dict
from amvnet.config.recipes import load_recipe, recipe_names
from amvnet.config.schema import ModelConfig, PointHeadConfig, Recipe

from fixtures.commands import fails, new_file


def write_recipe(folder: Path, text: str) -> str:
    return str(new_file(folder / "mine.yaml", text))


def flatten(tree: dict[str, Any], prefix: str = "") -> dict[str, Any]:
    """Return the leaves of nested dictionaries by their path: {"model.range_view.width": 96}."""
    leaves: dict[str, Any] = {}
    for key, value in tree.items():
        if isinstance(value, dict):
            leaves.update(flatten(value, f"{prefix}{key}."))
        else:
            leaves[f"{prefix}{key}"] = value
    return leaves


@pytest.mark.parametrize("name", recipe_names())
def test_a_recipe_survives_the_way_to_json_and_yaml_and_back(name: str) -> None:
    recipe = load_recipe(name)
    tree = to_dict(recipe)

    assert json.loads(json.dumps(tree)) == tree
    assert from_dict(Recipe, json.loads(json.dumps(tree))) == recipe
    assert from_dict(Recipe, yaml.safe_load(yaml.safe_dump(tree))) == recipe
    assert from_dict(ModelConfig, tree["model"]) == recipe.model


def test_the_semantickitti_recipe_holds_the_papers_numbers() -> None:
    recipe = load_recipe("semantickitti")
    assert recipe.taxonomy == "semantickitti"

    view = recipe.model.range_view
    assert view.rows == "elevation"
    assert (view.height, view.width) == (64, 4096)
    assert (view.fov_up, view.fov_down) == (3.0, -25.0)

    grid = recipe.model.polar_view
    assert (grid.radial, grid.angular, grid.vertical) == (480, 360, 32)
    assert (grid.radius_max, grid.z_min, grid.z_max) == (50.0, -3.0, 1.5)

    assert recipe.model.assertion.threshold == 0.85
    assert recipe.model.assertion.lead == 0  # also of weights that do not name it
    assert recipe.model.point_head.neighbours == 15

    training = recipe.training
    assert (training.rv.epochs, training.rv.batch) == (160, 32)
    assert (training.bev.epochs, training.bev.batch) == (40, 8)


def test_the_nuscenes_recipe_holds_the_papers_numbers() -> None:
    recipe = load_recipe("nuscenes")
    assert recipe.taxonomy == "nuscenes"

    view = recipe.model.range_view
    assert view.rows == "ring"
    assert (view.height, view.width) == (32, 1920)

    grid = recipe.model.polar_view
    assert (grid.z_min, grid.z_max) == (-2.0, 4.0)

    training = recipe.training
    assert (training.rv.epochs, training.rv.batch) == (400, 64)
    assert (training.bev.epochs, training.bev.batch) == (40, 8)


@pytest.mark.parametrize("recipe", ["semantickitti", "nuscenes"])
@pytest.mark.parametrize("size", ["", "-compact"])
def test_the_recipes_of_the_benchmarks_have_the_papers_head(recipe: str, size: str) -> None:
    assert load_recipe(f"{recipe}{size}").model.point_head == PointHeadConfig()


@pytest.mark.parametrize(
    ("text", "pattern"),
    [
        ("modle: {}", "modle"),
        ("model: {range_view: {hieght: 3}}", "hieght"),
        ("training: {rv: {epoch: 3}}", "epoch"),
        ("model: {range_view: {height: tall}}", "height.*tall"),
        ("model: {range_view: {height: 64.5}}", "height"),
        ("model: {range_view: {height: true}}", "height"),
        ("model: {range_view: {fov_up: up}}", "fov_up"),
        ("model: {range_view: {fov_up: true}}", "fov_up"),
        ("model: {range_view: {rows: colour}}", "rows.*elevation, laser, ring.*colour"),
        ("model: {range_view: {rows: [ring]}}", "rows"),
        ("training: {rv: {region_loss: focal}}", "region_loss.*dice, lovasz.*focal"),
        ("model: {range_net: {gru: 1}}", "gru"),
        ("model: {range_net: {widths: 64}}", "widths"),
        ("model: {range_net: {widths: [64, wide]}}", "widths"),
        ("model: {range_net: {widths: [true, false]}}", "widths"),
        ("model: {range_net: 3}", "range_net"),
        ("model:", "model"),
        ("taxonomy: cityscapes", "taxonomy.*cityscapes"),
        ("training: {accelerator: 3}", "accelerator"),
        ("7: seven", "7"),
        *((text, "") for text in ("- a\n- b", "just words", "a: [1, 2", "a: b: c")),
    ],
)
def test_an_input_error_names_a_wrong_key_or_value(tmp_path: Path, text: str, pattern: str) -> None:
    fails(lambda: load_recipe(write_recipe(tmp_path, text)), "mine.yaml", *pattern.split(".*"))


def test_an_unknown_recipe_is_an_input_error_that_lists_the_known_ones() -> None:
    fails(lambda: load_recipe("kitti"), "'kitti'", "nuscenes-compact", "simulated")


@pytest.mark.parametrize("base", ["nothing-like-it", "3", "[nuscenes]", "{a: 1}", "mine.yaml"])
def test_a_base_that_is_no_other_recipe_is_an_input_error(
    tmp_path: Path, base: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    fails(lambda: load_recipe(write_recipe(Path(), f"base: {base}")))


@pytest.mark.parametrize("base", ["nuscenes-compact", "semantickitti"])
def test_a_users_file_overrides_only_what_it_states(tmp_path: Path, base: str) -> None:
    path = write_recipe(
        tmp_path,
        f"base: {base}\n"
        "model: {range_view: {width: 96}}\n"
        "training: {rv: {lr: 1}, keep: best}\n",
    )
    original = flatten(to_dict(load_recipe(base)))
    leaves = flatten(to_dict(load_recipe(path)))

    changed = {key: value for key, value in leaves.items() if value != original[key]}
    assert changed == {"model.range_view.width": 96, "training.rv.lr": 1.0, "training.keep": "best"}
    assert isinstance(leaves["training.rv.lr"], float)


@pytest.mark.parametrize(("text", "value"), [("2e-3", 2e-3), ("1E-4", 1e-4), ("5", 5.0)])
def test_numbers_with_an_exponent_are_numbers(tmp_path: Path, text: str, value: float) -> None:
    recipe = load_recipe(write_recipe(tmp_path, f"training: {{rv: {{lr: {text}}}}}"))
    assert recipe.training.rv.lr == value


def test_a_users_file_without_a_base_builds_on_the_papers_sizes(tmp_path: Path) -> None:
    recipe = load_recipe(write_recipe(tmp_path, "training: {seed: 5}"))
    training = dataclasses.replace(Recipe().training, seed=5)
    assert recipe == dataclasses.replace(Recipe(), training=training)


def test_a_users_file_may_build_on_another_users_file(tmp_path: Path) -> None:
    first = new_file(tmp_path / "first.yaml", "base: nuscenes\ntraining: {seed: 5, workers: 2}")
    second = write_recipe(tmp_path, f"base: {first}\ntraining: {{seed: 6}}")

    training = load_recipe(second).training
    assert (training.seed, training.workers, training.rv.epochs) == (6, 2, 400)


@pytest.mark.parametrize(
    "text",
    [
        "model: {range_view: {width: 0}}",
        "model: {range_view: {fov_up: -30}}",
        "model: {polar_view: {radius_min: 60}}",
        "model: {polar_view: {z_min: 9}}",
        "model: {range_net: {widths: [16, 16]}}",
        "model: {range_net: {widths: [64, 96, 0, 256, 256, 256, 256]}}",
        "model: {range_net: {dropout: 1}}",
        "model: {polar_net: {point_widths: [8]}}",
        "model: {polar_net: {widths: []}}",
        "model: {polar_net: {decoder: [64, 64]}}",
        "model: {point_head: {hidden: []}}",
        "training: {rv: {epochs: 0}}",
        "training: {bev: {lr: 0}}",
        "training: {head: {warmup: 1}}",
        "training: {rv: {accumulate: 3}}",
        "training: {seed: -1}",
        "training: {augment: {flip: 1.5}}",
        "training: {augment: {tilt: -1}}",
        "training: {augment: {intensity_gamma: 4}}",
        "training: {augment: {intensity_offset: 2}}",
        "training: {augment: {laser_gain: 1}}",
        "training: {augment: {paste: 1.1}}",
    ],
)
def test_a_number_out_of_its_range_gets_an_error_with_the_range(tmp_path: Path, text: str) -> None:
    fails(lambda: load_recipe(write_recipe(tmp_path, text)), "mine.yaml: ", "correct the value")


def test_every_number_of_a_recipe_has_two_bounds() -> None:
    def numbers(cls: type) -> Iterator[tuple[str, Any]]:
        for name, kind in get_type_hints(cls, include_extras=True).items():
            if isinstance(kind, type) and is_dataclass(kind):
                yield from numbers(kind)
            else:
                item_kind = get_args(kind)[0] if get_origin(kind) is tuple else kind
                yield f"{cls.__name__}.{name}", item_kind

    for name, kind in numbers(Recipe):
        number = get_args(kind)[0] if get_origin(kind) is Annotated else kind
        if number in (int, float):
            (allowed,) = [part for part in get_args(kind) if isinstance(part, Range)]
            assert math.isfinite(allowed.high), name
