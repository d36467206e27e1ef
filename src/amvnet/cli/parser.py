"""Make the parser of a verb from the signature and the docstring of its function."""

from __future__ import annotations

import argparse
import ast
import dataclasses
import functools
import inspect
import re
import sys
from argparse import BooleanOptionalAction
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, Literal, NoReturn, get_args, get_origin, get_type_hints

import docstring_parser
from jsonargparse import ArgumentParser

from amvnet.cli.console import say_lines
from amvnet.errors import InputError, did_you_mean, shown

# The groups of a verb's options in its help; the others come before them.
GROUPS: dict[str, tuple[str, ...]] = {
    "which scans": (
        "split",
        "sequences",
        "train_sequences",
        "val_sequences",
        "with_val",
        "topic",
        "scans",
    ),
    "scan files": (
        "columns",
        "dtype",
        "sensor",
        "height",
        "intensity_scale",
        "unit",
        "axes",
        "rotate",
        "offset",
    ),
    "scores of two other models": ("scores_a", "scores_b", "key_a", "key_b", "logits"),
    "how it is computed": ("device", "engine", "precision", "batch", "at_once", "ray", "workers"),
}
# What a value of a type is called.
TYPE_WORDS = {int: "a whole number", float: "a number"}
NEGATIVE = re.compile(r"-\.?\d")  # the beginning of a value that argparse takes for an option


@dataclass(frozen=True)
class Parameter:
    """One parameter of a verb: an argument or an option of the command line.

    Attributes:
        name: as in Python, with underscores.
        kind: its type.
        default: its default value, or `inspect.Parameter.empty`.
        text: its help.
    """

    name: str
    kind: Any
    default: Any
    text: str


@dataclass(frozen=True)
class Command:
    """One verb of the command line.

    Attributes:
        run: does the work; its signature and docstring define the options. A parameter that is a
            dataclass stands for an option per field, with the line under the field as its help.
        positional: the parameters that are positional on the command line, and for each the
            keyword arguments of argparse's `add_argument`.
    """

    run: Callable[..., None]
    positional: Mapping[str, dict[str, Any]]

    @property
    def takes_recipe(self) -> bool:
        """Whether a recipe is an argument, and each of its values an option."""
        return "recipe" in self.positional

    @property
    def can_resume(self) -> bool:
        """Whether it has the option --resume."""
        return "resume" in inspect.signature(self.run).parameters


class HelpFormatter(argparse.HelpFormatter):
    """Writes help texts without types, and a default unless the text has one."""

    def __init__(self, prog: str) -> None:
        super().__init__(prog, max_help_position=30)

    def _get_help_string(self, action: argparse.Action) -> str:
        text = action.help or ""
        has_no_default = action.default in (None, False, argparse.SUPPRESS, inspect.Parameter.empty)
        if action.required or has_no_default or "default:" in text or not action.option_strings:
            return text
        return f"{text} (default: %(default)s)"


class Parser(ArgumentParser):
    """A parser that raises an InputError of one line instead of printing its usage."""

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, formatter_class=HelpFormatter, **kwargs)
        self.kinds: dict[str, Any] = {}  # types of the options' values, by flag

    def error(self, message: str, ex: Exception | None = None) -> NoReturn:
        line = self._in_words(" ".join(message.split()) or str(ex))
        raise InputError(line if line.endswith("?") else f"{line}; see {self.prog} --help")

    def print_help(self, file: Any = None) -> None:
        say_lines(self.format_help().rstrip())

    def _in_words(self, line: str) -> str:
        """Return what a message of jsonargparse or argparse says, in the words of this project."""
        unknown = re.match(r"unrecognized arguments: (.*)", line, re.IGNORECASE)
        if unknown is not None:
            return self._unknown_words(unknown[1])

        missing = re.match(r"the following arguments are required: (.*)", line)
        if missing is not None:
            names = missing[1].split(", ")
            flags = [flag_of(name) if flag_of(name) in self.kinds else name for name in names]
            return f"expected {', '.join(flags)}, found none; add what is missing"

        wrong = re.match(r'Parser key "([\w.-]+)"', line)
        values = re.findall(r"(?:Got|Given) value: (\S+)|value has (\d+ digits)", line)
        if wrong is None or not values or flag_of(wrong[1]) not in self.kinds:
            return line
        flag = flag_of(wrong[1])
        kind = self.kinds[flag]
        value, digits = values[-1]
        found = f"one of {digits}" if digits else shown(value)
        similar = did_you_mean(value, literals(kind))
        return f"{flag}: expected {expected_words(kind)}, found {found}{similar}"

    def _unknown_words(self, words: str) -> str:
        word = words.split()[0]
        if not word.startswith("-"):
            return f"expected nothing more, found {words}; leave it out"
        flag = word.split("=")[0]
        flags = [known for known in self.kinds if known.startswith("--")]
        return f"expected an option of {self.prog}, found {flag}{did_you_mean(flag, flags)}"


def flag_of(name: str) -> str:
    """Return the option of a parameter, with dashes instead of underscores."""
    return "--" + name.replace("_", "-")


def literals(kind: Any) -> tuple[str, ...]:
    """Return the values of a Literal, also of an optional one; none of any other type."""
    if get_origin(kind) is Literal:
        return get_args(kind)
    for part in get_args(kind):
        if get_origin(part) is Literal:
            return get_args(part)
    return ()


