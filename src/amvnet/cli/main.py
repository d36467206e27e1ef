"""Run the command line: find the command, parse its arguments, and turn errors into one line."""

from __future__ import annotations

import os
import sys
import warnings
from collections.abc import Callable, Sequence
from importlib.metadata import version
from typing import Any

from amvnet.cli.commands.ablate import ablate
from amvnet.cli.commands.adapt import adapt
from amvnet.cli.commands.analyze import analyze
from amvnet.cli.commands.bench import bench
from amvnet.cli.commands.check import check
from amvnet.cli.commands.demo import demo
from amvnet.cli.commands.evaluate import evaluate
from amvnet.cli.commands.export import export
from amvnet.cli.commands.fleet import fleet
from amvnet.cli.commands.fuse import fuse
from amvnet.cli.commands.info import info
from amvnet.cli.commands.list import list as list_names
from amvnet.cli.commands.map import map as map_drive
from amvnet.cli.commands.predict import predict
from amvnet.cli.commands.rank import rank
from amvnet.cli.commands.simulate import simulate
from amvnet.cli.commands.submit import submit
from amvnet.cli.commands.train import train
from amvnet.cli.commands.view import view
from amvnet.cli.console import report, report_fault, report_lines, stdout
from amvnet.cli.parser import HELP_ALL, add_recipe, first_line, make_parser, run_with, with_options
from amvnet.cli.stopping import stoppable
from amvnet.config.recipes import load_recipe
from amvnet.config.schema import Recipe
from amvnet.errors import InputError, SomeBroken, did_you_mean, memory_for
from amvnet.runtime.threads import wait_passively

# The functions of the commands by what they are for, in the order of the help.
GROUPS: dict[str, tuple[Callable[..., None], ...]] = {
    "label": (predict, map_drive, fuse, fleet),
    "look": (demo, view, list_names, info),
    "score": (evaluate, analyze, rank, submit),
    "train": (train, adapt, ablate),
    "data": (simulate, check),
    "deploy": (export, bench),
}
COMMANDS = {function.__name__: function for group in GROUPS.values() for function in group}
WITH_RESUME = ("train", "adapt", "map", "predict", "fleet")  # commands that have --resume
CONTINUED_WHEN_REPEATED = ("simulate", "ablate")  # commands that keep results of an earlier call
WITH_PROCESSES = ("train", "evaluate", "ablate")  # commands whose work several processes can share
WITH_RECIPE = ("train", "ablate")  # commands whose options are also the values of a recipe

# Exit codes.
DONE = 0
FAILED = 1
WRONG_INPUT = 2
SOME_BROKEN = 3


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line, and print an error as one line to stderr.

    Args:
        argv: the command and its arguments. By default, they are the arguments of this process.

    Returns:
        The exit code: 0 if the work is done, 2 if the input is wrong, 3 if some of the inputs are
        broken and the others are done, 130 after Ctrl-C, 143 after SIGTERM, and 1 after any other
        error, such as a full disk.
    """
    arguments = list(sys.argv[1:] if argv is None else argv)
    wait_passively()
    try:
        with stoppable(_line_when_stopped(arguments), exits=argv is None) as stop:
            try:
                code = _run_and_explain(arguments)
            except BaseException:  # libraries turn an interruption into exceptions of their own
                if stop.signal is None:
                    raise
            return code if stop.signal is None else stop.end()
    finally:
        stdout.flush()  # because the interpreter's own flush at the end could fail


def _usage() -> str:
    """Return the help of `amvnet`: what each command does."""
    lines = ["usage: amvnet COMMAND ..."]
    for title, functions in GROUPS.items():
        lines += ["", f"{title}:"]
        for function in functions:
            lines.append(f"  {function.__name__:<10} {first_line(function)}")
    more = f"`amvnet COMMAND --help` says more. Version {version('amvnet')}."
    return "\n".join([*lines, "", more])


def _line_when_stopped(arguments: Sequence[str]) -> str:
    """Return the line to print if the command is stopped; it tells how to continue."""
    command = arguments[0] if arguments else ""
    if command in WITH_RESUME:
        return "stopped; go on with --resume"
    if command in CONTINUED_WHEN_REPEATED:
        return "stopped; start it again to go on"
    return "stopped"


def _run_and_explain(arguments: Sequence[str]) -> int:
    """Run the command line, print its errors, and return the exit code."""
    if not arguments or arguments[0] in ("-h", "--help"):
        report_lines(_usage())
        return DONE if arguments else WRONG_INPUT
    if arguments[0] == "--version":
        report(version("amvnet"))
        return DONE

    try:
        with memory_for(f"amvnet {arguments[0]}"):
            run(arguments[0], arguments[1:])
    except InputError as error:
        report_fault(str(error))
        return WRONG_INPUT
    except SomeBroken as error:
        for fault in error.faults:
            report_fault(fault)
        report_fault(str(error))
        return SOME_BROKEN
    except OSError as error:  # for example a full disk
        # Some libraries raise an error without a file name or a text.
        place = error.filename or "the disk"
        report_fault(f"{place}: {error.strerror or error}; fix this and run it again")
        return FAILED
    return DONE


def run(command: str, arguments: Sequence[str]) -> None:
    """Run one command.

    Raises:
        InputError: if the command, its arguments, or the files that they name cannot be used.
        SomeBroken: if some of several scans are broken.
    """
    if command not in COMMANDS:
        raise InputError(
            f"expected a command of amvnet, found {command!r}"
            + did_you_mean(command, COMMANDS, "see amvnet --help")
        )
    if command not in WITH_PROCESSES and _has_several_processes():
        raise InputError(
            f"expected one of {', '.join(WITH_PROCESSES)} for several processes, found {command}; "
            "run it in one process"
        )

    _set_warnings()
    if command in WITH_RECIPE:
        values = _parse_with_recipe(command, arguments)
    else:
        values = make_parser(command, COMMANDS[command]).values(arguments)
    run_with(COMMANDS[command], values)


def _parse_with_recipe(command: str, arguments: Sequence[str]) -> dict[str, Any]:
    """Parse the arguments of a command with a recipe, whose values its options replace."""
    # The help shows the values of the recipe that is named, or else the values of the paper.
    asks_for_help = bool({"-h", "--help", HELP_ALL} & set(arguments))
    names_recipe = bool(arguments) and not arguments[0].startswith("-")
    in_help = load_recipe(arguments[0]) if asks_for_help and names_recipe else Recipe()

    parser = make_parser(command, COMMANDS[command])
    add_recipe(parser, in_help, shows_all=HELP_ALL in arguments)
    values = parser.values(arguments)
    values["recipe"] = with_options(load_recipe(values["recipe"]), values)
    return values


def _has_several_processes() -> bool:
    if not {"WORLD_SIZE", "SLURM_STEP_ID"} & set(os.environ):
        return False
    from amvnet.runtime.distributed import started  # imports torch

    return started() > 1


def _set_warnings() -> None:
    """Print warnings in one line; suppress those of libraries, which are meant for developers."""
    warnings.formatwarning = lambda message, *_, **__: f"warning: {message}\n"
    warnings.filterwarnings("ignore", module="lightning")
    warnings.filterwarnings("ignore", module="torch")
    # Python's process that tracks semaphores warns if a command was stopped at once.
    os.environ.setdefault("PYTHONWARNINGS", "ignore:resource_tracker")


if __name__ == "__main__":
    sys.exit(main())
