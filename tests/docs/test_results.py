"""The figures of the pages are those of docs/results.json."""

from __future__ import annotations

import re
from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path
from types import ModuleType

import pytest

ROOT = Path(__file__).parents[2]
DOCS = ROOT / "docs"
LOG = DOCS / "log.md"


def load_program() -> ModuleType:
    """Import docs/results.py, which is no part of a package."""
    spec = spec_from_file_location("results_program", DOCS / "results.py")
    assert spec is not None
    assert spec.loader is not None
    program = module_from_spec(spec)
    spec.loader.exec_module(program)
    return program


RESULTS = load_program()


@pytest.mark.parametrize("page", list(RESULTS.PAGES))
def test_a_page_has_the_table_of_the_file(page: str) -> None:
    text = (ROOT / page).read_text(encoding="utf-8")
    assert RESULTS.filled(page, text) == text, "run python docs/results.py"


def test_what_evaluate_prints_in_the_pages_is_in_the_file() -> None:
    known = set()
    for row in RESULTS.read()["rows"]:
        alone = tuple(f"{row[method]:.1f}" for method in ("rv", "bev", "ensemble", "amvnet"))
        known |= {alone, (*alone, f"{row.get('drive', 0):.1f}")}

    printed = set()
    for page in DOCS.glob("*.md"):
        text = page.read_text(encoding="utf-8")
        for line in re.findall(r"(?m)^ *mIoU +│(.*)$", text):
            printed.add(tuple(re.findall(r"[\d.]+", line)))
    assert printed
    assert printed <= known


def test_only_the_log_tells_history() -> None:
    """Users of a page need no commit, and no weights that they cannot load."""
    for page in [ROOT / "README.md", *set(DOCS.glob("*.md")) - {LOG}]:
        text = page.read_text(encoding="utf-8")
        commits = re.findall(r"\b(?=[0-9a-f]*[0-9])(?=[0-9a-f]*[a-f])[0-9a-f]{7}\b", text)
        assert commits == [], page
        assert not re.search(r"earlier weights|an earlier `sim|the present (weights|`sim)", text), (
            page
        )


def test_every_entry_of_the_log_has_a_date_a_table_and_a_verdict() -> None:
    _, _, *entries = re.split(r"(?m)^## ", LOG.read_text(encoding="utf-8"))  # without the results
    assert entries
    for entry in entries:
        title = entry.splitlines()[0]
        assert re.search(r"\n\n\*\d{4}-\d\d-\d\d( to (\d\d-)?\d\d)?\.\* ", entry), title
        assert "\n|---" in entry, title
        assert "\n**Verdict:** " in entry, title
