"""Measure how densely Python code is written, for one or more folders.

    python benchmarks/readability.py src/amvnet [OTHER ...]

Print for each folder, over all of its modules:

- functions with more than six parameters, and per thousand functions;
- calls with more than five positional arguments, per thousand lines;
- blank lines as a share of the lines of function bodies;
- lines of more than 100 characters, as a share of all lines that are not blank;
- assignments to several names at once (`a, b = 1, 2`), per thousand lines;
- comprehensions and generator expressions, per thousand lines.

A line of code is one that is not blank.
"""

from __future__ import annotations

import argparse
import ast
from dataclasses import dataclass, fields
from pathlib import Path

MOST_PARAMETERS = 6
MOST_POSITIONAL = 5
LONGEST_LINE = 100

Function = ast.FunctionDef | ast.AsyncFunctionDef
COMPREHENSIONS = (ast.ListComp, ast.SetComp, ast.DictComp, ast.GeneratorExp)


@dataclass
class Counts:
    """What was counted in some modules."""

    lines: int = 0
    characters: int = 0
    functions: int = 0
    many_parameters: int = 0
    many_positional: int = 0
    body_lines: int = 0
    blank_body_lines: int = 0
    long_lines: int = 0
    tuple_assignments: int = 0
    comprehensions: int = 0

    def __add__(self, other: Counts) -> Counts:
        return Counts(*(getattr(self, f.name) + getattr(other, f.name) for f in fields(self)))


def count_module(text: str) -> Counts:
    """Count one module, given its source."""
    lines = text.splitlines()
    filled = [line for line in lines if line.strip()]

    counts = Counts(lines=len(filled))
    counts.characters = sum(len(line) for line in filled)
    counts.long_lines = sum(len(line) > LONGEST_LINE for line in filled)

    in_body: set[int] = set()
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, Function):
            counts.functions += 1
            counts.many_parameters += _parameters(node) > MOST_PARAMETERS
            in_body.update(_body_lines(node))
        elif isinstance(node, ast.Call):
            counts.many_positional += len(node.args) > MOST_POSITIONAL
        elif isinstance(node, ast.Assign):
            counts.tuple_assignments += _pairs_up(node)
        elif isinstance(node, COMPREHENSIONS):
            counts.comprehensions += 1

    counts.body_lines = len(in_body)
    counts.blank_body_lines = sum(not lines[number - 1].strip() for number in in_body)
    return counts


def _parameters(function: Function) -> int:
    arguments = function.args
    names = [a.arg for a in (*arguments.posonlyargs, *arguments.args, *arguments.kwonlyargs)]
    return len([name for name in names if name not in ("self", "cls")])


def _body_lines(function: Function) -> range:
    """Return the numbers of the lines of a function's body, its docstring left out."""
    body = function.body
    if ast.get_docstring(function, clean=False) is not None:
        body = body[1:]
    if not body:
        return range(0)
    return range(body[0].lineno, (body[-1].end_lineno or body[-1].lineno) + 1)


def _pairs_up(node: ast.Assign) -> bool:
    """Return whether several values are assigned to several names, as in `a, b = 1, 2`."""
    is_tuple = isinstance(node.targets[0], ast.Tuple)
    return is_tuple and isinstance(node.value, ast.Tuple)


def count_folder(folder: Path) -> Counts:
    """Count all modules below a folder."""
    counts = Counts()
    for path in sorted(folder.rglob("*.py")):
        counts += count_module(path.read_text(encoding="utf-8"))
    return counts


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folders", nargs="+", type=Path)

    for folder in parser.parse_args().folders:
        counts = count_folder(folder)
        thousand = counts.lines / 1000
        figures = [
            f"{counts.lines} lines",
            f"functions over {MOST_PARAMETERS} parameters: {counts.many_parameters}"
            f" ({1000 * counts.many_parameters / max(counts.functions, 1):.0f} per 1000)",
            f"calls over {MOST_POSITIONAL} positional: {counts.many_positional / thousand:.1f}",
            f"blank lines in bodies: {counts.blank_body_lines / max(counts.body_lines, 1):.1%}",
            f"lines over {LONGEST_LINE}: {counts.long_lines / counts.lines:.1%}",
            f"tuple assignments: {counts.tuple_assignments / thousand:.1f}",
            f"comprehensions: {counts.comprehensions / thousand:.1f}",
            f"mean line: {counts.characters / counts.lines:.0f}",
        ]
        print(f"{folder}: {'; '.join(figures)}")


if __name__ == "__main__":
    main()
