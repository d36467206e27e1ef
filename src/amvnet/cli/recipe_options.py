"""Every value of a recipe as an option with dots, such as --training.rv.epochs 40."""

from __future__ import annotations

import argparse
import dataclasses
from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING, Any, get_type_hints

from amvnet.cli.parser import field_texts, metavar_of
from amvnet.config.nested import replace_values
from amvnet.config.schema import Recipe
from amvnet.errors import InputError
from amvnet.files import parse_yaml

if TYPE_CHECKING:
    from amvnet.cli.parser import Parser

PARTS = ("model", "training")  # of a recipe, whose values are options
HELP_ALL = "--help-all"
# The values that people set; --help shows these, and --help-all the others too.
OFTEN_SET = (
    "--model.assertion.threshold",
    "--training.rv.epochs",
    "--training.rv.batch",
    "--training.rv.lr",
    "--training.bev.epochs",
    "--training.bev.batch",
    "--training.bev.lr",
    "--training.head.epochs",
    "--training.head.lr",
    "--training.seed",
    "--training.workers",
    "--training.precision",
    "--training.accelerator",
)


def add_recipe(parser: Parser, recipe: Recipe, shows_all: bool = True) -> None:
    """Add the values of a recipe as options.

    Args:
        parser: where to add them.
        recipe: has the values that the help shows.
        shows_all: whether the help has all values, one group for each part of the recipe, or only
            those in `OFTEN_SET`.
    """
    parser.add_argument(HELP_ALL, action="help", help="show every value of the recipe and exit")
    often_set = parser.add_argument_group("values of the recipe that are set often")
    for name in PARTS:
        for path, config in _walk(getattr(recipe, name), name):
            values = _leaves(config)
            group = often_set
            if values and shows_all:
                group = parser.add_argument_group(f"--{path}", _first_line(type(config)))
            texts = field_texts(type(config))
            hints = get_type_hints(type(config))
            for key, value in values.items():
                flag = f"--{path}.{key}"
                text = f"{texts[key]} (default: {_to_text(value)})".replace("%", "%%")
                if not shows_all and flag not in OFTEN_SET:
                    text = argparse.SUPPRESS
                metavar = metavar_of(key, hints[key])
                group.add_argument(flag, type=str, default=None, metavar=metavar, help=text)
                parser.kinds[flag] = hints[key]


def with_options(recipe: Recipe, values: dict[str, Any]) -> Recipe:
    """Return a recipe with the values of the options that the user gave.

    Args:
        recipe: the recipe.
        values: all options of the verb by name, nested by their dots; those of the recipe are
            removed.

    Raises:
        InputError: if a value does not fit.
    """
    tree: dict[str, Any] = {}
    for name in PARTS:
        part = _nested_values(values.pop(name, {}), f"--{name}")
        if part:
            tree[name] = part
    try:
        return replace_values(recipe, tree, "")
    except InputError as error:
        keys, _, rest = str(error).removeprefix(": ").partition(": expected ")
        raise InputError(f"--{keys.replace(': ', '.')}: expected {rest}") from None


def _nested_values(values: Any, flag: str) -> Any:
    """Return nested values without those that were left out, read as YAML."""
    if isinstance(values, str):
        return parse_yaml(values, f"{flag}: expected a value")

    nested: dict[str, Any] = {}
    for key, value in _items(values):
        if value is None:
            continue
        inner = _nested_values(value, f"{flag}.{key}")
        if inner != {}:
            nested[key] = inner
    return nested


def _items(values: Any) -> Iterator[tuple[str, Any]]:
    yield from (values if isinstance(values, Mapping) else vars(values)).items()


def _walk(config: Any, path: str) -> Iterator[tuple[str, Any]]:
    """Yield a dataclass and those in it, each with its path."""
    yield path, config
    for key, value in vars(config).items():
        if dataclasses.is_dataclass(value):
            yield from _walk(value, f"{path}.{key}")


def _leaves(config: Any) -> dict[str, Any]:
    """Return the values of a dataclass that are no dataclasses themselves."""
    return {
        key: value for key, value in vars(config).items() if not dataclasses.is_dataclass(value)
    }


def _first_line(cls: type) -> str:
    return (cls.__doc__ or "").strip().splitlines()[0]


def _to_text(value: Any) -> str:
    """Return a value as users write it."""
    if isinstance(value, tuple):
        return "[" + ",".join(map(str, value)) + "]"
    return str(value).lower() if isinstance(value, bool) else str(value)
