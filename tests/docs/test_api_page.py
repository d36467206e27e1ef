"""The page on the Python API names every public name, and its examples run."""

from __future__ import annotations

import re
from pathlib import Path
from types import SimpleNamespace

import pytest

import amvnet
from amvnet.cli.main import COMMANDS

from fixtures.pages import DocsPage, execute, load_script

DOCS = Path(__file__).parents[2] / "docs"
PAGE = DocsPage("docs/api.md")


def test_every_public_name_is_on_the_page() -> None:
    assert {f"amvnet.{name}" for name in amvnet.__all__} <= set(
        re.findall(r"::: ([\w.]+)", PAGE.text)
    )


@pytest.mark.full
def test_the_examples_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("embreex")
    pushed: list[str] = []
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("webbrowser.open", lambda url: None)
    monkeypatch.setattr(amvnet, "push", lambda weights, name, **_: pushed.append(name), False)

    variables = execute(PAGE.blocks("python"))
    assert variables["result"].labels.shape == (len(variables["scan"].points),)
    assert pushed == ["me/amvnet"]


def test_the_site_has_the_help_of_every_command() -> None:
    hook = load_script("docs/command_line.py")
    written = (DOCS / hook.PAGE).read_text(encoding="utf-8")
    built = hook.on_page_markdown(written, SimpleNamespace(file=SimpleNamespace(src_uri=hook.PAGE)))

    assert re.findall(r"## amvnet (\w+)", built) == list(COMMANDS)
    for command in COMMANDS:
        assert f"usage: amvnet {command}" in built
