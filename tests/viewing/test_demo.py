"""`amvnet demo` leaves a page that a browser opens without an error."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from amvnet.cli.commands import demo
from amvnet.weights.file import save

from fixtures.browser_pages import Browser, browser, read_page
from fixtures.worlds import fresh_weights, run_cli

__all__ = ["browser"]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Run the demo on one street with small weights."""
    pytest.importorskip("embreex")
    root = tmp_path_factory.mktemp("demo")
    save(fresh_weights(), root / "w.safetensors")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(demo, "SEQUENCES", 1)
        patch.setattr(demo, "SCANS", 1)
        options = ("--weights", root / "w.safetensors", "--out", root / "demo")
        assert run_cli("demo", *options) == (0, "")
    return root / "demo"


def test_the_page_has_truth_all_methods_and_uncertain_points(folder: Path) -> None:
    page = read_page(folder / "index.html")
    keys = [source["key"] for source in page.about["sources"]]
    assert keys == ["truth", "rv", "bev", "ensemble", "amvnet"]
    _, planes = page.scan(0)
    assert "uncertain" in planes


def test_the_table_of_the_page_has_the_figures_that_are_written(folder: Path) -> None:
    report = json.loads((folder / "metrics.json").read_text())
    table = read_page(folder / "index.html").about["table"]
    expected = [round(100 * method["miou"], 1) for method in report["methods"].values()]
    assert table["totals"][0]["values"] == expected


def test_the_browser_opens_the_page_without_an_error(folder: Path, browser: Browser) -> None:
    state = browser.state(folder / "index.html", "color=uncertainty")
    assert state["console"] == []
    assert sum(state["drawn"]) > 10_000
