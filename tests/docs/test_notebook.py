"""The notebooks run from first to last cell, without network, and hold their outputs."""

from __future__ import annotations

import json
import re
import webbrowser
from pathlib import Path
from typing import Any

import pytest

from fixtures.pages import load_script

DOCS = Path(__file__).parents[2] / "docs"
NOTEBOOKS = sorted(DOCS.glob("*.ipynb"))
LARGEST_NOTEBOOK = 400_000  # bytes


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
def test_a_notebook_is_small_and_has_the_outputs_of_one_run(path: Path) -> None:
    assert path.stat().st_size < LARGEST_NOTEBOOK
    cells = cells_of(path)
    ids = [cell["id"] for cell in cells]
    assert len(set(ids)) == len(ids)
    for cell in cells:
        assert all(re.fullmatch(r"[^\n]*\n?", line) for line in cell["source"])

    codes = [cell for cell in cells if cell["cell_type"] == "code"]
    assert [cell["execution_count"] for cell in codes] == list(range(1, len(codes) + 1))
    assert "image/png" in json.dumps([cell["outputs"] for cell in codes])


def kinds_of_outputs(notebook: dict[str, Any]) -> list[list[str]]:
    """Return the kinds of the outputs of each cell of code; another processor changes figures."""
    cells = [cell for cell in notebook["cells"] if cell["cell_type"] == "code"]
    return [[output["output_type"] for output in cell["outputs"]] for cell in cells]


@pytest.mark.full
@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.name)
def test_a_notebook_runs_and_stores_outputs_of_the_same_kinds(
    path: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("embreex")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(webbrowser, "open", lambda url: pytest.fail("a browser was opened"))
    notebook = json.loads(path.read_text(encoding="utf-8"))
    stored = kinds_of_outputs(notebook)
    variables = load_script("docs/notebook.py").run(notebook)

    assert kinds_of_outputs(notebook) == stored, "run python docs/notebook.py"
    assert "do not rely on these labels" in json.dumps(notebook)
    assert not variables["mended"].verdict.is_doubtful
