"""Imports go down only and in no circle; the pages name what there is."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator, Mapping
from functools import cache
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest

from fixtures.commands import not_none

ROOT = Path(__file__).parents[1]
SOURCE = ROOT / "src"
PAGE = (ROOT / "docs/architecture.md").read_text()
CONTRIBUTING = (ROOT / "CONTRIBUTING.md").read_text()

Graph = Mapping[str, set[str]]


@cache
def modules() -> dict[str, Path]:
    files = {
        ".".join(path.relative_to(SOURCE).with_suffix("").parts).removesuffix(".__init__"): path
        for path in SOURCE.rglob("*.py")
    }
    return files


@cache
def imports() -> Graph:
    """Return the modules that each module imports, also in functions, but not for types only."""
    graph = {}
    for name, path in modules().items():
        graph[name] = set(imported(ast.parse(path.read_text()))) & set(modules()) - {name}
    return graph


def imported(node: ast.AST) -> Iterator[str]:
    """Yield the names that a tree imports, of modules and of what is in them."""
    if isinstance(node, ast.If) and "TYPE_CHECKING" in ast.unparse(node.test):
        return
    if isinstance(node, ast.Import):
        yield from (alias.name for alias in node.names)
    elif isinstance(node, ast.ImportFrom):
        assert node.module is not None
        names = {f"{node.module}.{alias.name}" for alias in node.names}
        yield from names
        if not names <= set(modules()):
            yield node.module
    for child in ast.iter_child_nodes(node):
        yield from imported(child)


def levels() -> dict[str, int]:
    """Return the level of each package in the drawing of the page; 0 is the lowest."""
    drawing = not_none(re.search(r"## Import direction.*?```text\n(.*?)```", PAGE, re.S))
    heights = {}
    for level, line in enumerate(reversed(drawing[1].splitlines())):
        for name in line.split():
            heights[name] = level
    return heights


def package(module: str) -> str:
    """Return the name in the drawing of what a module belongs to."""
    top, *rest = module.split(".")
    return rest[0] if top == "amvnet" and rest else top


def inner(module: str) -> bool:
    """Return whether a module is within the drawing: the package itself and its entry are above."""
    return module not in ("amvnet", "amvnet.__main__")


# ---- imports


def test_imports_go_down_only() -> None:
    heights = levels()
    upward = set()
    for module, targets in imports().items():
        for target in filter(inner, targets):
            if not inner(module) or package(module) == package(target):
                continue
            is_single = 0 == heights[package(module)] == heights[package(target)]
            if heights[package(target)] >= heights[package(module)] and not is_single:
                upward.add((module, target))
    assert not upward


def test_no_imports_make_a_circle() -> None:
    try:
        TopologicalSorter(imports()).prepare()
    except CycleError as error:
        pytest.fail(" -> ".join(reversed(error.args[1])))


def test_the_simulator_knows_nothing_of_the_method() -> None:
    for module, targets in imports().items():
        if package(module) == "lidarstreets":
            assert {package(target) for target in targets} <= {"lidarstreets"}


# ---- pages


def test_the_page_lists_all_packages() -> None:
    table = not_none(re.search(r"## Packages\n(.*?)\n\nNext to", PAGE, re.S))
    rows = re.findall(r"^\| (.+?) \| (.+) \|$", table[1], re.M)[1:]
    packages = {name.strip("`") for name, _ in rows[:-1]}
    singles = set(re.findall(r"`(\w+)`", rows[-1][1]))

    folder = SOURCE / "amvnet"
    assert packages == {path.parent.name for path in folder.glob("*/__init__.py")}
    files = {path.stem for path in folder.glob("*.py")}
    assert singles == {name for name in files if not name.startswith("__")}
    assert packages | singles | {"lidarstreets"} == set(levels())


PATHS = r"`((?:src|tests|docs|benchmarks|data)/[\w./-]+)`"


@pytest.mark.parametrize("page", ["CONTRIBUTING.md", "docs/architecture.md"])
def test_the_files_that_a_page_names_exist(page: str) -> None:
    paths = re.findall(PATHS, (ROOT / page).read_text())
    assert paths
    for path in paths:
        if "NAME" not in path:  # of what is to be added
            assert (ROOT / path).exists() or (SOURCE / "amvnet" / path).exists(), path


def test_the_names_that_the_contributing_page_mentions_exist() -> None:
    mentions = re.findall(r"`(\w+)`\s+(?:of|in)\s+`([\w/]+\.py)`", CONTRIBUTING)
    assert len(mentions) > 3
    for name, path in mentions:
        file = ROOT / path if (ROOT / path).exists() else SOURCE / "amvnet" / path
        assert re.search(rf"^(?:class |def )?{name}\b", file.read_text(), re.M), (name, path)


def test_no_page_has_the_marks_of_a_conflict() -> None:
    for page in [*ROOT.glob("*.md"), *(ROOT / "docs").glob("*.md")]:
        assert not re.search(r"(?m)^(<<<<<<<|>>>>>>>) ", page.read_text(encoding="utf-8")), page
