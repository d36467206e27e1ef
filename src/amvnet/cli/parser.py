"""Make the parser of a command from the signature and the docstring of its function.

A command with a recipe also has every value of the recipe as an option with dots, such as
--training.rv.epochs 40.
"""

from __future__ import annotations

import argparse
import dataclasses
import inspect
import math
import os
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Literal, NoReturn, get_args, get_origin, get_type_hints

import docstring_parser

from amvnet.cli.console import report_lines
from amvnet.config.bounds import Range
from amvnet.config.nested import replace_values
from amvnet.config.schema import Recipe
from amvnet.config.yaml_files import parse_yaml
from amvnet.errors import InputError, did_you_mean, shown
from amvnet.sensors.lidars import BUILT_IN

NUMBERS = {int: "a whole number", float: "a number"}  # what messages call the types of numbers
# What stands for an argument in the help. Other arguments are shown by their name in capitals.
METAVARS = {"inputs": "INPUT", "weights": "W"}
SECTIONS = ("model", "training")  # the sections of a recipe whose values are options
HELP_ALL = "--help-all"


class HelpFormatter(argparse.HelpFormatter):
    """A formatter that writes the default of an option after its text, unless the text has it."""

    def __init__(self, prog: str) -> None:
        super().__init__(prog, max_help_position=30)

    def _get_help_string(self, action: argparse.Action) -> str:
        text = action.help or ""
        has_no_default = action.default in (None, False, argparse.SUPPRESS)
        if has_no_default or "default:" in text or not action.option_strings:
            return text
        return f"{text} (default: %(default)s)"


class Parser(argparse.ArgumentParser):
    """A parser that raises an InputError of one line instead of printing its usage."""

    def __init__(self, **kwargs: Any) -> None:
        super().__init__(formatter_class=HelpFormatter, allow_abbrev=False, **kwargs)
        self._negative_number_matcher = re.compile(r"-\.?\d")  # so that -1,0,0 is a value
        self.kinds: dict[str, Any] = {}  # the types of the values by name
        self._words: Sequence[str] = ()  # the words that are being parsed

    def error(self, message: str) -> NoReturn:
        """Raise InputError with argparse's message as a line that says what to do."""
        line = " ".join(message.split())
        unknown = re.match(r"unrecognized arguments: (.*)", line)
        missing = re.match(r"the following arguments are required: (.*)", line)
        if unknown is not None:
            raise InputError(self._unknown(unknown[1]))
        if missing is not None:
            wrong = self._wrong_option()
            if wrong is not None:  # helps the user more than the missing option
                raise InputError(self._unknown(wrong))
            built_in = f" (built in: {', '.join(BUILT_IN)})" if "--weights" in missing[1] else ""
            line = f"expected {missing[1]}, found none; add what is missing{built_in}"
        raise InputError(f"{line}; see {self.prog} --help")

    def print_help(self, file: Any = None) -> None:
        """Print the help to the console; `file` is argparse's, and not used."""
        report_lines(self.format_help().rstrip())

    def values(self, arguments: Sequence[str]) -> dict[str, Any]:
        """Return the values of all arguments and options by name, converted to their types.

        Raises:
            InputError: if an argument is missing or unknown, or a value is not of its type.
        """
        self._words = arguments
        values = vars(self.parse_args(arguments))
        for name, kind in self.kinds.items():
            if isinstance(values[name], str):
                values[name] = _convert(flag_of(name), values[name], kind)
        return values

    def _flags(self) -> list[str]:
        return [known for action in self._actions for known in action.option_strings]

    def _wrong_option(self) -> str | None:
        for word in self._words:
            if word == "--":
                break
            is_value = self._negative_number_matcher.match(word) or word == "-"
            if word.startswith("-") and not is_value and word.split("=")[0] not in self._flags():
                return word
        return None

    def _unknown(self, words: str) -> str:
        """Return the message about words that are no options, joined by spaces as by argparse."""
        see_help = f"see {self.prog} --help"
        if not words.startswith("-"):
            return f"expected nothing more, found {words}; leave it out; {see_help}"
        word = next((word for word in self._words if word and words.startswith(word)), words)
        if os.path.lexists(word):
            advice = f"for the file of this name, give ./{word}"
            return f"expected an option of {self.prog}, found {word}; {advice}"
        flag = word.split("=")[0]
        meant = did_you_mean(flag, self._flags(), f"correct it; {see_help}")
        return f"expected an option of {self.prog}, found {flag}{meant}"


def _convert(flag: str, text: str, kind: Any) -> Any:
    """Convert the text of an option to its type; raise InputError if that is impossible."""
    item_kind = _item_kind_of(kind)
    if item_kind is not None:
        texts = list(filter(None, map(str.strip, text.split(","))))
        if not texts:
            raise InputError(
                f"{flag}: expected values with commas, found {shown(text)}; "
                "name some, or leave the option out"
            )
        return tuple(_convert(flag, item, item_kind) for item in texts)

    choices = literals(kind)
    if choices and text not in choices:
        raise InputError(
            f"{flag}: expected one of {', '.join(choices)}, found {shown(text)}"
            + did_you_mean(text, choices)
        )

    parts = list(_parts_of(kind))
    number = next((number for number in NUMBERS if number in parts), None)
    if number is None:
        return Path(text) if Path in parts else text
    try:
        value = number(text)
    except ValueError:
        value = math.nan
    if isinstance(value, float) and not math.isfinite(value):
        raise InputError(f"{flag}: expected {NUMBERS[number]}, found {shown(text)}; correct it")
    for allowed in parts:
        if isinstance(allowed, Range) and value not in allowed:
            raise InputError(
                f"{flag}: expected a number {allowed}, found {shown(text)}; correct it"
            )
    return value


