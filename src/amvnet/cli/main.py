"""The command line: finds the verb, reads its arguments, and turns what goes wrong into one line and an exit code."""

from __future__ import annotations

import dataclasses
import os
import sys
import warnings
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from amvnet import __version__
from amvnet.cli.commands.ablate import ablate
from amvnet.cli.commands.analyze import analyze
from amvnet.cli.commands.bench import bench
from amvnet.cli.commands.demo import demo
from amvnet.cli.commands.evaluate import evaluate
from amvnet.cli.commands.export import export
from amvnet.cli.commands.fuse import fuse
from amvnet.cli.commands.info import info
from amvnet.cli.commands.predict import predict
from amvnet.cli.commands.rank import rank
from amvnet.cli.commands.simulate import simulate
from amvnet.cli.commands.submit import submit
from amvnet.cli.commands.train import train
from amvnet.cli.commands.view import view
from amvnet.cli.console import say
from amvnet.cli.parser import Parser, Positional, parser_of
from amvnet.errors import InputError, SomeBroken

if TYPE_CHECKING:
    from amvnet.config.schema import Recipe

DONE, FAILED, WRONG_INPUT, SOME_BROKEN = 0, 1, 2, 3
SHARED = ("train", "predict", "evaluate", "ablate")  # the verbs that several processes can share

VERBS: dict[str, tuple[Callable[..., None], Positional]] = {
    "demo": (demo, {}),
    "simulate": (simulate, {"out": {"metavar": "OUT", "type": Path}}),
    "train": (train, {"recipe": {"metavar": "RECIPE"}}),
    "predict": (predict, {"inputs": {"metavar": "INPUT", "nargs": "+"}}),
    "evaluate": (evaluate, {"data": {"metavar": "DATA"}}),
    "submit": (submit, {"data": {"metavar": "DATA"}}),
    "fuse": (fuse, {"inputs": {"metavar": "INPUT", "nargs": "+"}}),
    "rank": (rank, {"data": {"metavar": "DATA"}}),
    "analyze": (analyze, {"data": {"metavar": "DATA"}}),
    "ablate": (ablate, {"recipe": {"metavar": "RECIPE"}}),
    "export": (export, {}),
    "view": (view, {"inputs": {"metavar": "INPUT", "nargs": "+"}}),
    "bench": (bench, {}),
    "info": (info, {"weights": {"metavar": "W", "nargs": "?"}}),
}


def _parser(verb: str, recipe: Recipe | None = None) -> Parser:
    return parser_of(verb, *VERBS[verb], recipe)


def _with_recipe(verb: str, arguments: Sequence[str]) -> dict[str, Any]:
    """The arguments of a verb that takes a recipe: read once to find it, and once more with its values as defaults."""
    from amvnet.config.recipes import load_recipe
    from amvnet.config.schema import Recipe

    if {"-h", "--help"} & set(arguments):
        recipe = Recipe() if arguments[0].startswith("-") else load_recipe(arguments[0])
    else:
        recipe = load_recipe(_parser(verb, Recipe()).parse_args(list(arguments)).recipe)
    parser = _parser(verb, recipe)
    made = vars(parser.instantiate(parser.parse_args(list(arguments))))
    return made | {
        "recipe": dataclasses.replace(
            recipe, model=made.pop("model"), training=made.pop("training")
        )
    }


USAGE = f"""usage: amvnet VERB ...

  demo       simulate, segment, score, draw: the first thing to run
  simulate   write labelled scans of simulated streets
  train      train the networks and the point head
  predict    segment scans
  evaluate   score weights or predictions by the official formulas
  submit     pack or check predictions for a benchmark's server
  fuse       fuse the scores of any two models
  rank       what to label next, and which labels look wrong
  analyze    the paper's figures, sweeps and tables
  ablate     the paper's ablation of the range-view network
  export     the networks as ONNX, for C++ and TensorRT
  view       look at scans, labels and errors in 3D
  bench      time per stage on this machine
  info       what a weights file is, or what is installed

`amvnet VERB --help` says more. Version {__version__}."""


def main(argv: Sequence[str] | None = None) -> int:
    """Run one verb; returns the exit code: 0 done, 2 the input is wrong, 3 some of many inputs are, 1 anything else."""
    arguments = list(sys.argv[1:] if argv is None else argv)
    if not arguments or arguments[0] in ("-h", "--help"):
        say(USAGE)
        return DONE if arguments else WRONG_INPUT
    if arguments[0] == "--version":
        say(__version__)
        return DONE
    try:
        run(arguments[0], arguments[1:])
    except InputError as error:
        print(f"amvnet: {error}", file=sys.stderr)
        return WRONG_INPUT
    except SomeBroken as error:
        for fault in error.faults:
            print(f"amvnet: {fault}", file=sys.stderr)
        print(f"amvnet: {error}", file=sys.stderr)
        return SOME_BROKEN
    except OSError as error:  # a full disk, say; what was there before is still whole
        print(
            f"amvnet: {error.filename or 'the disk'}: {error.strerror}; mend this and go on",
            file=sys.stderr,
        )
        return FAILED
    except KeyboardInterrupt:
        print("amvnet: interrupted", file=sys.stderr)
        return FAILED
    return DONE


def run(verb: str, arguments: Sequence[str]) -> None:
    """Run one verb.

    Raises:
        InputError: where the verb, its arguments or what they name cannot be used.
    """
    if verb not in VERBS:
        raise InputError(
            f"expected a verb of {', '.join(VERBS)}, found {verb!r}; see amvnet --help"
        )
    _quiet()
    if verb not in SHARED and _several():
        raise InputError(
            f"expected {', '.join(SHARED)} for several processes, found {verb}; run it in one"
        )
    takes_recipe = "recipe" in VERBS[verb][1]
    call = (
        _with_recipe(verb, arguments)
        if takes_recipe
        else vars(_parser(verb).parse_args(list(arguments)))
    )
    VERBS[verb][0](**call)


def _several() -> bool:
    """Whether torchrun or SLURM has started several processes."""
    if not {"WORLD_SIZE", "SLURM_STEP_ID"} & set(os.environ):
        return False
    from amvnet.distributed import started

    return started() > 1


def _quiet() -> None:
    """Keep the notes that libraries have for their developers from our users."""
    warnings.filterwarnings("ignore", module="lightning")
    warnings.filterwarnings("ignore", module="torch")


if __name__ == "__main__":
    sys.exit(main())
