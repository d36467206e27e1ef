"""The notebooks run from their first cell to their last, without network, and hold no outputs."""

from __future__ import annotations

import json
import re
import webbrowser
from pathlib import Path
from typing import Any

import matplotlib as mpl
import pytest

from fixtures.pages import execute

DOCS = Path(__file__).parents[2] / "docs"
NOTEBOOKS = sorted(DOCS.glob("*.ipynb"))
LARGEST_NOTEBOOK = 20_000  # bytes


def cells_of(path: Path) -> list[dict[str, Any]]:
    cells = json.loads(path.read_text(encoding="utf-8"))["cells"]
    assert isinstance(cells, list)
    return cells


def test_there_is_a_notebook_and_the_index_links_it() -> None:
    index = (DOCS / "index.md").read_text(encoding="utf-8")
    assert NOTEBOOKS
    for path in NOTEBOOKS:
        assert f"({path.name})" in index


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.name)
def test_a_notebook_is_small_and_has_no_outputs(path: Path) -> None:
    assert path.stat().st_size < LARGEST_NOTEBOOK
    ids = [cell["id"] for cell in cells_of(path)]
    assert len(set(ids)) == len(ids)
    for cell in cells_of(path):
        assert all(re.fullmatch(r"[^\n]*\n?", line) for line in cell["source"])
        if cell["cell_type"] == "code":
            assert cell["outputs"] == []
            assert cell["execution_count"] is None


@pytest.mark.full
@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.name)
def test_a_notebook_runs(
    path: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("embreex")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(webbrowser, "open", lambda url: pytest.fail("a browser was opened"))
    cells = [cell["source"] for cell in cells_of(path) if cell["cell_type"] == "code"]
    with mpl.rc_context({"backend": "agg"}):
        variables = execute(map("".join, cells))

    assert "do not rely on these labels" in capsys.readouterr().out
    assert not variables["mended"].verdict.is_doubtful
