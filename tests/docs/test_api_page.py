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
    for length in range(len(words), 0, -1):
        try:
            value: Any = import_module(".".join(words[:length]))
        except ModuleNotFoundError:
            continue
        for word in words[length:]:
            value = getattr(value, word)
        return value
    raise LookupError(name)


def expected_signature(name: str) -> str:
    """Return the signature of a public object as the page should write it."""
    signature = inspect.signature(resolve(name))
    parts = []
    for parameter in signature.parameters.values():
        if parameter.name == "self":
            continue
        if parameter.kind is parameter.KEYWORD_ONLY and "*" not in parts:
            parts.append("*")
        parts.append(f"{parameter.name}: {parameter.annotation}{default_text(parameter)}")
    return f"{name}({', '.join(parts)}) -> {signature.return_annotation}"


def default_text(parameter: inspect.Parameter) -> str:
    """Return how the page writes a parameter's default, with the sign of equality."""
    default = parameter.default
    if default is parameter.empty:
        return ""
    if callable(default) or repr(default) == "<factory>":
        return " = ..."
    return f" = {default!r}"


def normalized(signature: str) -> str:
    """Return a signature without spaces and the last comma, with double quotes."""
    return re.sub(r"\s+|,(?=\s*\))", "", signature).replace("'", '"')


@pytest.mark.parametrize("name", SIGNATURES)
def test_every_signature_is_that_of_the_code(name: str) -> None:
    assert normalized(SIGNATURES[name]) == normalized(expected_signature(name))


def test_every_public_name_is_on_the_page() -> None:
    expected = {f"amvnet.{name}" for name in amvnet.__all__}
    for name, value in vars(amvnet.Segmenter).items():
        if inspect.isfunction(value) and not name.startswith("_"):
            expected.add(f"amvnet.Segmenter.{name}")

    headings = re.findall(r"### `([\w.]+)`", PAGE)
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
