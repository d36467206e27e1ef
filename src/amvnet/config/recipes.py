"""What to train, and how: the built-in recipes beside this file, and users' own."""

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
    """The built-in recipes."""
    files = _FOLDER.iterdir()
    return tuple(sorted(f.name.removesuffix(".yaml") for f in files if f.name.endswith(".yaml")))


def load_recipe(name_or_path: str) -> Recipe:
    """A built-in recipe by name, or a user's YAML file that states only what differs.

    The key `base` names the recipe that a file builds on; without it, the paper's sizes.

    Raises:
        InputError: where there is no such recipe, or a key or value in it is not one of ours.
    """
    return from_dict(Recipe, _tree(name_or_path, ()), name_or_path)


def _tree(name_or_path: str, above: tuple[str, ...]) -> dict[str, Any]:
    """The keys and values of a recipe and of those below it; `above` are the ones that build on it."""
    if name_or_path in above:
        raise InputError(
            f"{name_or_path}: expected a base that ends, found this recipe in its own bases; name another"
        )
    try:
        tree = yaml.safe_load(_text(name_or_path)) or {}
    except yaml.YAMLError as error:
        raise InputError(
            f"{name_or_path}: expected YAML, found {str(error).splitlines()[0]}; mend the file"
        ) from None
    if not isinstance(tree, dict):
        raise InputError(
            f"{name_or_path}: expected keys and values, found {type(tree).__name__}; mend the file"
        )
    base = tree.pop("base", None)
    if base is None:
        return tree
    if not isinstance(base, str):
        raise InputError(
            f"{name_or_path}: expected the name of a recipe as base, found {base!r}; correct the value"
        )
    return merge_trees(_tree(base, (*above, name_or_path)), tree)


def _text(name_or_path: str) -> str:
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
            f"{name_or_path}: expected a YAML file, found bytes that are no text; give a recipe"
        ) from None
