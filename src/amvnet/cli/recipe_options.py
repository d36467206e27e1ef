"""Add every value of a recipe as an option with dots, such as --training.rv.epochs 40."""

from __future__ import annotations

import argparse
import dataclasses
from collections.abc import Iterator
from typing import Any, get_type_hints

from amvnet.cli.parser import Parser, field_texts, first_line, metavar_of
from amvnet.config.nested import replace_values
from amvnet.config.schema import Recipe
from amvnet.config.yaml_files import parse_yaml
from amvnet.errors import InputError

SECTIONS = ("model", "training")  # the sections of a recipe whose values are options
HELP_ALL = "--help-all"


def add_recipe(parser: Parser, recipe: Recipe, shows_all: bool = False) -> None:
    """Add the values of a recipe as options, which the help shows if `shows_all`."""
    parser.add_argument(
        HELP_ALL,
        action="help",
        help="show also every value of the recipe, such as --training.rv.epochs, and exit",
    )
    for name in SECTIONS:
        if recipe.from_init and name == "model":  # comes from --init
            continue
        for path, config in _walk(getattr(recipe, name), name):
            group: Any = parser
            if shows_all:
                group = parser.add_argument_group(f"--{path}", first_line(type(config)))
            texts = field_texts(type(config))
            hints = get_type_hints(type(config))
            for key, value in vars(config).items():
                if dataclasses.is_dataclass(value):
                    continue
                text = f"{texts[key]} (default: {_to_text(value)})".replace("%", "%%")
                group.add_argument(
                    f"--{path}.{key}",
                    metavar=metavar_of(key, hints[key]),
                    help=text if shows_all else argparse.SUPPRESS,
                )


def with_options(recipe: Recipe, values: dict[str, Any]) -> Recipe:
    """Return a recipe with the texts of options that have dots in their names and are not None.

    Raises:
        InputError: if a value has the wrong type or is out of its range, or the recipe takes the
            model of --init and an option is for the model.
    """
    tree: dict[str, Any] = {}
    for name, text in values.items():
        if "." not in name or text is None:
            continue
        *path, key = name.split(".")
        if recipe.from_init and path[0] == "model":
            raise InputError(
                f"--{name}: expected no option for the model, because this recipe takes the model "
                "of --init; leave it out"
            )
        branch = tree
        for part in path:
            branch = branch.setdefault(part, {})
        branch[key] = parse_yaml(text, f"--{name}: expected a value")

    try:
        return replace_values(recipe, tree, "")
    except InputError as error:
        keys, _, rest = str(error).removeprefix(": ").partition(": expected ")
        raise InputError(f"--{keys.replace(': ', '.')}: expected {rest}") from None


def _walk(config: Any, path: str) -> Iterator[tuple[str, Any]]:
    """Yield a dataclass and all dataclasses inside it, each with its path."""
    yield path, config
    for key, value in vars(config).items():
        if dataclasses.is_dataclass(value):
            yield from _walk(value, f"{path}.{key}")


def _to_text(value: Any) -> str:
    if isinstance(value, tuple):
        return "[" + ",".join(map(str, value)) + "]"
    return str(value).lower() if isinstance(value, bool) else str(value)
