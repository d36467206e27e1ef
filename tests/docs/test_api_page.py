"""The page on the Python API names every public name with its signature, and its examples run."""

from __future__ import annotations

import inspect
import re
from importlib import import_module
from pathlib import Path
from typing import Any

import pytest

import amvnet

PAGE = (Path(__file__).parents[2] / "docs/api.md").read_text(encoding="utf-8")
SIGNATURES = dict(re.findall(r"### `([\w.]+)`\n+```py\n(.*?)```", PAGE, re.S))


def resolve(name: str) -> Any:
    """Return the object with a dotted name; the first words name its module."""
    words = name.split(".")
    for split in range(len(words), 0, -1):
        try:
            found: Any = import_module(".".join(words[:split]))
        except ModuleNotFoundError:
            continue
        for word in words[split:]:
            found = getattr(found, word)
        return found
    raise LookupError(name)


def written(name: str) -> str:
    """Return the signature of a public object as the page should write it."""
    parts = []
    for parameter in inspect.signature(resolve(name)).parameters.values():
        if parameter.name == "self":
            continue
        if parameter.kind is parameter.KEYWORD_ONLY and "*" not in parts:
            parts.append("*")
        default = parameter.default
        text = f"{parameter.name}: {parameter.annotation}"
        if default is not parameter.empty:
            made = callable(default) or repr(default) == "<factory>"
            text += " = ..." if made else f" = {default!r}"
        parts.append(text)
    returned = inspect.signature(resolve(name)).return_annotation
    return f"{name}({', '.join(parts)}) -> {returned}"


def plain(signature: str) -> str:
    """Return a signature without what formatting changes: spaces, quotes, the last comma."""
    return re.sub(r"\s+|,(?=\s*\))", "", signature).replace("'", '"')


@pytest.mark.parametrize("name", SIGNATURES)
def test_every_signature_is_that_of_the_code(name: str) -> None:
    assert plain(SIGNATURES[name]) == plain(written(name))


def test_every_public_name_is_on_the_page() -> None:
    headings = re.findall(r"### `([\w.]+)`", PAGE)
    methods = [name for name, value in vars(amvnet.Segmenter).items() if inspect.isfunction(value)]
    public = [f"Segmenter.{name}" for name in methods if not name.startswith("_")]
    expected = {f"amvnet.{name}" for name in [*amvnet.__all__, *public]}
    assert expected <= set(headings)


def test_the_examples_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("embreex")
    pushed: list[str] = []
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(amvnet, "push", lambda weights, name, **_: pushed.append(name), False)
    scope: dict[str, Any] = {}
    for block in re.findall(r"```python\n(.*?)```", PAGE, re.S):
        exec(block, scope)
    assert scope["result"].labels.shape == (len(scope["points"]),)
    assert pushed == ["me/amvnet"]
