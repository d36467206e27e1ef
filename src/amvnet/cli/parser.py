"""From a verb's function to the parser of its command line."""

from __future__ import annotations

import inspect
from argparse import BooleanOptionalAction
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any, NoReturn, get_type_hints

import docstring_parser
from jsonargparse import ArgumentParser, set_parsing_settings

from amvnet.errors import InputError

if TYPE_CHECKING:
    from amvnet.config.schema import Recipe

Positional = Mapping[str, dict[str, Any]]


class Parser(ArgumentParser):
    """A parser whose complaint is one line, as all of ours are."""

    def error(self, message: str, ex: Exception | None = None) -> NoReturn:
        line = " ".join(message.split()) or str(ex)
        raise InputError(f"{line}; see {self.prog} --help")


def parser_of(
    verb: str, function: Callable[..., None], positional: Positional, recipe: Recipe | None
) -> Parser:
    """The parser of a verb, from its function's signature and docstring; with a recipe, its values are options too.

    Args:
        positional: the parameters that are given without an option's name, and argparse's arguments for them.
    """
    docs = docstring_parser.parse(function.__doc__ or "")
    help_of = {param.arg_name: param.description for param in docs.params}
    shown = " ".join(str(options["metavar"]) for options in positional.values())
    usage = f"amvnet {verb} {shown} [options]".replace("  ", " ")
    parser = Parser(
        prog=f"amvnet {verb}", usage=usage, description=docs.short_description, allow_abbrev=False
    )
    for name, options in positional.items():
        parser.add_argument(name, help=help_of.get(name), **options)
    set_parsing_settings(docstring_parse_attribute_docstrings=True)  # the help of a recipe's values
    hints = get_type_hints(function)
    for name, parameter in inspect.signature(function).parameters.items():
        if name not in positional:
            _add_option(parser, name, hints[name], parameter.default, help_of.get(name))
    if recipe is not None:
        _add_recipe(parser, recipe)
    return parser


def _add_option(parser: Parser, name: str, kind: Any, default: Any, text: str | None) -> None:
    """One parameter of a verb's function as an option, with dashes as the shell has them."""
    flag = "--" + name.replace("_", "-")
    if kind is bool:
        action = BooleanOptionalAction if default else "store_true"
        parser.add_argument(flag, action=action, default=default, help=text)
    elif default is inspect.Parameter.empty:
        parser.add_argument(flag, type=kind, required=True, help=text)
    else:
        parser.add_argument(flag, type=kind, default=default, help=text)


def _add_recipe(parser: Parser, recipe: Recipe) -> None:
    """Every value of the recipe as an option, with dots: --training.rv.epochs 40."""
    from amvnet.config.schema import ModelConfig, TrainingConfig

    parser.add_argument("--model", type=ModelConfig, default=recipe.model)
    parser.add_argument("--training", type=TrainingConfig, default=recipe.training)
