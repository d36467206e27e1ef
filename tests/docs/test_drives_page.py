"""The commands and the Python of the page on drives run."""

from __future__ import annotations

from pathlib import Path

import pytest

from fixtures.pages import Changes, DocsPage, execute, run

PAGE = DocsPage("docs/drives.md")
OWN_DATA = DocsPage("docs/own_data.md")
CHANGES = Changes(values={"simulate": {"--scans": 3}})


@pytest.mark.full
def test_the_page_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("embreex")
    pytest.importorskip("kiss_icp")
    monkeypatch.chdir(tmp_path)
    (few,) = [text for text in OWN_DATA.blocks("yaml") if "from:" in text]
    Path("few.yaml").write_text(few)  # the page links to it
    run(PAGE.commands, CHANGES)
    assert len(list(Path("drive_labels").rglob("*.label"))) == 3
    assert Path("map.html").stat().st_size

    assert "uncertain" in repr(execute(PAGE.blocks("python"))["result"])
