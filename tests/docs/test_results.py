"""The figures of the pages are those of docs/results.json."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from amvnet.data.class_maps import class_map

from fixtures.pages import load_script

ROOT = Path(__file__).parents[2]
DOCS = ROOT / "docs"
LOG = DOCS / "log.md"
RESULTS = load_script("docs/results.py")


@pytest.mark.parametrize("page", RESULTS.PAGES)
def test_a_page_has_the_tables_of_the_file(page: str) -> None:
    text = (ROOT / page).read_text(encoding="utf-8")
    assert RESULTS.filled(text) == text, "run python docs/results.py"


def test_every_table_is_on_a_page() -> None:
    texts = "".join((ROOT / page).read_text(encoding="utf-8") for page in RESULTS.PAGES)
    for name in RESULTS.TABLES:
        assert texts.count(f"<!-- {name} -->\n") == texts.count(f"<!-- end of {name} -->") > 0, name
    assert set(re.findall(r"<!-- end of (.*?) -->", texts)) == set(RESULTS.TABLES)


def test_the_figures_of_seven_classes_have_the_means_that_are_stated() -> None:
    assert class_map("lidog").target.classes == RESULTS.SEVEN
    for row in RESULTS.read()["rows"]:
        if "seven_classes" in row:
            mean = sum(row["seven_classes"]) / 7
            assert mean == pytest.approx(row["seven"]["amvnet"], abs=0.1), row["scans"]


def test_what_evaluate_prints_in_the_pages_is_in_the_file() -> None:
    known = set()
    for row in RESULTS.read()["rows"]:
        alone = tuple(f"{row.get(method, 0):.1f}" for method in ("rv", "bev", "ensemble", "amvnet"))
        known |= {alone, (*alone, f"{row.get('drive', 0):.1f}")}

    printed = set()
    for page in DOCS.glob("*.md"):
        for line in re.findall(r"(?m)^ *mIoU +│(.*)$", page.read_text(encoding="utf-8")):
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
