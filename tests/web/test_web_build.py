"""web/build.py keeps what takes long to make for the page."""

from __future__ import annotations

from functools import partial
from pathlib import Path

import pytest

from fixtures.pages import load_script


def test_two_builds_share_the_first_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    build = load_script("web/build.py")
    monkeypatch.setattr(build, "CACHE", tmp_path / "cache")
    source = tmp_path / "source"

    def write(text: str, folder: Path) -> None:
        (folder / "graph").write_text(text)

    def write_late(folder: Path) -> None:
        build.cached("graphs", [source], partial(write, "first"))
        write("second", folder)

    for version in ("old", "new"):
        source.write_text(version)
        found = build.cached("graphs", [source], write_late)
        assert (found / "graph").read_text() == "first"
        assert list((tmp_path / "cache").iterdir()) == [found]
