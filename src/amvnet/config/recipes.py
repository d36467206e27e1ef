"""Read built-in recipes and users' own recipes. A recipe says what to train and how."""

from __future__ import annotations

from importlib import resources
from pathlib import Path
from typing import Any

from amvnet.config.nested import from_dict, merge_trees
from amvnet.config.schema import Recipe
from amvnet.config.yaml_files import read_yaml
from amvnet.errors import InputError, did_you_mean, shown

# Folder of the built-in recipes.
_FOLDER = resources.files("amvnet.config") / "recipes"


def recipe_names() -> tuple[str, ...]:
    """Return the names of the built-in recipes, sorted."""
    names = (file.name for file in _FOLDER.iterdir())
    return tuple(sorted(name.removesuffix(".yaml") for name in names if name.endswith(".yaml")))


def load_recipe(name_or_path: str) -> Recipe:
    """Read a built-in recipe by name, or a user's YAML file.

    A file states only what differs from its base: the recipe under its key `base`, or the defaults
    of `Recipe` (the paper's sizes) if it has no such key.

    Raises:
        InputError: if there is no such recipe, a key or a value in it is not valid, its bases form
            a circle, or it has a model although it takes the model of --init.
    """
    tree = _read_tree(name_or_path, ())
    if tree.get("from_init") is True and "model" in tree:
        raise InputError(
            f"{name_or_path}: expected no section model, because the recipe takes the model of "
            "--init (from_init), found one; leave it out"
        )
    return from_dict(Recipe, tree, name_or_path)


def _read_tree(name_or_path: str, dependents: tuple[str, ...]) -> dict[str, Any]:
    """Read a recipe, merged with its bases; `dependents` build on it, to detect a circle."""
    if name_or_path in dependents:
        raise InputError(
            f"{name_or_path}: expected bases without a circle, "
            "found this recipe among its own bases; name another base"
        )

    tree = read_yaml(_find(name_or_path), "a recipe")

    # An empty file, perhaps from an interrupted download, must not train at the paper's sizes.
    if not isinstance(tree, dict) or not tree:
        found = shown(tree) if tree else "an empty file"
        raise InputError(
            f"{name_or_path}: expected keys and values, found {found}; write at least the line "
            "base: semantickitti-compact"
        )

    base = tree.pop("base", None)
    if base is None:
        return tree
    if not isinstance(base, str):
        raise InputError(
            f"{name_or_path}: expected the name of a recipe as base, found {shown(base)}; "
            "correct the value"
        )

    base_tree = _read_tree(base, (*dependents, name_or_path))
    return merge_trees(base_tree, tree)


def _find(name_or_path: str) -> Path:
    if name_or_path in recipe_names():
        return Path(str(_FOLDER)) / f"{name_or_path}.yaml"

    path = Path(name_or_path)
    if not path.is_file():
        raise InputError(
            f"expected a recipe's name or a YAML file, found {shown(name_or_path)}"
            + did_you_mean(
                name_or_path,
                recipe_names(),
                advice=f"the built-in recipes are {', '.join(recipe_names())}",
            )
        )
    return path
