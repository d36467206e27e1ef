"""The pages use commands and options that exist, and name all extras."""

from __future__ import annotations

import re
import tomllib
from functools import cache
from pathlib import Path

import pytest

from amvnet.cli.main import COMMANDS, WITH_RECIPE
from amvnet.cli.parser import HELP_ALL, Parser, add_recipe, make_parser
from amvnet.config.schema import Recipe

from fixtures.pages import DocsPage

ROOT = Path(__file__).parents[2]
PAGES = ("README.md", *sorted(f"docs/{path.name}" for path in (ROOT / "docs").glob("*.md")))


@cache
def parser_of(command: str) -> Parser:
    parser = make_parser(command, COMMANDS[command])
    if command in WITH_RECIPE:
        add_recipe(parser, Recipe())
    return parser


@pytest.mark.parametrize("page", PAGES)
def test_every_command_can_be_parsed(page: str) -> None:
    for words in DocsPage(page).commands:
        if "amvnet" not in words[:-1]:  # not cd amvnet
            continue
        command, *arguments = words[words.index("amvnet") + 1 :]
        if command.startswith("--") or arguments[-1:] in (["--help"], [HELP_ALL]):
            continue
        parser_of(command).values(arguments)


@pytest.mark.parametrize("page", ["README.md", "docs/installation.md"])
def test_the_readme_and_the_page_on_the_installation_name_every_extra(page: str) -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    text = (ROOT / page).read_text()
    for extra in project["optional-dependencies"]:
        assert f"`{extra}`" in text


def test_the_page_on_the_installation_has_the_extras_of_the_makefile_and_its_lines() -> None:
    makefile = (ROOT / "Makefile").read_text()
    page = DocsPage("docs/installation.md").text
    (extras,) = re.findall(r"(?m)^EXTRAS \?= (.*)", makefile)
    assert re.findall(r"(?m)^\| `(\w+)` \| .* \| yes \|$", page) == extras.split(",")
    for line in re.findall(r'@echo "(installing (?:PyTorch|amvnet) .*)"', makefile):
        assert f"    {line}\n" in page


def test_the_first_screen_of_the_readme_needs_no_word_of_the_method() -> None:
    screen = "\n".join((ROOT / "README.md").read_text().splitlines()[:60])
    words = r"RV|BEV|ensembles?|range|bird|heads?|tau|fus\w+|projections?|mIoU|IoU|\d{4}-\d\d"
    assert re.findall(rf"\b({words})\b", screen) == []
    for command in (
        "git clone",
        "make install",
        "amvnet predict scan.bin",
        "make demo",
        "make test",
    ):
        assert re.search(rf"(?m)^{command}\b", screen)
    assert "source .venv/bin/activate" in screen
    assert screen.index("docs/figures/viewer.webp") < screen.index("git clone")
    assert "http://localhost:8000/try/" in screen


def test_the_readme_is_short() -> None:
    assert len((ROOT / "README.md").read_text().split()) <= 1100


def test_the_page_in_the_browser_has_less_than_1800_lines_of_code() -> None:
    lines: list[str] = []
    for path in (ROOT / "web").rglob("*.js"):
        if "node_modules" not in path.parts:
            lines += path.read_text().splitlines()
    code = [line for line in lines if line.strip() and not re.match(r"\s*(//|/?\*)", line)]
    assert len(code) < 1800