def expected_words(kind: Any) -> str:
    """Return what a value of a type is called: "a number", or the values to choose from."""
    choices = literals(kind)
    if choices:
        return f"one of {', '.join(choices)}"
    for part in (kind, *get_args(kind)):
        if part in TYPE_WORDS:
            return TYPE_WORDS[part]
    return "another value"


def make_parser(verb: str, command: Command) -> Parser:
    """Return the parser of a verb, without the values of a recipe."""
    parameters = _parameters_of(command.run)
    metavars = [str(options["metavar"]) for options in command.positional.values()]
    parser = Parser(
        prog=f"amvnet {verb}",
        usage=" ".join(["amvnet", verb, *metavars, "[options]"]),
        description=docstring_parser.parse(command.run.__doc__ or "").short_description,
        allow_abbrev=False,
    )

    for name, options in command.positional.items():
        parser.add_argument(name, help=parameters[name].text, **options)

    grouped = {name: title for title, names in GROUPS.items() for name in names}
    groups: dict[str, Any] = {}
    for name, parameter in sorted(parameters.items(), key=lambda item: item[0] in grouped):
        if name in command.positional:
            continue
        title = grouped.get(name)
        if title is not None and title not in groups:
            groups[title] = parser.add_argument_group(title)
        target = parser if title is None else groups[title]
        _add_option(target, parameter)
        parser.kinds[flag_of(name)] = parameter.kind
    return parser


def _parameters_of(run: Callable[..., None]) -> dict[str, Parameter]:
    """Return the parameters of a verb by name, with the fields of those that are dataclasses."""
    docs = docstring_parser.parse(run.__doc__ or "")
    texts = {param.arg_name: param.description or "" for param in docs.params}
    hints = get_type_hints(run)

    parameters = {}
    for name, parameter in inspect.signature(run).parameters.items():
        kind = hints[name]
        if not _is_bundle(kind):
            parameters[name] = Parameter(name, kind, parameter.default, texts.get(name, ""))
            continue
        kinds = get_type_hints(kind)
        texts_of_fields = field_texts(kind)
        for field in dataclasses.fields(kind):
            text = " ".join(texts_of_fields[field.name].split())
            parameters[field.name] = Parameter(field.name, kinds[field.name], field.default, text)
    return parameters


def run_with(run: Callable[..., None], values: Mapping[str, Any]) -> None:
    """Run a verb with the values of its options, some of which are fields of dataclasses."""
    hints = get_type_hints(run)
    arguments = {}
    for name in inspect.signature(run).parameters:
        kind = hints[name]
        if _is_bundle(kind):
            own = {field.name: values[field.name] for field in dataclasses.fields(kind)}
            arguments[name] = kind(**own)
        else:
            arguments[name] = values[name]
    run(**arguments)


def _is_bundle(kind: Any) -> bool:
    """Return whether a type is a dataclass, whose fields are options."""
    return isinstance(kind, type) and dataclasses.is_dataclass(kind)


def _add_option(target: Any, parameter: Parameter) -> None:
    """Add one parameter of a verb as an option to the parser, or to a group of it."""
    flag = flag_of(parameter.name)
    kind = parameter.kind
    options: dict[str, Any] = {"help": parameter.text.replace("%", "%%")}
    if parameter.default is inspect.Parameter.empty:
        options["required"] = True
        options["help"] += " (required)"
    else:
        options["default"] = parameter.default

    if kind is bool:
        options["action"] = BooleanOptionalAction if parameter.default else "store_true"
    elif get_origin(kind) is list:  # may be given several times
        options |= {"action": "append", "metavar": flag[2:].upper()}
    elif kind == str | bool:  # its value may be left out
        options |= {"nargs": "?", "const": True, "metavar": "ADDRESS"}
    else:
        options |= {"type": kind, "metavar": metavar_of(parameter.name, kind)}
    target.add_argument(flag, **options)


def metavar_of(name: str, kind: Any) -> str:
    """Return what stands for an option's value in the help: its choices, or its name."""
    choices = literals(kind)
    if choices:
        return "{" + ",".join(choices) + "}"
    return name.upper().replace("_", "-")


def join_negative_values(arguments: Sequence[str]) -> list[str]:
    """Join options and values such as -1,0,0, which argparse takes for an option.

    Returns:
        The arguments, with `--offset -1,0,0` as `--offset=-1,0,0`.
    """
    joined: list[str] = []
    for word in arguments:
        follows_option = bool(joined) and joined[-1].startswith("--") and "=" not in joined[-1]
        if follows_option and NEGATIVE.match(word):
            joined[-1] += f"={word}"
        else:
            joined.append(word)
    return joined


def field_texts(cls: type) -> dict[str, str]:
    """Return the line of documentation under each field of a dataclass."""
    texts: dict[str, str] = {}
    for field, text in pairwise(_class_bodies(cls.__module__)[cls.__name__]):
        if isinstance(field, ast.AnnAssign) and isinstance(text, ast.Expr):
            texts[field.target.id] = text.value.value  # type: ignore[attr-defined,union-attr]
    return texts


@functools.cache
def _class_bodies(module: str) -> dict[str, list[ast.stmt]]:
    """Return the statements of each class of a module, by name."""
    tree = ast.parse(inspect.getsource(sys.modules[module]))
    return {node.name: node.body for node in tree.body if isinstance(node, ast.ClassDef)}