def _item_kind_of(kind: Any) -> Any:
    """Return the type of the items if a type is a tuple or an optional tuple, else None."""
    for part in (kind, *get_args(kind)):
        if get_origin(part) is tuple:
            return get_args(part)[0]
    return None


def _parts_of(kind: Any) -> Iterator[Any]:
    """Yield a type and its parts; `Count | None` has int and a `Range` among its parts."""
    yield kind
    for part in get_args(kind):
        yield from _parts_of(part)


def literals(kind: Any) -> tuple[str, ...]:
    """Return the values of a Literal or of an optional Literal; no values for other types."""
    for part in (kind, *get_args(kind)):
        if get_origin(part) is Literal:
            return get_args(part)
    return ()


def make_parser(command: str, run: Callable[..., None]) -> Parser:
    """Return the parser of a command, without the values of a recipe.

    Args:
        run: the function that does the work. Its signature and its docstring define the arguments
            and the options. Positional-only parameters are arguments. A parameter of a dataclass
            type stands for a group of options. Each field of the dataclass is an option, and the
            text under the field is its help.
    """
    docs = docstring_parser.parse(run.__doc__ or "")
    texts = {param.arg_name: param.description or "" for param in docs.params}
    parser = Parser(prog=f"amvnet {command}", description=docs.short_description)

    metavars = []
    hints = get_type_hints(run, include_extras=True)
    for name, parameter in inspect.signature(run).parameters.items():
        kind = hints[name]
        if parameter.kind is parameter.POSITIONAL_ONLY:
            metavars.append(METAVARS.get(name, name.upper()))
            parser.kinds[name] = kind
            _add_argument(parser, name, kind, metavars[-1], texts[name])
        elif isinstance(kind, type) and dataclasses.is_dataclass(kind):
            group = parser.add_argument_group(first_line(kind))
            kinds = get_type_hints(kind, include_extras=True)
            field_docs = field_texts(kind)
            for field in dataclasses.fields(kind):
                parser.kinds[field.name] = kinds[field.name]
                _add_option(
                    group, field.name, kinds[field.name], field.default, field_docs[field.name]
                )
        else:
            parser.kinds[name] = kind
            _add_option(parser, name, kind, parameter.default, texts.get(name, ""))

    parser.usage = " ".join(["amvnet", command, *metavars, "[options]"])
    return parser


def run_with(run: Callable[..., None], values: Mapping[str, Any]) -> None:
    """Run a command with the values of its arguments and options by name."""
    hints = get_type_hints(run)
    arguments = []
    for name in inspect.signature(run).parameters:
        kind = hints[name]
        if name in values:  # also a recipe, although it is a dataclass
            arguments.append(values[name])
        else:
            own = {field.name: values[field.name] for field in dataclasses.fields(kind)}
            arguments.append(kind(**own))
    run(*arguments)


def _add_argument(parser: Parser, name: str, kind: Any, metavar: str, text: str) -> None:
    nargs = None
    if get_origin(kind) is list:
        nargs = "+"
    elif type(None) in get_args(kind):  # may be left out
        nargs = "?"
    parser.add_argument(name, nargs=nargs, metavar=metavar, help=text)


def _add_option(target: Any, name: str, kind: Any, default: Any, text: str) -> None:
    """Add one parameter of a command as an option to the parser, or to one of its groups."""
    options: dict[str, Any] = {"help": text.replace("%", "%%")}
    if default is inspect.Parameter.empty:
        options["required"] = True
        options["help"] += " (required)"
    else:
        options["default"] = ",".join(default) if isinstance(default, tuple) else default

    if kind is bool:
        options["action"] = "store_true"
    elif get_origin(kind) is list:  # an option that may be given several times
        options |= {"action": "append", "metavar": name.upper()}
    else:
        options["metavar"] = metavar_of(name, kind)
    target.add_argument(flag_of(name), **options)


def flag_of(name: str) -> str:
    """Return the name of a parameter's option, with dashes instead of underscores."""
    return "--" + name.replace("_", "-")


def metavar_of(name: str, kind: Any) -> str:
    """Return the word for an option's value in the help: its choices, or its name."""
    choices = literals(kind) if _item_kind_of(kind) is None else ()
    if choices:
        return "{" + ",".join(choices) + "}"
    return name.upper().replace("_", "-")


def first_line(documented: Any) -> str:
    """Return the first line of the docstring of a class or function, without its period."""
    return (documented.__doc__ or "").strip().splitlines()[0].rstrip(".")


def field_texts(cls: type) -> dict[str, str]:
    """Return the documentation under each field of a dataclass, on one line."""
    docs = docstring_parser.parse_from_object(cls)
    return {field.arg_name: " ".join((field.description or "").split()) for field in docs.params}


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
