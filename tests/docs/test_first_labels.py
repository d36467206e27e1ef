"""The commands and the Python of the first tutorial run."""

from __future__ import annotations

from pathlib import Path

import pytest

from fixtures.pages import Changes, DocsPage, execute, run

PAGE = DocsPage("docs/first_labels.md")
CHANGES = Changes(values={"simulate": {"--sequences": 1, "--scans": 1}})


@pytest.mark.full
def test_the_tutorial_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("embreex")
    monkeypatch.chdir(tmp_path)
    run(PAGE.commands, CHANGES)
    assert Path("city.html").stat().st_size
    assert Path("coloured/000000.ply").stat().st_size

    assert "uncertain" in repr(execute(PAGE.blocks("python"))["result"])
