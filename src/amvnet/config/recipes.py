"""What to train, and how: the built-in recipes in the folder `recipes`, and users' own."""

from __future__ import annotations

from importlib import resources
from pathlib import Path
from typing import Any

import yaml

from amvnet.config.nested import from_dict, merge_trees
from amvnet.config.schema import Recipe
from amvnet.errors import InputError

_FOLDER = resources.files("amvnet.config") / "recipes"


def recipe_names() -> tuple[str, ...]:
    """Return the names of the built-in recipes, sorted."""
    files = _FOLDER.iterdir()
    return tuple(sorted(f.name.removesuffix(".yaml") for f in files if f.name.endswith(".yaml")))


def load_recipe(name_or_path: str) -> Recipe:
    """Read a built-in recipe by name, or a user's YAML file that states only what differs.

    The key `base` names the recipe that a file builds on; without it, the defaults of `Recipe`
    (the paper's sizes) apply.

    Raises:
        InputError: if there is no such recipe, or a key or value in it is not valid.
    """
    return from_dict(Recipe, _read_tree(name_or_path, ()), name_or_path)


def _read_tree(name_or_path: str, dependents: tuple[str, ...]) -> dict[str, Any]:
    """Read a recipe, merged with those that it builds on.

    Args:
        name_or_path: the recipe.
        dependents: the recipes that build on this one, to find circles.
    """
    if name_or_path in dependents:
        raise InputError(
            f"{name_or_path}: expected a base that ends, found this recipe in its own bases; "
            "name another"
        )

    try:
        tree = yaml.safe_load(_read_text(name_or_path)) or {}
    except yaml.YAMLError as error:
        reason = str(error).splitlines()[0]
        raise InputError(f"{name_or_path}: expected YAML, found {reason}; mend the file") from None

    if not isinstance(tree, dict):
        raise InputError(
            f"{name_or_path}: expected keys and values, found {type(tree).__name__}; mend the file"
        )

    base = tree.pop("base", None)
    if base is None:
        return tree
    if not isinstance(base, str):
        raise InputError(
            f"{name_or_path}: expected the name of a recipe as base, found {base!r}; "
            "correct the value"
        )

    return merge_trees(_read_tree(base, (*dependents, name_or_path)), tree)


def _read_text(name_or_path: str) -> str:
    if name_or_path in recipe_names():
        return (_FOLDER / f"{name_or_path}.yaml").read_text(encoding="utf-8")

    if not Path(name_or_path).is_file():
        raise InputError(
            f"expected a recipe's name or a YAML file, found {name_or_path!r}; "
            f"the built-in ones are {', '.join(recipe_names())}"
        )

    try:
        return Path(name_or_path).read_text(encoding="utf-8")
    except UnicodeDecodeError:
        raise InputError(
            f"{name_or_path}: expected a YAML file, found bytes that are not text; give a recipe"
        ) from None
