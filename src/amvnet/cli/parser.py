"""Make the parser of a verb from the signature and the docstring of its function."""

from __future__ import annotations

import inspect
from argparse import BooleanOptionalAction
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NoReturn, get_type_hints

import docstring_parser
from jsonargparse import ArgumentParser, set_parsing_settings

from amvnet.errors import InputError

if TYPE_CHECKING:
    from amvnet.config.schema import Recipe


@dataclass(frozen=True)
class Command:
    """One verb of the command line.

    Attributes:
        run: does the work; its signature and docstring define the options.
        positional: the parameters that are positional on the command line, and for each the
            keyword arguments of argparse's `add_argument`.
    """

    run: Callable[..., None]
    positional: Mapping[str, dict[str, Any]]

    @property
    def takes_recipe(self) -> bool:
        """Whether a recipe is an argument, and each of its values an option."""
        return "recipe" in self.positional


class Parser(ArgumentParser):
    """A parser that raises an InputError of one line instead of printing its usage."""

    def error(self, message: str, ex: Exception | None = None) -> NoReturn:
        line = " ".join(message.split()) or str(ex)
        raise InputError(f"{line}; see {self.prog} --help")


def make_parser(verb: str, command: Command, recipe: Recipe | None = None) -> Parser:
    """Return the parser of a verb; the values of a recipe, if any, become options too."""
    docs = docstring_parser.parse(command.run.__doc__ or "")
    help_texts = {param.arg_name: param.description for param in docs.params}
    metavars = [str(options["metavar"]) for options in command.positional.values()]
    parser = Parser(
        prog=f"amvnet {verb}",
        usage=" ".join(["amvnet", verb, *metavars, "[options]"]),
        description=docs.short_description,
        allow_abbrev=False,
    )

    for name, options in command.positional.items():
        parser.add_argument(name, help=help_texts.get(name), **options)
    # Show the documentation of a recipe's values in the help.
    set_parsing_settings(docstring_parse_attribute_docstrings=True)
    hints = get_type_hints(command.run)
    for name, parameter in inspect.signature(command.run).parameters.items():
        if name not in command.positional:
            _add_option(parser, parameter, hints[name], help_texts.get(name))
    if recipe is not None:
        _add_recipe(parser, recipe)
    return parser


def _add_option(
    parser: Parser, parameter: inspect.Parameter, kind: Any, help_text: str | None
) -> None:
    """Add one parameter of a verb's function as an option, with dashes instead of underscores."""
    flag = "--" + parameter.name.replace("_", "-")
    default = parameter.default
    if kind is bool:
        action = BooleanOptionalAction if default else "store_true"
        parser.add_argument(flag, action=action, default=default, help=help_text)
    elif default is inspect.Parameter.empty:
        parser.add_argument(flag, type=kind, required=True, help=help_text)
    else:
        parser.add_argument(flag, type=kind, default=default, help=help_text)


def _add_recipe(parser: Parser, recipe: Recipe) -> None:
    """Add every value of a recipe as an option, with dots: --training.rv.epochs 40."""
    from amvnet.config.schema import ModelConfig, TrainingConfig

    parser.add_argument("--model", type=ModelConfig, default=recipe.model)
    parser.add_argument("--training", type=TrainingConfig, default=recipe.training)
