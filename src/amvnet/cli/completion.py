"""A shell's completion of verbs, options and their values, made by shtab."""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
from typing import Any

from amvnet.cli.parser import Command, literals, make_parser
from amvnet.cli.recipe_options import add_recipe
from amvnet.config.recipes import recipe_names
from amvnet.config.schema import Recipe
from amvnet.errors import InputError

SHELLS = ("bash", "zsh", "fish", "tcsh")


def completion(verbs: Mapping[str, Command], shell: str) -> str:
    """Return the script that a shell reads to complete the command line.

    Raises:
        InputError: if there is no such shell, or shtab is not installed.
    """
    if shell not in SHELLS:
        raise InputError(
            f"expected a shell of {', '.join(SHELLS)}, found {shell!r}; write one of them"
        )
    try:
        import shtab
    except ImportError:
        raise InputError(
            "expected the package shtab for --completion, found none; "
            'run pip install "amvnet[completion]"'
        ) from None

    top = argparse.ArgumentParser("amvnet")
    parts = top.add_subparsers()
    for verb, command in verbs.items():
        parser = make_parser(verb, command)
        if command.takes_recipe:
            add_recipe(parser, Recipe())

        part = parts.add_parser(verb, help=parser.description)
        for flag, kind in parser.kinds.items():
            if kind is bool:
                part.add_argument(flag, action="store_true")
            else:
                _complete(part.add_argument(flag), literals(kind), shtab.FILE)
        for name in command.positional:
            names = recipe_names() if name == "recipe" else ()
            _complete(part.add_argument(name, nargs="*"), names, shtab.FILE)
    return str(shtab.complete(top, shell))


def _complete(action: Any, choices: Sequence[str], files: Any) -> None:
    """Complete the value of an argument: one of some names, or else a file."""
    if choices:
        action.choices = choices
    else:
        action.complete = files
