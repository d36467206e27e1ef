"""The commands and the Python of the first tutorial run."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import pytest

from fixtures.commands import commands_of, run_cli

PAGE = "docs/first_labels.md"


def test_the_tutorial_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("embreex")
    monkeypatch.chdir(tmp_path)
    for program, *arguments in commands_of(PAGE):
        assert program == "amvnet"
        if arguments[0] == "simulate":
            arguments[arguments.index("--sequences") + 1] = "1"
            arguments[arguments.index("--scans") + 1] = "1"
        assert run_cli(*arguments) == (0, ""), arguments

    assert Path("city.html").stat().st_size
    assert Path("coloured/000000.ply").stat().st_size

    scope: dict[str, Any] = {}
    page = (Path(__file__).parents[2] / PAGE).read_text(encoding="utf-8")
    for block in re.findall(r"```python\n(.*?)```", page, re.S):
        exec(block, scope)
    assert "uncertain" in repr(scope["result"])
